"""Fuzz the decoders: ``make fuzz``, or ``python -m tools.fuzz [TARGET…] [--seconds 10]``.

A target is a module in ``tools/fuzz/targets`` with one function, ``fuzz_one(data)``: it gives the
octets to a decoder and lets pass exactly the exceptions that the decoder documents.  Whatever else
it raises is a find.  The target ``sockets`` sends to every listening socket of a running appliance,
and finds processes that end, or clients that get no answer.

A find is printed, kept in the folder with a report that names no path of this machine, and the exit
code is 1.  Inputs of earlier finds come first in the next run.

The octets come from the golden vectors, damaged.  Where atheris is installed, ``--atheris`` lets
coverage guide the damage, for one target at a time.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from importlib import import_module
from pathlib import Path
from random import Random
from time import monotonic
from typing import NamedTuple, TypeAlias

import yaml

from tools.fuzz import sockets
from tools.fuzz.mutator import MAX_SIZE, mutations

FuzzOne: TypeAlias = Callable[[bytes], None]

ROOT = Path(__file__).parents[2]
VECTORS = ROOT / "tests" / "vectors"
FINDS = ROOT / ".fuzz"
"""Folder of finds, which git ignores."""
SOCKETS = "sockets"
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
    """Run the targets, several at once; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description=__doc__)
    names = [*list_targets(), SOCKETS]
    parser.add_argument("target", nargs="*", help=f"one of {', '.join(names)}; else all")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each target")
    parser.add_argument("--seed", type=int, default=1, help="of the damage")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="targets at once")
    parser.add_argument("--folder", type=Path, default=FINDS, help="of finds")
    parser.add_argument("--atheris", action="store_true", help="let coverage guide the damage")
    options = parser.parse_args(arguments)
    unknown = set(options.target) - set(names)
    if unknown:
        parser.error(f"{unknown.pop()!r} is no target (one of {', '.join(names)})")
    chosen = options.target or names
    if options.atheris:
        if len(chosen) != 1 or SOCKETS in chosen:
            parser.error("--atheris takes exactly one target, and no sockets")
        _fuzz_with_atheris(chosen[0], options.seconds)
    runs = [
        Run(name, options.seconds, options.seed, options.folder) for name in dict.fromkeys(chosen)
    ]
    if len(runs) == 1 or options.jobs == 1:
        results = [_report(fuzz_target(run)) for run in runs]
    else:
        with ProcessPoolExecutor(options.jobs) as pool:
            pending = [pool.submit(fuzz_target, run) for run in runs]
            results = [_report(each.result()) for each in as_completed(pending)]
    if len(results) > 1:
        inputs, finds = (
            sum(each.inputs for each in results),
            sum(bool(each.find) for each in results),
        )
        print(f"{len(results)} targets, {inputs:,} inputs: {finds} finds")
    return int(any(each.find for each in results))


class Run(NamedTuple):
    """A target, how long it runs, the seed of its damage, and the folder of its finds."""

    name: str
    seconds: float
    seed: int
    folder: Path


class Result(NamedTuple):
    """Inputs that a target took, and the report of its find; empty without one."""

    name: str
    inputs: int
    find: str


def fuzz_target(run: Run) -> Result:
    """Run one target with its earlier finds first; keep a new find."""
    if run.name == SOCKETS:
        count, find = sockets.fuzz_sockets(run.seconds, run.seed, load_seeds())
        kept = b"".join(find.sent) if find else b""
        text = find.text if find else ""
    else:
        earlier = [path.read_bytes() for path in sorted(run.folder.glob(f"{run.name}-*.bin"))]
        end = monotonic() + run.seconds
        endless = mutations(load_seeds(), Random(run.seed))  # noqa: S311  damage, not secrets
        inputs = itertools.chain(earlier, itertools.takewhile(lambda _: monotonic() < end, endless))
        count, found = fuzz(load_target(run.name), inputs)
        kept = found.octets if found else b""
        text = "".join(traceback.format_exception(found.error)) if found else ""
    if not text:
        return Result(run.name, count, "")
    report = f"{run.name}: found after {count} inputs (seed {run.seed}): {kept.hex()}\n{text}"
    report = report.replace(f"{ROOT}{os.sep}", "").replace(str(Path.home()), "~")
    run.folder.mkdir(exist_ok=True)
    place = run.folder / f"{run.name}-{hashlib.sha256(kept).hexdigest()[:12]}"
    place.with_suffix(".bin").write_bytes(kept)
    place.with_suffix(".txt").write_text(report)
    return Result(run.name, count, report)


def _report(result: Result) -> Result:
    if result.find:
        sys.stderr.write(result.find)
        print(result.find.partition("\n")[0])
    else:
        print(f"{result.name}: {result.inputs} inputs, nothing found")
    return result


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
