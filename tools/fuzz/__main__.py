"""Fuzz the decoders: ``python -m tools.fuzz [TARGET…] [--seconds 10] [--seed 1]``.

A target is a module in ``tools/fuzz/targets`` with one function, ``fuzz_one(data)``: it gives the
octets to a decoder and lets pass exactly the exceptions that the decoder documents.  Whatever else
it raises is a find: the octets are printed and the exit code is 1.

The octets come from the golden vectors, damaged.  Where atheris is installed, ``--atheris`` lets
coverage guide the damage, for one target at a time.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from random import Random
from time import monotonic
from typing import NamedTuple, TypeAlias

import yaml

from tools.fuzz.mutator import MAX_SIZE, mutations

FuzzOne: TypeAlias = Callable[[bytes], None]

VECTORS = Path(__file__).parents[2] / "tests" / "vectors"
TARGETS = Path(__file__).parent / "targets"
_HEADERS = (0, 14, 18, 42)
"""Offsets of an EtherCAT frame: bare, behind Ethernet, behind a VLAN tag, behind UDP."""


class Find(NamedTuple):
    """Octets that made a target raise what it does not document."""

    octets: bytes
    error: Exception


def list_targets() -> list[str]:
    """Name every target."""
    return sorted(path.stem for path in TARGETS.glob("*.py"))


def load_target(name: str) -> FuzzOne:
    """Return a target's function."""
    fuzz_one: FuzzOne = import_module(f"tools.fuzz.targets.{name}").fuzz_one
    return fuzz_one


def load_seeds() -> list[bytes]:
    """Return the octets of all golden vectors, whole and without what is around the frame."""
    paths = sorted(VECTORS.glob("*.yaml"))
    contents = [yaml.load(path.read_text(), yaml.CSafeLoader) for path in paths]
    octets = [
        bytes.fromhex(item["octets"]) for content in contents for item in content.get("vectors", [])
    ]
    return list(dict.fromkeys(item[start:] for item in octets for start in _HEADERS))


def fuzz(fuzz_one: FuzzOne, inputs: Iterable[bytes]) -> tuple[int, Find | None]:
    """Run *fuzz_one* on *inputs* until it raises; return how many it took, and what broke it."""
    count = 0
    for octets in inputs:
        try:
            fuzz_one(octets)
        except Exception as exc:  # noqa: BLE001  any exception is the find
            return count, Find(octets, exc)
        count += 1
    return count, None


def main(arguments: list[str]) -> int:
    """Run the targets one after the other; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description=__doc__)
    parser.add_argument("target", nargs="*", help=f"one of {', '.join(list_targets())}; else all")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each target")
    parser.add_argument("--seed", type=int, default=1, help="of the damage")
    parser.add_argument("--atheris", action="store_true", help="let coverage guide the damage")
    options = parser.parse_args(arguments)
    unknown = set(options.target) - set(list_targets())
    if unknown:
        parser.error(f"{unknown.pop()!r} is no target (one of {', '.join(list_targets())})")
    names = options.target or list_targets()
    if options.atheris:
        if len(names) != 1:
            parser.error("--atheris takes exactly one target")
        _fuzz_with_atheris(names[0], options.seconds)
    return max(_fuzz_with_dice(name, options.seconds, options.seed) for name in names)


def _fuzz_with_dice(name: str, seconds: float, seed: int) -> int:
    end = monotonic() + seconds
    endless = mutations(load_seeds(), Random(seed))  # noqa: S311  damage, not secrets
    inputs = itertools.takewhile(lambda _: monotonic() < end, endless)
    count, find = fuzz(load_target(name), inputs)
    if find is None:
        print(f"{name}: {count} inputs, nothing found")
        return 0
    print(f"{name}: found after {count} inputs (seed {seed}): {find.octets.hex()}")
    traceback.print_exception(find.error)
    return 1


def _fuzz_with_atheris(name: str, seconds: float) -> None:
    try:
        atheris = import_module("atheris")
    except ImportError:
        sys.exit("atheris is not installed: pip install atheris, or leave --atheris away")
    with atheris.instrument_imports(include=["eap", "devicebus"]):
        fuzz_one = load_target(name)
    with tempfile.TemporaryDirectory() as corpus:
        for number, octets in enumerate(load_seeds()):
            Path(corpus, str(number)).write_bytes(octets)
        limits = [f"-max_total_time={seconds:.0f}", f"-max_len={MAX_SIZE}"]
        atheris.Setup([name, *limits, corpus], fuzz_one)
        atheris.Fuzz()  # ends the process


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
