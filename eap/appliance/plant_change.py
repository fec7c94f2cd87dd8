"""A running plant becomes what its file says, station by station, and what it was before.

Rule 1: all stations are asked what they think of it before the first one is changed.
Rule 2: the order is that of :mod:`eap.device.rollout`: whoever receives takes a new layout beside
the old one before anybody sends it.
Rule 3: what a station refuses ends it, unless told to go on with the other stations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import msgspec

from eap.appliance.control import near
from eap.appliance.plant_link import Outcome, PlantLink, StationPlan
from eap.appliance.plantfile import load_plant
from eap.config.load import Plant
from eap.device.rollout import Step, steps, without_alternates
from eap.errors import ConfigError
from eap.pd.spec import StationSpec

Do: TypeAlias = Callable[[StationSpec], Outcome]


class Done(msgspec.Struct, frozen=True):
    """One step and what became of it."""

    station: str
    why: str
    outcome: Outcome


def load_or_raise(file: Path) -> Plant:
    """Return the plant of *file*; raise ConfigError with all findings if it is none."""
    result = load_plant(file)
    if result.plant is None:
        raise ConfigError("\n".join(map(str, result.findings)))
    return result.plant


def choose(plant: Plant, link: PlantLink, wanted: Sequence[str]) -> dict[str, StationSpec]:
    """Return the specifications of *wanted* stations, of all that run here if it is empty.

    Raises:
        ConfigError: the plant has no such station, or it does not run here.
    """
    known = {station.name: station for station in plant.stations}
    for name in wanted:
        if name not in known:
            raise ConfigError(f"plant {plant.name} has no station {name!r}{near(name, known)}")
        if name not in link.stations:
            running = ", ".join(link.stations)
            raise ConfigError(f"station {name} does not run here; of its plant run {running}")
    return {name: known[name] for name in wanted or link.stations}


def plan_all(link: PlantLink, wanted: Mapping[str, StationSpec]) -> list[StationPlan]:
    """Return what differs at each of *wanted*; raises as PlantLink does."""
    return [link.plan(spec) for spec in wanted.values()]


def steps_to(link: PlantLink, wanted: Mapping[str, StationSpec]) -> list[Step]:
    """Return in which order the stations become what is *wanted*."""
    running = {name: link.export(name).spec for name in link.stations}
    return steps(running, {**running, **wanted})


def apply_steps(
    link: PlantLink, order: Iterable[Step], *, keep_going: bool = False
) -> Iterator[Done]:
    """Take *order* step by step, and yield what became of each.

    A station that refused one is asked for nothing more.
    """
    return _walk(((step, link.apply) for step in order), keep_going=keep_going)


def roll_back(
    link: PlantLink, stations: Iterable[str], *, keep_going: bool = False
) -> Iterator[Done]:
    """Bring *stations* back to what they were before, and yield what became of each step.

    Those that were never changed are left alone.
    """
    running = {name: link.export(name) for name in link.stations}
    now = {name: each.spec for name, each in running.items()}
    before = {name: running[name].previous or now[name] for name in stations}
    order = steps(now, {**now, **before})
    return _walk(_back(link, order, before), keep_going=keep_going)


def _back(
    link: PlantLink, order: Iterable[Step], before: Mapping[str, StationSpec]
) -> Iterator[tuple[Step, Do]]:
    """Yield each step with what takes it: ``rollback`` for the one that goes back.

    It brings back the objects of the dictionary too; what comes after it only takes away what was
    received beside.
    """
    is_back: set[str] = set()
    for step in order:
        goes_back = without_alternates(step.spec) == before[step.station]
        yield step, link.rollback if goes_back and step.station not in is_back else link.apply
        if goes_back:
            is_back.add(step.station)


def _walk(walk: Iterable[tuple[Step, Do]], *, keep_going: bool) -> Iterator[Done]:
    refused: set[str] = set()
    for step, do in walk:
        if step.station in refused:
            continue
        outcome = do(step.spec)
        yield Done(step.station, step.why, outcome)
        if not outcome.ok:
            refused.add(step.station)
            if not keep_going:
                return
