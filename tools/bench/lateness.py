"""Lateness of cycles beside cyclictest: same time, same priority, a core each."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from statistics import median
from tempfile import TemporaryDirectory
from typing import NamedTuple

from tools.bench import machine
from tools.bench.figures import Figure, at_most, percentile, report
from tools.bench.network import Cable, cable
from tools.bench.settings import Settings

TITLE = "Lateness of cycles: the engine's loop beside cyclictest, same time, same priority"
PRIORITY = 50
_SAMPLE = re.compile(rb"^\s*0:\s*\d+:\s*(\d+)\s*$", re.MULTILINE)
_COLD_S = 0.5
"""The first half second is left out on both sides."""


class Pair(NamedTuple):
    """Samples in nanoseconds of the engine and of cyclictest, taken at the same time."""

    engine: list[int]
    cyclictest: list[int]


def run(settings: Settings) -> list[Figure]:
    """Measure both cycle times with and without PM QoS.

    Raises:
        SkippedError: no root, one core, or no cyclictest.
    """
    machine.require_cores()
    program = machine.require_program("cyclictest", "rt-tests")
    figures = []
    with cable() as link:
        for cycle_us in (1000, 10_000):
            for pm_qos in (True, False):
                name = f"{cycle_us // 1000} ms, PM QoS {'on' if pm_qos else 'off'}"
                settings.tell(f"lateness: {name}")
                pairs = [
                    _measure(link, program, cycle_us, settings.lateness_s, placed, pm_qos=pm_qos)
                    for placed in (machine.cores(), machine.cores()[::-1])
                ]
                figures += figures_of(name, pairs, 1_000_000 // cycle_us)
    return figures


def _measure(
    link: Cable,
    program: str,
    cycle_us: int,
    seconds: float,
    placed: tuple[int, int],
    *,
    pm_qos: bool,
) -> Pair:
    ours, theirs = placed
    cycles = int(seconds * 1e6 / cycle_us)
    command = f"{program} -q -v -N -m -t 1 -p {PRIORITY} -a {theirs} --mainaffinity={theirs}"
    command += f" -i {cycle_us} -l {cycles}" + ("" if pm_qos else " --default-system")
    with TemporaryDirectory(dir=link.folder) as folder:
        job = {
            "folder": folder,
            "cycle_us": cycle_us,
            "seconds": seconds,
            "pm_qos": pm_qos,
            "priority": PRIORITY,
        }
        with link.worker("engine_roles.run", job, side=0, cpu=ours) as engine:
            engine.answer()
            reference = subprocess.run(command.split(), capture_output=True, check=True)
            late_ns = engine.answer()["late_ns"]
    cold = int(_COLD_S * 1e6 / cycle_us)
    return Pair(late_ns[cold:], samples_of(reference.stdout)[cold:])


def samples_of(output: bytes) -> list[int]:
    """Return the nanoseconds that a verbose cyclictest printed, in their order."""
    return [int(value) for value in _SAMPLE.findall(output)]


def figures_of(name: str, pairs: Sequence[Pair], per_second: int) -> list[Figure]:
    """Compare all samples of both sides; *per_second* is how many make a window."""
    engine = [value for pair in pairs for value in pair.engine]
    reference = [value for pair in pairs for value in pair.cyclictest]
    ours, theirs = percentile(engine, 0.5), percentile(reference, 0.5)
    p99 = [
        median(
            percentile(window, 0.99) for samples in side for window in _windows(samples, per_second)
        )
        for side in ([pair.engine for pair in pairs], [pair.cyclictest for pair in pairs])
    ]
    tails = ", ".join(
        f"{label} {_us(pick(engine))} to {_us(pick(reference))} µs"
        for label, pick in (
            ("p99", lambda values: percentile(values, 0.99)),
            ("p99.9", lambda values: percentile(values, 0.999)),
            ("max", max),
        )
    )
    return [
        at_most(f"{name}: p50, ratio", ours / theirs, 1.3, "", f"{_us(ours)} to {_us(theirs)} µs"),
        at_most(
            f"{name}: p99 of one-second windows, median, ratio",
            p99[0] / p99[1],
            3,
            "",
            f"{_us(p99[0])} to {_us(p99[1])} µs",
        ),
        report(f"{name}: tails", tails),
    ]


def _windows(samples: list[int], length: int) -> list[list[int]]:
    """Cut *samples* into whole windows; what is too short for one is a window itself."""
    whole = [samples[n : n + length] for n in range(0, len(samples) - length + 1, length)]
    return whole or [samples]


def _us(value_ns: float) -> str:
    return f"{value_ns / 1000:.1f}"
