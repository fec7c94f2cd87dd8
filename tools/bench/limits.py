"""Limits of one engine: the shortest cycle, and the most stations, without a loss."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from os import geteuid
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

from tools.bench import machine
from tools.bench.appliance import Observation, observe
from tools.bench.figures import Figure, report
from tools.bench.network import Cable, cable
from tools.bench.plants import line
from tools.bench.settings import Settings

TITLE = "Limits of one engine process: the solar line, faster and longer, until something is lost"
CYCLES_US = (5000, 2000, 1000, 700, 500, 400, 300, 250, 200, 150, 100)
ISLANDS = (28, 56, 84, 112, 140, 168, 200, 240)
ISLANDS_OF_THE_LINE = 14
LINE_CYCLE_US = 10_000
LEFT_OUT = 0.01
"""More cycles left out than this share is a plant that runs slower than it should.  It is not 0:
a virtual machine that stalls for 100 ms is not the engine's fault."""


Case: TypeAlias = tuple[int, int]
"""Islands and cycle time in microseconds."""


def run(settings: Settings) -> list[Figure]:
    """Search both limits, each from the easy end to the first failure."""
    machine.require_cores()
    with (
        cable() if geteuid() == 0 else nullcontext() as link,
        TemporaryDirectory(dir=machine.memory_folder()) as folder,
    ):
        fastest = _search(
            settings, link, Path(folder), [(ISLANDS_OF_THE_LINE, us) for us in CYCLES_US]
        )
        longest = _search(settings, link, Path(folder), [(n, LINE_CYCLE_US) for n in ISLANDS])
    return [
        _figure("shortest cycle of 15 stations", fastest, lambda case: f"{case[1]} µs"),
        _figure("most stations at 10 ms", longest, lambda case: f"{case[0] + 1}"),
    ]


def _search(
    settings: Settings, link: Cable | None, folder: Path, cases: Sequence[Case]
) -> list[tuple[Case, Observation]]:
    """Return what was seen up to and including the first failure."""
    seen: list[tuple[Case, Observation]] = []
    for islands, cycle_us in cases:
        settings.tell(f"limits: {islands + 1} stations at {cycle_us} µs")
        plant = folder / f"line-{islands}-{cycle_us}.yaml"
        plant.write_bytes(line(islands, cycle_us))
        observation = observe(plant, settings.search_s, link)
        seen.append(((islands, cycle_us), observation))
        if not _is_good(observation):
            break
    return seen


def _is_good(seen: Observation) -> bool:
    return seen.lost == 0 and seen.received > 0 and seen.overruns <= LEFT_OUT * seen.cycles


def _figure(name: str, seen: list[tuple[Case, Observation]], show: Callable[[Case], str]) -> Figure:
    good = [(case, observation) for case, observation in seen if _is_good(observation)]
    if not good:
        return report(name, "none of those tried")
    case, observation = good[-1]
    text = f"{show(case)}, engine {observation.cpu['engine']:.0%} of a core"
    if len(good) < len(seen):
        failed, why = seen[-1]
        text += f"; at {show(failed)} {why.lost} lost, {why.overruns} of {why.cycles} left out"
    return report(name, text)
