"""The stations of one plant that run here, and what they can be asked about their configuration."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec

from eap.aoe.spec import RoutingSpec
from eap.appliance.commands.client import Client, connect_those
from eap.appliance.commands.routing_link import RoutingLink
from eap.appliance.control import ErrorCode
from eap.config.load import Plant
from eap.errors import ControlError
from eap.pd.spec import StationSpec

PATIENCE_S = 60.0
"""For one station: it is checked, stored, and built anew between two cycles."""


class StationPlan(msgspec.Struct, frozen=True):
    """What differs between a running station and its plant file."""

    station: str
    changes: list[dict[str, Any]]
    """Objects of its ports: port, index, subindex, name, change, old, new."""
    notes: list[str]
    """What is no object: sources, links, buses, routes, access rules."""
    refused: list[str]
    """Why it cannot be as the file says."""

    @property
    def differs(self) -> bool:
        """Whether there is anything to do, or to refuse."""
        return bool(self.changes or self.notes or self.refused)


class Outcome(msgspec.Struct, frozen=True):
    """What became of a change of one station."""

    ok: bool
    results: list[dict[str, Any]]
    """As the changes of a plan, each with *ok* and *reason*."""
    refused: list[str]


class Running(msgspec.Struct, frozen=True):
    """What a station runs, and what a rollback would bring back, if anything."""

    spec: StationSpec
    previous: StationSpec | None = None
    """Before the last change, alternates aside."""
    cause: str = ""
    """Which change that was; those of later ones sort behind."""
    undone: bool = False
    """Whether it was taken back."""


class PlantLink:
    """Connections to all appliances that run stations of a plant.

    Args:
        clients: The appliance of each station.
        file: The plant file.
        absent: Its stations that do not run here.
        routing: What it says of their routers.
        audit_required: Whether it wants changes refused that cannot be recorded.

    Attributes:
        file: The plant file, as it was named.
        routing: Asks about routers.
    """

    def __init__(
        self,
        clients: Mapping[str, Client],
        file: Path,
        absent: tuple[str, ...] = (),
        routing: Mapping[str, RoutingSpec] = MappingProxyType({}),
        *,
        audit_required: bool = False,
    ) -> None:
        self.routing = RoutingLink(self._ask, routing)
        self._clients = clients
        self._audit_required = audit_required
        self.file = file
        self._file = str(file.resolve())
        self.absent = absent

    @property
    def stations(self) -> tuple[str, ...]:
        """Those that run here."""
        return tuple(self._clients)

    def export(self, station: str) -> Running:
        """Return what a station runs; raises as the other methods do.

        Raises:
            ControlError: the appliance refused, or does not answer.
        """
        return msgspec.convert(self._ask("export", station), Running)

    def plan(self, spec: StationSpec) -> StationPlan:
        """Return what differs between *spec* and the station of its name."""
        answer = self._ask("plan", spec.name, spec=msgspec.to_builtins(spec))
        router = self.routing.plan(spec.name)
        notes, refused = answer["station"] + router.changes, answer["refused"] + router.refused
        if self._clients[spec.name].info.audit_required != self._audit_required:
            duty = "required" if self._audit_required else "optional"
            refused += [f"access: audit becomes {duty}: this needs a new start of the appliance"]
        return StationPlan(spec.name, answer["changes"], notes, refused)

    def apply(self, spec: StationSpec, cause: str) -> Outcome:
        """Let the station of its name be as *spec* says, as a step of the change named *cause*."""
        where = {"cause": cause, "file": self._file}
        answer = self._ask("apply", spec.name, spec=msgspec.to_builtins(spec), **where)
        return msgspec.convert(answer, Outcome)

    def rollback(self, spec: StationSpec) -> Outcome:
        """Let the station of its name be *spec*: what it was before, or is, alternates aside."""
        answer = self._ask("rollback", spec.name, spec=msgspec.to_builtins(spec))
        return msgspec.convert(answer, Outcome)

    def _ask(self, method: str, station: str, **params: Any) -> Any:
        client = self._clients[station]
        return client.request_within(PATIENCE_S, method, station=station, **params)


@contextmanager
def link_to(plant: Plant, file: Path) -> Iterator[PlantLink]:
    """Connect to the appliances that run stations of *plant*, for the length of a block.

    Blank stations belong to every plant that has a station of their name.

    Raises:
        ControlError: none of its stations runs here.
    """
    names = {station.name for station in plant.stations}
    clients = connect_those(
        lambda info: (
            info.plant == plant.name if info.plant_file else not names.isdisjoint(info.stations)
        )
    )
    try:
        found = {name: each for each in clients for name in each.info.stations if name in names}
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
    finally:
        for client in clients:
            client.close()
