"""How long a person, or a plant that lost its engine, waits for a process to begin."""

from __future__ import annotations

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
    "import the engine process": "import eap.appliance.engine.process",
    "import eap.attach": "import eap; eap.attach",
}


def run(settings: Settings) -> list[Figure]:
    """Measure the wall time of processes that start and end at once."""
    settings.tell("start-up")
    count = settings.micro_repeats
    eapctl = str(Path(sys.executable).with_name("eapctl"))
    help_ms = _median_ms([eapctl, "--help"], count)
    figures = [
        at_most("eapctl --help", help_ms, 100, " ms"),
        report(_EMPTY, f"{_median_ms([sys.executable, '-c', ''], count):.0f} ms"),
    ]
    for name, code in _IMPORTS.items():
        took_ms = _median_ms([sys.executable, "-c", code], count)
        figures.append(report(name, f"{took_ms:.0f} ms", took_ms))
    return figures


def _median_ms(command: Sequence[str], count: int) -> float:
    times = []
    for _ in range(count):
        begin = perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, cwd=ROOT)
        times.append(perf_counter() - begin)
    return median(times) * 1000
