"""Start-up time of processes, for users and for a plant that lost its engine."""

from __future__ import annotations

import resource
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from time import perf_counter

from tools.bench.figures import Figure, at_most, report
from tools.bench.network import ROOT
from tools.bench.settings import Settings

TITLE = "Start-up, whole processes"
_EMPTY = "bare interpreter, the reference"
_IMPORTS = {
    "import the engine process": "import eap.engine.process",
    "import eap.attach": "import eap; eap.attach",
}
_BUS_SIDE = "eap.services.gateway.opening, eap.services.ads.bus_ads"
_PROCESSES = {
    "engine": "eap.engine.process",
    "services": "eap.services.process",
    "services with buses": f"eap.services.process, {_BUS_SIDE}",
    "segment": "eap.segment.process",
    "supervisor": "eap.supervisor.process",
}
"""Modules that each process has imported when it runs."""
_COUNT = "print(sum(name.split('.')[0] in ('eap', 'devicebus') for name in sys.modules))"


def run(settings: Settings) -> list[Figure]:
    """Measure the wall time of processes that start and end at once."""
    settings.tell("start-up")
    count = settings.micro_repeats
    eapctl = str(Path(sys.executable).with_name("eapctl"))
    help_ms = _median_ms([eapctl, "--help"], count)
    empty_ms = _median_ms([sys.executable, "-c", ""], count)
    limit = f"a bare interpreter: {empty_ms:.0f} ms"
    figures = [
        at_most("start of eapctl --help", help_ms, 70, " ms", limit=limit),
        report(_EMPTY, f"{empty_ms:.0f} ms"),
    ]
    for name, code in _IMPORTS.items():
        took_ms = _median_ms([sys.executable, "-c", code], count)
        figures.append(report(name, f"{took_ms:.0f} ms", took_ms))
    for name in _PROCESSES:
        cpu_ms, modules = imports(name, count)
        shown = f"{cpu_ms:.0f} ms, {modules} modules of this project"
        figures.append(report(f"CPU time of the imports of a process: {name}", shown, cpu_ms))
    return figures


def imports(name: str, count: int) -> tuple[float, int]:
    """Return the CPU time of the imports of a process in ms, and its modules of this project.

    The time is the least of *count* runs.
    """
    code = f"import sys, gc; gc.disable(); import {_PROCESSES[name]}; {_COUNT}"
    cpu_ms, output = _least_cpu_ms([sys.executable, "-c", code], count)
    return cpu_ms, int(output)


def _least_cpu_ms(command: Sequence[str], count: int) -> tuple[float, str]:
    """Return the least CPU time of several runs, which load beside it changes least, and stdout."""
    times = []
    for _ in range(count):
        before = _cpu_of_children_s()
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, cwd=ROOT, text=True)
        times.append(_cpu_of_children_s() - before)
    return min(times) * 1000, done.stdout


def _cpu_of_children_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _median_ms(command: Sequence[str], count: int) -> float:
    times = []
    for _ in range(count):
        begin = perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
        times.append(perf_counter() - begin)
    return median(times) * 1000
