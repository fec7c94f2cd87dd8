"""A running plant becomes what its file says, station by station, and what it was before.

Rule 1: all stations are asked what they think of it before the first one is changed.
Rule 2: the order is that of :mod:`eap.device.rollout`: whoever receives takes a new layout beside
the old one before anybody sends it.
Rule 3: what a station refuses ends it, unless told to go on with the other stations.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TypeAlias

import msgspec

from eap.appliance.commands.plant_link import Outcome, PlantLink, StationPlan
from eap.appliance.control_routing import RoutingDifference
from eap.appliance.plantfile import load_plant
from eap.appliance.store import new_cause
from eap.config.load import Plant
from eap.device.rollout import Step, steps, without_alternates
from eap.errors import ConfigError
from eap.near import near
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
        ConfigError: the plant has no such station, or it does not run here; the message has the
            command that starts it.
    """
    known = {station.name: station for station in plant.stations}
    for name in wanted:
        if name not in known:
            raise ConfigError(f"plant {plant.name} has no station {name!r}{near(name, known)}")
        if name not in link.stations:
            running = ", ".join(link.stations)
            raise ConfigError(
                f"station {name} does not run here; of its plant run {running};"
                f" start it with '{start_command(link.file, [name])}'"
            )
    return {name: known[name] for name in wanted or link.stations}


def start_command(file: Path, stations: Iterable[str]) -> str:
    """Return the command that runs *stations* of a plant file."""
    words = ["eapctl", "run", str(file)]
    for name in stations:
        words += ["--station", name]
    return shlex.join(words)


def plan_all(link: PlantLink, wanted: Mapping[str, StationSpec]) -> list[StationPlan]:
    """Return what differs at each of *wanted*; raises as PlantLink does."""
    return [link.plan(spec) for spec in wanted.values()]


def steps_to(link: PlantLink, wanted: Mapping[str, StationSpec]) -> list[Step]:
    """Return in which order the stations become what is *wanted*."""
    running = {name: link.export(name).spec for name in link.stations}
    return steps(running, {**running, **wanted})


def apply_steps(
    link: PlantLink,
    order: Iterable[Step],
    *,
    keep_going: bool = False,
    routed: Iterable[str] = (),
) -> Iterator[Done]:
    """Take *order* step by step, and yield what became of each; last the routers of *routed*.

    A station that refused one is asked for nothing more.  What goes on with a change that was
    broken off belongs to it, so that a rollback takes back both.
    """
    running = [link.export(name) for name in link.stations]
    under_way = [each.cause for each in running if _is_under_way(each.spec)]
    cause = max(under_way, default="") or new_cause()
    refused = set()
    for done in _walk(order, partial(link.apply, cause=cause), keep_going=keep_going):
        yield done
        if not done.outcome.ok:
            refused.add(done.station)
    if keep_going or not refused:
        names = [name for name in routed if name not in refused]
        yield from _tell_routers(
            [name for name in names if link.routing.plan(name).changes],
            partial(link.routing.apply, cause=cause),
        )


def roll_back(
    link: PlantLink, stations: Iterable[str], *, keep_going: bool = False
) -> Iterator[Done]:
    """Take the last change of *stations* back, and yield what became of each step.

    Those that it did not change are left alone.  If it was taken back everywhere, and nothing is
    left to do, it is made again.
    """
    running = {name: link.export(name) for name in link.stations}
    now = {name: each.spec for name, each in running.items()}
    goal = {name: without_alternates(now[name]) for name in stations}
    known = {name: running[name] for name in goal if running[name].previous is not None}
    routers = {name: told for name in goal if (told := link.routing.export(name)) is not None}
    routers = {name: told for name, told in routers.items() if told.previous is not None}
    causes = [each.cause for each in known.values()] + [each.cause for each in routers.values()]
    last = max(causes, default="")
    part = {name: each for name, each in known.items() if each.cause == last}
    left = {n: each for n, each in part.items() if not each.undone and each.previous != goal[n]}
    routed = [name for name, told in routers.items() if told.cause == last]
    told_left = [name for name in routed if not routers[name].undone]
    if not (left or told_left or any(_is_under_way(each.spec) for each in part.values())):
        left, told_left = part, routed
    goal |= {name: each.previous for name, each in left.items() if each.previous is not None}
    back = _walk(steps(now, {**now, **goal}), link.rollback, keep_going=keep_going)
    return chain(back, _tell_routers(told_left, link.routing.rollback))


def _is_under_way(spec: StationSpec) -> bool:
    return any(pd.alternates for pd in spec.subscriptions)


def _tell_routers(
    stations: Iterable[str], tell: Callable[[str], RoutingDifference]
) -> Iterator[Done]:
    for name in stations:
        told = tell(name)
        outcome = Outcome(ok=not told.refused, results=[], refused=told.refused)
        yield Done(name, f"({', '.join(told.changes) or 'routes'})", outcome)


def _walk(order: Iterable[Step], do: Do, *, keep_going: bool) -> Iterator[Done]:
    refused: set[str] = set()
    for step in order:
        if step.station in refused:
            continue
        outcome = do(step.spec)
        yield Done(step.station, step.why, outcome)
        if not outcome.ok:
            refused.add(step.station)
            if not keep_going:
                return
