"""Limits of one engine: the shortest cycle, and the most stations, without a loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from os import geteuid
from pathlib import Path
from subprocess import SubprocessError
from tempfile import TemporaryDirectory
from typing import TypeAlias

from tools.bench import machine
from tools.bench.appliance import Observation, observe
from tools.bench.figures import Figure, at_least, at_most, report
from tools.bench.network import cable
from tools.bench.plants import line
from tools.bench.settings import Settings

TITLE = "Limits of one engine process: the solar line, faster and longer, until something is lost"
CYCLES_US = (2000, 1000, 700, 500, 400, 300, 250, 200, 150, 100)
STATIONS = (57, 113, 169, 220, 300, 400, 500)
"""The control station is one of them."""
STATIONS_OF_THE_LINE = 15
LINE_CYCLE_US = 10_000
CYCLE_TARGET_US, STATIONS_TARGET = 400, 300
LEFT_OUT = 0.01
"""More cycles left out than this share is a plant that runs slower than it should.  It is not 0:
a virtual machine that stalls for 100 ms is not the engine's fault."""

Observe: TypeAlias = Callable[[int], Observation | None]
"""Observes one case; None if the plant does not get ready."""
Seen: TypeAlias = tuple[int, Observation | None]
"""A case, and what was observed."""


def run(settings: Settings) -> list[Figure]:
    """Search both limits, each from its target to the first case with another result."""
    machine.require_cores()
    with (
        cable() if geteuid() == 0 else nullcontext() as link,
        TemporaryDirectory(dir=machine.memory_folder()) as folder,
    ):

        def look(stations: int, cycle_us: int) -> Observation | None:
            settings.tell(f"limits: {stations} stations at {cycle_us} µs")
            plant = Path(folder, f"line-{stations}-{cycle_us}.yaml")
            plant.write_bytes(line(stations - 1, cycle_us))
            try:
                return observe(plant, settings.search_s, link)
            except (RuntimeError, SubprocessError):
                return None

        cycles = search(CYCLES_US, CYCLE_TARGET_US, lambda us: look(STATIONS_OF_THE_LINE, us))
        stations = search(STATIONS, STATIONS_TARGET, lambda count: look(count, LINE_CYCLE_US))
    return [cycle_figure(cycles), stations_figure(stations)]


def search(cases: Sequence[int], first: int, look: Observe) -> list[Seen]:
    """Look at the case *first*, then at harder ones until one fails, or easier until one is good.

    Args:
        cases: All cases, from the easiest on.
        first: One of them.
        look: Observes a case, once more if it loses something: that may be the machine.

    Returns:
        The cases that were looked at, from the easiest on.
    """

    def look_again(case: int) -> Seen:
        seen = look(case)
        return case, seen if seen is None or _is_good(seen) else look(case)

    at = cases.index(first)
    seen = {at: look_again(first)}
    is_good = _is_good(seen[at][1])
    step = 1 if is_good else -1
    while 0 <= at + step < len(cases):
        at += step
        seen[at] = look_again(cases[at])
        if _is_good(seen[at][1]) is not is_good:
            break
    return [seen[number] for number in sorted(seen)]


def cycle_figure(seen: Sequence[Seen]) -> Figure:
    """Return the shortest cycle of the solar line that *seen* found good."""
    name = "shortest cycle of 15 stations"
    found = _limit(seen, " µs")
    if found is None:
        return report(name, "none of those tried")
    value, detail, limit = found
    return at_most(name, value, CYCLE_TARGET_US, " µs", detail, limit=limit)


def stations_figure(seen: Sequence[Seen]) -> Figure:
    """Return the most stations at 10 ms that *seen* found good."""
    name = "most stations at 10 ms"
    found = _limit(seen, " stations")
    if found is None:
        return report(name, "none of those tried")
    value, detail, limit = found
    return at_least(name, value, STATIONS_TARGET, detail, limit=limit, unit=" stations")


def _limit(seen: Sequence[Seen], unit: str) -> tuple[int, str, str] | None:
    """Return the hardest good case, the engine's share there, and the failure behind it."""
    found, failure = None, "none found"
    for case, observation in seen:
        if observation is not None and _is_good(observation):
            found = case, f"engine {observation.cpu['engine']:.0%} of a core"
            continue
        failure = f"at {case}{unit} the plant does not get ready"
        if observation is not None:
            left_out = f"{observation.overruns / max(observation.cycles, 1):.1%}"
            lost = f"{observation.lost} frames lost"
            failure = f"at {case}{unit} {left_out} of the cycles left out, {lost}"
        break
    return None if found is None else (*found, failure)


def _is_good(seen: Observation | None) -> bool:
    if seen is None or not seen.received:
        return False
    return seen.lost == 0 and seen.overruns <= LEFT_OUT * seen.cycles
