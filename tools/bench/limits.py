"""Limits of one engine: the shortest cycle, and the most stations, without a loss."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from os import geteuid
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

from tools.bench import machine
from tools.bench.appliance import Observation, observe
from tools.bench.figures import Figure, at_least, at_most, report
from tools.bench.network import Cable, cable
from tools.bench.plants import line
from tools.bench.settings import Settings

TITLE = "Limits of one engine process: the solar line, faster and longer, until something is lost"
CYCLES_US = (2000, 1000, 700, 500, 400, 300, 250, 200, 150, 100)
ISLANDS = (56, 112, 168, 220, 260, 300, 350, 400, 500)
ISLANDS_OF_THE_LINE = 14
LINE_CYCLE_US = 10_000
LEFT_OUT = 0.01
"""More cycles left out than this share is a plant that runs slower than it should.  It is not 0:
a virtual machine that stalls for 100 ms is not the engine's fault."""


Case: TypeAlias = tuple[int, int]
"""Islands and cycle time in microseconds."""
Seen: TypeAlias = tuple[Case, Observation]


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
        cycle_figure(fastest),
        stations_figure(longest),
    ]


def cycle_figure(seen: Sequence[Seen]) -> Figure:
    """Return the shortest cycle of the solar line that *seen* found good."""
    name = "shortest cycle of 15 stations"
    cases = [(case[1], observation) for case, observation in seen]
    if not _is_good(cases[0][1]):
        return report(name, "none of those tried")
    value = min(cycle_us for cycle_us, observation in cases if _is_good(observation))
    detail, limit = _said(cases, " µs")
    return at_most(name, value, 400, " µs", detail, limit=limit)


def stations_figure(seen: Sequence[Seen]) -> Figure:
    """Return the most stations at 10 ms that *seen* found good."""
    name = "most stations at 10 ms"
    cases = [(case[0] + 1, observation) for case, observation in seen]
    if not _is_good(cases[0][1]):
        return report(name, "none of those tried")
    value = max(stations for stations, observation in cases if _is_good(observation))
    detail, limit = _said(cases, " stations")
    return at_least(name, value, 300, detail, limit=limit, unit=" stations")


def _said(cases: Sequence[tuple[int, Observation]], unit: str) -> tuple[str, str]:
    """Return the engine's share at the last good case, and the failure behind it."""
    good = [observation for _, observation in cases if _is_good(observation)]
    detail = f"engine {good[-1].cpu['engine']:.0%} of a core"
    failed, why = cases[-1]
    if _is_good(why):
        return detail, "none found"
    share = f"{why.overruns / max(why.cycles, 1):.1%}"
    return detail, f"at {failed}{unit} {share} of the cycles left out, {why.lost} frames lost"


def _search(
    settings: Settings, link: Cable | None, folder: Path, cases: Sequence[Case]
) -> list[Seen]:
    """Return what was seen up to and including the first case that failed twice."""
    seen: list[Seen] = []
    for islands, cycle_us in cases:
        settings.tell(f"limits: {islands + 1} stations at {cycle_us} µs")
        plant = folder / f"line-{islands}-{cycle_us}.yaml"
        plant.write_bytes(line(islands, cycle_us))
        observation = observe(plant, settings.search_s, link)
        if not _is_good(observation):  # once may be the machine
            observation = observe(plant, settings.search_s, link)
        seen.append(((islands, cycle_us), observation))
        if not _is_good(observation):
            break
    return seen


def _is_good(seen: Observation) -> bool:
    return seen.lost == 0 and seen.received > 0 and seen.overruns <= LEFT_OUT * seen.cycles
