"""Changes of a running plant by its plant file.

Rule 1: all stations make a plan before the first one is changed.
Rule 2: the order is that of :mod:`eap.device.rollout`: a receiver takes a new layout beside the old
one before anything sends it.
Rule 3: a refusal by a station ends the change, unless ``keep_going`` is set.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol, Self, TypeAlias

import msgspec

from eap.ams.spec import RoutingSpec
from eap.config.load import Plant
from eap.control import device as protocol
from eap.control.device import (
    ApplyAnswer,
    ChangeResult,
    ObjectChange,
    RoutingDifference,
    RunningRouting,
    RunningSpec,
)
from eap.control.protocol import AnswerT, ErrorCode, Method, ParametersT
from eap.device.rollout import Step, steps, without_alternates
from eap.errors import ConfigError, ControlError
from eap.ids import encode_value
from eap.ops.client import ControlClient, connect_those
from eap.pd.spec import StationSpec
from eap.runtime.folder import ApplianceInfo
from eap.runtime.plantfile import load_plant
from eap.runtime.store import lean, new_cause
from eap.suggest import suggest

STATION_S = 60.0
"""Time for one station: it is checked, stored, and built anew between two cycles."""

Do: TypeAlias = Callable[[StationSpec], ApplyAnswer]


class StationPlan(msgspec.Struct, frozen=True):
    """Difference between a running station and its plant file.

    Attributes:
        station: Its name.
        changes: Of the objects of its ports.
        notes: Differences beside the objects: sources, links, buses, routes, access rules.
        refused: Reasons why the file cannot be applied.
    """

    station: str
    changes: list[ObjectChange]
    notes: list[str]
    refused: list[str]

    @property
    def differs(self) -> bool:
        """True if there is anything to do, or to refuse."""
        return bool(self.changes or self.notes or self.refused)


class AwayHost(msgspec.Struct, frozen=True):
    """Host of a plant whose stations cannot be changed now, and why."""

    host: str
    stations: tuple[str, ...]
    reason: str


class StepOutcome(msgspec.Struct, frozen=True):
    """Result of one step."""

    station: str
    why: str
    outcome: ApplyAnswer


class PlannedStep(msgspec.Struct, frozen=True):
    """Step of a future ``apply``."""

    station: str
    why: str


class PlanReport(msgspec.Struct, frozen=True):
    """``eapctl plan``; *absent* are stations of a plant of one host that do not run here."""

    ok: bool
    stations: list[StationPlan]
    steps: list[PlannedStep]
    absent: tuple[str, ...]
    away: tuple[AwayHost, ...] = ()

    @classmethod
    def of(
        cls,
        plans: list[StationPlan],
        order: Iterable[Step],
        absent: tuple[str, ...],
        away: tuple[AwayHost, ...] = (),
    ) -> Self:
        """Return the report of *plans* and the steps in *order*."""
        steps = [PlannedStep(step.station, step.why) for step in order]
        is_ok = not (away or any(each.refused for each in plans))
        return cls(is_ok, plans, steps, absent, away)


class TakenStep(msgspec.Struct, frozen=True):
    """Step of a change that was tried."""

    station: str
    why: str
    ok: bool
    results: list[ChangeResult]
    refused: list[str]


class RefusingStation(msgspec.Struct, frozen=True):
    """Station that cannot change while it runs, and why."""

    station: str
    refused: list[str]


class ChangeReport(msgspec.Struct, frozen=True):
    """``eapctl apply`` and ``rollback``.

    Attributes:
        ok: Whether all is done.
        steps: Steps that were tried.
        refused: Stations that cannot change while they run.
        error: Reason of an interruption.
        away: Hosts that could not be reached.
        undone: Steps that took a failed change of several hosts back.
    """

    ok: bool
    steps: list[TakenStep]
    refused: list[RefusingStation]
    error: str | None
    away: tuple[AwayHost, ...] = ()
    undone: list[TakenStep] = []

    @classmethod
    def of(
        cls,
        taken: Iterable[StepOutcome],
        refusing: Mapping[str, list[str]],
        error: ControlError | None,
        away: tuple[AwayHost, ...] = (),
        undone: Iterable[StepOutcome] = (),
    ) -> Self:
        """Return the report of all steps *taken*."""
        steps = _taken(taken)
        is_ok = not (refusing or error or away) and all(step.ok for step in steps)
        refused = [RefusingStation(name, why) for name, why in refusing.items()]
        reason = None if error is None else str(error)
        return cls(is_ok, steps, refused, reason, away, _taken(undone))


def _taken(outcomes: Iterable[StepOutcome]) -> list[TakenStep]:
    return [
        TakenStep(
            each.station,
            each.why,
            each.outcome.ok,
            each.outcome.results,
            each.outcome.refused,
        )
        for each in outcomes
    ]


class ApplianceClient(Protocol):
    """Client of one appliance, of this host or of another one."""

    info: ApplianceInfo

    def call(
        self, method: Method[ParametersT, AnswerT], /, *, within_s: float, **params: Any
    ) -> AnswerT:
        """Return the answer to *method*; raise ControlError if it is refused or does not come."""


class PlantLink:
    """Connections to all appliances that run stations of a plant.

    Args:
        clients: The appliance of each station.
        file: The plant file.
        absent: Its stations that do not run here.
        routing: Configuration of their routers in it.
        audit_required: Changes that the audit cannot record are refused.
        remote: Stations of other hosts, whose plant file is another one.
        away: Hosts that cannot be reached.

    Attributes:
        file: The plant file, as it was named.
        absent: As given.
        away: As given.

    Raises:
        ControlError: (every method) the appliance refused, or does not answer.
    """

    def __init__(
        self,
        clients: Mapping[str, ApplianceClient],
        file: Path,
        absent: tuple[str, ...] = (),
        routing: Mapping[str, RoutingSpec] = MappingProxyType({}),
        *,
        audit_required: bool = False,
        remote: Collection[str] = (),
        away: tuple[AwayHost, ...] = (),
    ) -> None:
        self._clients = clients
        self._remote = remote
        self.away = away
        self._routing = routing
        self._audit_required = audit_required
        self.file = file
        self._file = str(file.resolve())
        self.absent = absent

    @property
    def stations(self) -> tuple[str, ...]:
        """Those that run here, or on other hosts that are reached."""
        return tuple(self._clients)

    @property
    def hosts(self) -> dict[str, str]:
        """Host of each station; none for a plant of one host."""
        return {
            name: client.info.host for name, client in self._clients.items() if client.info.host
        }

    def sections_to_restart(self, plant: Plant) -> dict[str, list[str]]:
        """Return the keys of *plant* that the appliances here run otherwise, by their plants.

        They are for optional processes, which only begin with the appliance.
        """
        hosts = {each.name: each for each in plant.hosts}
        found: dict[str, list[str]] = {}
        for name, client in self._clients.items():
            info = client.info
            if name in self._remote or info.sections is None or not info.plant_file:
                continue
            own = plant.on_host(hosts[info.host]) if info.host in hosts else plant
            wanted = own.section_digests()
            if keys := [
                key
                for key in dict.fromkeys((*wanted, *info.sections))
                if wanted.get(key) != info.sections.get(key)
            ]:
                found[info.plant] = keys
        return found

    def reached(self) -> PlantLink:
        """Return the link to the stations that answer now; the hosts of the others are away."""
        found: dict[str, ApplianceClient] = {}
        away: dict[str, AwayHost] = {}
        for name, client in self._clients.items():
            try:
                self.export(name)
            except ControlError as exc:
                if exc.code != ErrorCode.UNAVAILABLE:
                    raise
                host = client.info.host
                before = away[host].stations if host in away else ()
                away[host] = AwayHost(host, (*before, name), str(exc))
            else:
                found[name] = client
        return PlantLink(
            found,
            self.file,
            self.absent,
            self._routing,
            audit_required=self._audit_required,
            remote=self._remote,
            away=(*self.away, *away.values()),
        )

    def export(self, station: str) -> RunningSpec:
        """Return the specification that a station runs."""
        return self._call(protocol.EXPORT, station)

    def plan(self, spec: StationSpec) -> StationPlan:
        """Return the difference between *spec* and the station of its name."""
        answer = self._call(protocol.PLAN, spec.name, spec=_to_json(spec))
        router = self.plan_routing(spec.name)
        notes, refused = answer.station + router.changes, answer.refused + router.refused
        # Fixed when an appliance starts, so that applying a file cannot switch it off.
        if self._clients[spec.name].info.audit_required != self._audit_required:
            duty = "required" if self._audit_required else "optional"
            refused += [f"access: audit becomes {duty}: restart the appliance"]
        return StationPlan(spec.name, answer.changes, notes, refused)

    def apply(self, spec: StationSpec, cause: str) -> ApplyAnswer:
        """Configure the station of its name by *spec*, as a step of the change named *cause*."""
        # A remote appliance keeps the change as one that its own plant file does not have yet.
        where = {"cause": cause, "file": "" if spec.name in self._remote else self._file}
        return self._call(
            protocol.APPLY,
            spec.name,
            spec=_to_json(spec),
            **where,
        )

    def rollback(self, spec: StationSpec) -> ApplyAnswer:
        """Configure the station of its name by *spec*, which is without alternates."""
        return self._call(protocol.ROLLBACK, spec.name, spec=_to_json(spec))

    def export_routing(self, station: str) -> RunningRouting | None:
        """Return the configuration of a router; None if the plant file has none of it."""
        if station not in self._routing:
            return None
        return self._call(protocol.ROUTING_EXPORT, station)

    def plan_routing(self, station: str) -> RoutingDifference:
        """Return the changes that the plant file makes at a router."""
        if station not in self._routing:
            return RoutingDifference(changes=[], refused=[])
        routing = _to_json(self._routing[station])
        return self._call(protocol.ROUTING_PLAN, station, routing=routing)

    def apply_routing(self, station: str, cause: str) -> RoutingDifference:
        """Configure a router by the plant file, as a step of the change named *cause*."""
        routing = _to_json(self._routing[station])
        return self._call(protocol.ROUTING_APPLY, station, routing=routing, cause=cause)

    def rollback_routing(self, station: str) -> RoutingDifference:
        """Undo the last change of a router, or redo it."""
        return self._call(protocol.ROUTING_ROLLBACK, station)

    def _call(self, method: Method[ParametersT, AnswerT], station: str, **params: Any) -> AnswerT:
        client = self._clients[station]
        return client.call(method, within_s=STATION_S, station=station, **params)


def _to_json(spec: StationSpec | RoutingSpec) -> Any:
    # Without defaults: an appliance of an earlier release does not know the newest fields.
    return msgspec.to_builtins(lean(spec), enc_hook=encode_value)


@contextmanager
def link_to(plant: Plant, file: Path) -> Iterator[PlantLink]:
    """Connect to the appliances that run stations of *plant*, for the length of a block.

    Blank stations belong to every plant that has a station of their name.

    Raises:
        ControlError: none of its stations runs here.
    """
    with ExitStack() as stack:
        found = connect_local(plant, stack)
        if not found:
            command = shlex.join(["eapctl", "run", str(file)])
            raise ControlError(
                f"no station of plant {plant.name} runs here: start them with '{command}'",
                code=ErrorCode.UNAVAILABLE,
            )
        order = [station.name for station in plant.stations]
        here = {name: found[name] for name in order if name in found}
        absent = tuple(name for name in order if name not in found)
        yield PlantLink(here, file, absent, plant.routing, audit_required=plant.audit_required)


def connect_local(plant: Plant, stack: ExitStack) -> dict[str, ControlClient]:
    """Return the appliances of this host by the stations of *plant* that they run.

    Args:
        plant: The plant.
        stack: Closes the connections.
    """
    names = {station.name for station in plant.stations}
    clients = connect_those(
        lambda info: (
            # A blank appliance has no plant file, and the plant that it reports is its own name.
            info.plant == plant.name if info.plant_file else not names.isdisjoint(info.stations)
        )
    )
    for client in clients:
        stack.enter_context(client)
    return {name: each for each in clients for name in each.info.stations if name in names}


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
            raise ConfigError(f"plant {plant.name} has no station {name!r}{suggest(name, known)}")
        for away in link.away:
            if name in away.stations:
                raise ConfigError(f"station {name} is on host {away.host}: {away.reason}")
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
    """Return the differences of each station of *wanted*; raises as PlantLink does."""
    return [link.plan(spec) for spec in wanted.values()]


def steps_to(link: PlantLink, wanted: Mapping[str, StationSpec]) -> list[Step]:
    """Return the order of steps to the specifications *wanted*."""
    # All stations and not only the wanted ones: the others may receive what changes.
    running = {name: link.export(name).spec for name in link.stations}
    return steps(running, {**running, **wanted})


def apply_steps(
    link: PlantLink,
    order: Iterable[Step],
    *,
    keep_going: bool = False,
    routed: Iterable[str] = (),
    cause: str = "",
) -> Iterator[StepOutcome]:
    """Run the steps of *order* and yield the outcome of each; last the routers of *routed*.

    A station that refused a step gets no other.  *cause* names the change, by default as
    :func:`cause_of_change` does.
    """
    cause = cause or cause_of_change(link)
    refused = set()
    for done in _walk(order, partial(link.apply, cause=cause), keep_going=keep_going):
        yield done
        if not done.outcome.ok:
            refused.add(done.station)
    if keep_going or not refused:
        names = [name for name in routed if name not in refused]
        yield from _change_routers(
            [name for name in names if link.plan_routing(name).changes],
            partial(link.apply_routing, cause=cause),
        )


def cause_of_change(link: PlantLink) -> str:
    """Return the name of the next change of the stations of *link*.

    Steps that go on with a change that was broken off belong to it, so that a rollback undoes both.
    """
    running = [link.export(name) for name in link.stations]
    under_way = [each.cause for each in running if _is_under_way(each.spec)]
    # Alternates show that an earlier change was interrupted: this one continues it.
    return max(under_way, default="") or new_cause()


def roll_back(
    link: PlantLink, stations: Iterable[str], *, keep_going: bool = False, cause: str = ""
) -> Iterator[StepOutcome]:
    """Undo the last change of *stations*, and yield the outcome of each step.

    Those that it did not change are left alone.  If it was taken back everywhere, and nothing is
    left to do, it is made again; not if *cause* names the change to undo.
    """
    running = {name: link.export(name) for name in link.stations}
    now = {name: each.spec for name, each in running.items()}
    goal = {name: without_alternates(now[name]) for name in stations}
    known = {name: running[name] for name in goal if running[name].previous is not None}
    routers = {name: routing for name in goal if (routing := link.export_routing(name)) is not None}
    routers = {name: each for name, each in routers.items() if each.previous is not None}
    causes = [each.cause for each in known.values()] + [each.cause for each in routers.values()]
    # Causes are times with leading zeros, so the largest text is the latest change.
    last = max(causes, default="")
    if cause and last != cause:
        return iter(())  # it changed nothing yet
    part = {name: each for name, each in known.items() if each.cause == last}
    left = {n: each for n, each in part.items() if not each.undone and each.previous != goal[n]}
    routed = [name for name, each in routers.items() if each.cause == last]
    routed_left = [name for name in routed if not routers[name].undone]
    is_done = not (left or routed_left or any(_is_under_way(each.spec) for each in part.values()))
    if is_done and not cause:
        # Nothing is left to undo: this rollback undoes the last one.
        left, routed_left = part, routed
    goal |= {name: each.previous for name, each in left.items() if each.previous is not None}
    back = _walk(steps(now, {**now, **goal}), link.rollback, keep_going=keep_going)
    return chain(back, _change_routers(routed_left, link.rollback_routing))


def _is_under_way(spec: StationSpec) -> bool:
    return any(pd.alternates for pd in spec.subscriptions)


def _change_routers(
    stations: Iterable[str], change: Callable[[str], RoutingDifference]
) -> Iterator[StepOutcome]:
    for name in stations:
        done = change(name)
        outcome = ApplyAnswer(not done.refused, [], [], done.refused)
        yield StepOutcome(name, f"({', '.join(done.changes) or 'routes'})", outcome)


def _walk(order: Iterable[Step], do: Do, *, keep_going: bool) -> Iterator[StepOutcome]:
    refused: set[str] = set()
    for step in order:
        if step.station in refused:
            continue
        outcome = do(step.spec)
        yield StepOutcome(step.station, step.why, outcome)
        if not outcome.ok:
            refused.add(step.station)
            # Stopped at once: the steps behind rely on those before them.
            if not keep_going:
                return
