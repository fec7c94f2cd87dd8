"""Network side of services: what all transports on the supervisor's sockets have in common."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterable, Mapping, Sequence
from time import monotonic_ns
from typing import Protocol

from eap.ams.transport_table import Transport
from eap.net.ethernet import EthernetInterface
from eap.net.interface import link_is_up
from eap.net.ipsocket import AddressKeeper
from eap.net.mmsg import ReceiveBatch
from eap.runtime.drop_counters import DropCounters, DropReason
from eap.runtime.handover import PortName, SharedSocket
from eap.services.gateway.gateway_transport import GatewayTable
from eap.services.routing.service import TransportSender
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes
from eap.services.socket_table import SocketTable
from eap.services.transports.accepting import Listeners
from eap.services.transports.route_logins import RouteLogins


class ServedTransport(Protocol):
    """Transport with a task of its own, such as a listener."""

    async def serve(self) -> None:
        """Serve until cancelled."""


class OpenSocketUser(Protocol):
    """User of one open socket, for the ports that share it."""

    @property
    def listener(self) -> ServedTransport | None:
        """Transport to be served, if the socket is a listener."""

    def release(self, owner: PortName) -> None:
        """Remove what belongs to a port alone: it goes, or changes."""

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve *owners*, of which some may be new."""

    def close(self) -> None:
        """Close the socket, which no port needs any more."""


class Network:
    """Routers, gateways and counters that all transports of the process are opened with.

    Args:
        table: The open sockets.
        routers: Of the stations, by name.
        routes: Of these routers; tools may add some.
        gateways: To the buses.
        counters: Of dropped frames and closed connections.
        listeners: Of this process.
        engine: Link to the engine, for connections that belong there.
        route_logins: Of requests for routes.

    Attributes:
        links: Watches the interfaces.
        batch: Buffers of all UDP channels: only one of them is drained at a time.
        from_ns: Start of this process: older frames are stale.
    """

    def __init__(
        self,
        table: SocketTable,
        routers: Mapping[str, StationRouter],
        routes: Mapping[str, StationRoutes],
        gateways: GatewayTable,
        counters: DropCounters,
        listeners: Listeners,
        engine: socket.socket,
        route_logins: RouteLogins,
    ) -> None:
        self.table = table
        self.routers = routers
        self.routes = routes
        self.gateways = gateways
        self.counters = counters
        self.listeners = listeners
        self.engine = engine
        self.route_logins = route_logins
        self.links = LinkWatch()
        self.batch = ReceiveBatch()
        self.from_ns = monotonic_ns()

    def behind(self, kind: str, owners: Sequence[PortName]) -> list[tuple[StationRouter, str]]:
        """Return the stations of *owners*, each with the name of its transport."""
        names = transport_names(kind, owners)
        return [(self.routers[station], name) for station, name in names.items()]

    def own_transport(self, kind: str, shared: SharedSocket) -> dict[str, str]:
        """Return the station of the port number of a gateway, with the name of its transport."""
        (owner,) = shared.owners
        spec = next(each for each in self.table.stations if each.name == owner.station)
        name = next(port.name for port in spec.ports if port.interface.host == shared.address)
        return {owner.station: f"{kind}:{name}"}

    def drop_counter(self, stations: Sequence[str]) -> Callable[[DropReason], None]:
        """Return the function that counts a reason at each of *stations*, which may change."""

        def count_dropped(reason: DropReason) -> None:
            for station in stations:
                self.counters.count(station, reason)

        return count_dropped


class PortTransports:
    """Transports of the ports that share a socket, at the routers of their stations."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._names: dict[PortName, str] = {}

    def __contains__(self, owner: object) -> bool:
        return owner in self._names

    def add(
        self, owner: PortName, transport: Transport, sender: TransportSender, interface: str = ""
    ) -> None:
        """Add the transport of a port, whose *interface* is watched if it has one."""
        router = self._network.routers[owner.station]
        router.add_transport(transport, sender)
        self._names[owner] = transport.name
        if interface:
            self._network.links.add(interface, router, transport.name)

    def remove(self, owner: PortName) -> None:
        """Remove the transport of a port; requests that wait for its hops fail."""
        if (name := self._names.pop(owner, None)) is not None:
            router = self._network.routers[owner.station]
            self._network.links.remove(router, name)
            router.hop_up(name, None)  # a removed transport has no state
            router.remove_transport(name)

    def clear(self) -> None:
        """Remove all."""
        for owner in [*self._names]:
            self.remove(owner)


def transport_names(kind: str, owners: Sequence[PortName]) -> dict[str, str]:
    """Return the transport of each station of *owners*: that of its first port."""
    names: dict[str, str] = {}
    for owner in owners:
        names.setdefault(owner.station, f"{kind}:{owner.port}")
    return names


def stations_of(owners: Iterable[PortName]) -> list[str]:
    """Return the stations of *owners*, each once."""
    return list(dict.fromkeys(owner.station for owner in owners))


LINK_POLL_S = 0.2
"""Interval between two polls of the links."""


class LinkWatch:
    """Link state of the interfaces: a pulled cable takes the hops of their transports down.

    Interfaces that were deleted and made again are joined again.

    Args:
        is_up: Returns whether the link of an interface is up.

    Attributes:
        addresses: What sockets have at the interfaces of local addresses.
    """

    def __init__(self, is_up: Callable[[str], bool] = link_is_up) -> None:
        self.addresses = AddressKeeper(self._notify)
        self._interfaces: list[EthernetInterface] = []
        self._transports: dict[str, list[tuple[StationRouter, str]]] = {}
        self._is_up = is_up
        self._down: set[str] = set()
        self._added = asyncio.Event()

    def add(self, interface: str, router: StationRouter, transport: str) -> None:
        """Watch *interface* for one transport of *router*."""
        self._transports.setdefault(interface, []).append((router, transport))
        if interface in self._down:
            router.hop_down(transport, None, _no_link(interface))
        self._notify()

    def remove(self, router: StationRouter, transport: str) -> None:
        """Watch no interface for a transport any more."""
        for interface, watched in list(self._transports.items()):
            watched[:] = [each for each in watched if each != (router, transport)]
            if not watched:
                del self._transports[interface]
                self._down.discard(interface)

    def find_again(self, interface: EthernetInterface) -> None:
        """Look for *interface* by its name while it is lost."""
        self._interfaces.append(interface)
        self._notify()

    def forget(self, interface: EthernetInterface) -> None:
        """Look for *interface* no more."""
        self._interfaces.remove(interface)

    async def serve(self) -> None:
        """Poll until cancelled, while there is any interface."""
        while True:
            if self._transports or self._interfaces or not self.addresses.is_empty:
                self.poll()
                await asyncio.sleep(LINK_POLL_S)
            else:
                self._added.clear()
                await self._added.wait()

    def poll(self) -> None:
        """Join interfaces that were made again; notify the routers of changed links."""
        self.addresses.look()
        for ethernet in self._interfaces:
            ethernet.find()
        for interface, transports in self._transports.items():
            is_up, was_up = self._is_up(interface), interface not in self._down
            if is_up and not was_up:
                self._down.discard(interface)
                for station, transport in transports:
                    station.hop_up(transport, None)
            elif was_up and not is_up:
                self._down.add(interface)
                for station, transport in transports:
                    station.hop_down(transport, None, _no_link(interface))

    def _notify(self) -> None:
        self._added.set()


def _no_link(interface: str) -> str:
    return f"interface {interface} has no link"
