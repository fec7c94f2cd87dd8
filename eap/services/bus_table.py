"""Buses of all stations in services, which come and go while their stations run.

Rule 1: the lines of a bus are opened, and passed to the engine, before a station is to use them.
They are passed with each change: an engine that was started again may lack those of the latest one.
Rule 2: a bus that the engine no longer runs is closed here first, then by the supervisor.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, NamedTuple

from eap.errors import ConfigError, EngineGoneError, EnvironmentalError
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.bus_change import BusOpening, opening_of
from eap.runtime.handover import NO_DESCRIPTOR, BusSocket, PortName
from eap.runtime.passing import pass_bus
from eap.runtime.socket_plan import bus_of, require_own_buses
from eap.services.engine_link import EngineLink
from eap.services.gateway.gateway_transport import GatewayTable
from eap.services.routing.station_router import StationRouter
from eap.services.slaves.segment_link import SegmentLink
from eap.services.supervisor_link import SupervisorLink

if TYPE_CHECKING:
    from eap.services.ads.slave_notifications import SamplingBudget
    from eap.services.gateway.gateway import MailboxGateway
    from eap.services.local_bus import LocalBus
    from eap.services.slaves.bus_client import BusClient


class _BusPort(NamedTuple):
    """A bus port with the values for which, if one changes, its services are opened anew."""

    key: BusSocket
    opening: BusOpening


class BusTable:
    """The buses of the appliance, with their services.

    Args:
        link: To the engine.
        passing: Link that descriptors pass to the engine by.
        supervisor: Opens and closes lines.
        routers: Of the stations, by name.
        on_gateway: Called with each gateway and its bus port before it takes requests.

    Attributes:
        clients: Of all buses, by port; kept up to date, as the others.
        gateways: To all buses.
        segments: Of those with simulated slaves.
    """

    def __init__(
        self,
        link: EngineLink,
        passing: socket.socket,
        supervisor: SupervisorLink,
        routers: Mapping[str, StationRouter],
        on_gateway: Callable[[PortName, MailboxGateway], None],
    ) -> None:
        self.clients: dict[PortName, BusClient] = {}
        self.gateways = GatewayTable()
        self.segments: dict[PortName, SegmentLink] = {}
        self._link = link
        self._passing = passing
        self._supervisor = supervisor
        self._routers = routers
        self._on_gateway = on_gateway
        self._running: dict[_BusPort, LocalBus] = {}
        self._opened: dict[_BusPort, BusSocket] = {}
        """Buses for a change that is under way."""
        self._lines: dict[_BusPort, tuple[BusSocket, list[int]]] = {}
        """Descriptors of the engine for all buses."""
        self._budget: SamplingBudget | None = None

    def start(self, stations: Iterable[StationSpec], buses: Iterable[BusSocket]) -> None:
        """Open the services of all buses at the start of the process."""
        given = {bus.key: bus for bus in buses}
        for station in stations:
            for row, port in _bus_ports(station).items():
                self._keep(row, given[row.key])
                self._add(row, port)
        self._publish(stations)

    async def open(self, spec: StationSpec) -> None:
        """Open the lines of the buses that *spec* has beside the running ones.

        Raises:
            EnvironmentalError: one cannot be opened, and why; none stays open then.
        """
        for row in _bus_ports(spec):
            if row not in self._running:
                self._keep(row, await self._supervisor.open_bus(row.key))

    def pass_to_engine(self, spec: StationSpec) -> None:
        """Pass the engine the lines of all buses of *spec*; those it has do no harm.

        Raises:
            EngineGoneError: it takes none.
        """
        for row in _bus_ports(spec):
            if row in self._lines and not pass_bus(self._passing, *self._lines[row]):
                raise EngineGoneError("the engine takes no lines of buses")

    async def follow(self, spec: StationSpec, stations: Iterable[StationSpec]) -> None:
        """Serve the buses of *spec*, which its station runs, and no others of it.

        *stations* are all specifications, with that one.
        """
        wanted = _bus_ports(spec)
        for row in self._of_station(spec.name):
            if row not in wanted:
                await self._running.pop(row).close()
                self._close_lines(row)
        for row, port in wanted.items():
            if row in self._running:
                self._running[row].follow(port)
            else:
                self._add(row, port)
        self._publish(stations)
        self.close_unused(spec.name)

    def close_unused(self, station: str) -> None:
        """Close the lines that were opened for a change of *station* and are not used."""
        for row in [each for each in self._opened if each.key.owner.station == station]:
            _close(self._opened.pop(row).command_fd)
            self._close_lines(row)
        self._supervisor.keep_buses(station, {row.key for row in self._of_station(station)})

    async def close(self) -> None:
        """Close all."""
        for bus in self._running.values():
            await bus.close()
        for opened in self._opened.values():
            _close(opened.command_fd)
        for row in [*self._lines]:
            self._close_lines(row)

    def _of_station(self, station: str) -> list[_BusPort]:
        return [row for row in self._running if row.key.owner.station == station]

    def _keep(self, row: _BusPort, bus: BusSocket) -> None:
        """Keep the descriptors of a bus, for its services and for an engine that lacks them."""
        self._opened[row] = bus
        lines = [fd for fd in (bus.engine_fd, bus.second_fd) if fd != NO_DESCRIPTOR]
        self._lines[row] = bus, lines

    def _close_lines(self, row: _BusPort) -> None:
        for fd in self._lines.pop(row)[1]:
            os.close(fd)

    def _add(self, row: _BusPort, port: PortSpec) -> None:
        # Imported here: a plant without buses starts with about 76 modules fewer.
        from eap.services.ads.slave_notifications import SamplingBudget
        from eap.services.local_bus import LocalBus

        if self._budget is None:
            self._budget = SamplingBudget()
        owner = row.key.owner
        self._running[row] = LocalBus(
            self._link,
            self._opened.pop(row),
            port,
            self._routers[owner.station],
            self._budget,
            lambda gateway: self._on_gateway(owner, gateway),
        )

    def _publish(self, stations: Iterable[StationSpec]) -> None:
        """Update the tables, in the order of the ports."""
        running = {row.key.owner: bus for row, bus in self._running.items()}
        names = [
            PortName(station.name, port.name)
            for station in stations
            for port in station.ports
            if port.kind is PortKind.BUS
        ]
        ordered = {name: running[name] for name in names if name in running}
        self.clients.clear()
        self.clients.update((name, bus.client) for name, bus in ordered.items())
        self.gateways.replace({name: bus.gateway for name, bus in ordered.items()})
        self.segments.clear()
        self.segments.update(
            (name, bus.segment) for name, bus in ordered.items() if bus.segment is not None
        )


class BusFollower:
    """Has the buses of one station follow the changes of its specification.

    Args:
        table: All buses.
        station: Name of the station.
        specs: What all stations run, by name.
    """

    def __init__(self, table: BusTable, station: str, specs: dict[str, StationSpec]) -> None:
        self._table = table
        self._station = station
        self._specs = specs

    async def open(self, spec: StationSpec) -> None:
        """Open what *spec* needs.

        Raises:
            EnvironmentalError: a line cannot be opened, or another bus has its interface.
        """
        try:
            require_own_buses((self._specs | {self._station: spec}).values())
        except ConfigError as exc:
            raise EnvironmentalError(str(exc)) from None
        await self._table.open(spec)

    async def follow(self, spec: StationSpec) -> None:
        """Serve the buses of *spec*, which the station runs."""
        await self._table.follow(spec, self._specs.values())

    async def discard(self, *, is_engine_gone: bool = False) -> None:
        """Close what was opened for a specification that the station does not run."""
        del is_engine_gone  # the lines of a bus may be opened twice
        self._table.close_unused(self._station)


def _bus_ports(spec: StationSpec) -> dict[_BusPort, PortSpec]:
    ports = (port for port in spec.ports if port.kind is PortKind.BUS)
    return {_BusPort(bus_of(spec.name, port), opening_of(port)): port for port in ports}


def _close(fd: int) -> None:
    if fd != NO_DESCRIPTOR:
        os.close(fd)
