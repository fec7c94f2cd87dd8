"""All transports of the services process, on the sockets that the supervisor opened.

Each socket has one user by its kind, here or in ``mailbox_sockets``.  Sockets for AMS (TCP 48898,
and UDP 48899 for tools that look for routers) follow the ports that share them: a port that comes
or goes changes nothing for the others.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Sequence
from functools import partial
from typing import TYPE_CHECKING

from eap.ams.spec import TransportKind
from eap.ams.transport_table import Transport
from eap.pd.handover import PortChanges
from eap.pd.spec import StationSpec
from eap.runtime.handover import NO_DESCRIPTOR, PortName, SharedSocket, SocketKind
from eap.services.mailbox_sockets import (
    EthernetSocket,
    GatewayTcpSocket,
    GatewayUdpSocket,
    GroupSocket,
    TcpSocket,
    UdpSocket,
)
from eap.services.network import Network, OpenSocketUser, stations_of
from eap.services.routing.remote_routers import RouterRequests
from eap.services.socket_table import owned_copy
from eap.services.tasks import keep_serving
from eap.services.transports.ams_discovery import AmsDiscovery, RouteAdmin, RouterName
from eap.services.transports.ams_tcp import AmsClients, AmsTransport, AmsUplinks
from eap.services.transports.demultiplexer import Demultiplexer

if TYPE_CHECKING:
    from eap.services.transports.secure_listener import SecureListeners


class Transports:
    """All transports of the process, which follow the ports of the stations.

    Args:
        network: What they are opened with.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        ams = AmsStations(network)
        self._openers: dict[SocketKind, Callable[[Network, SharedSocket], OpenSocketUser]] = {
            # Unicast first: answers to frames of a group go out by the socket of the unicast
            # address.
            SocketKind.UDP: UdpSocket,
            SocketKind.GROUP: GroupSocket,
            SocketKind.PACKET: EthernetSocket,
            SocketKind.AMS_UDP: AmsUdpSocket,
            SocketKind.GATEWAY_UDP: GatewayUdpSocket,
            SocketKind.TCP: TcpSocket,
            SocketKind.GATEWAY_TCP: GatewayTcpSocket,
            SocketKind.AMS_TCP: partial(AmsTcpSocket, ams),
        }
        self._open: dict[SharedSocket, OpenSocketUser] = {}
        self._tasks: dict[SharedSocket, asyncio.Task[None]] = {}
        self._group: asyncio.TaskGroup | None = None
        self._sources = {station.name: _addresses_of(station) for station in network.table.stations}
        self._follow_sockets()
        self._uplinks = {
            station.name: AmsUplinks(
                network.routers[station.name],
                self._sources[station.name],
                network.drop_counter([station.name]),
                network.routes[station.name].secure_settings,
            )
            for station in network.table.stations
        }
        self._secure: dict[str, SecureListeners] = {}
        self._ams = {station.name: _ams_addresses_of(station) for station in network.table.stations}
        for name in self._uplinks:
            network.routes[name].on_spec.append(partial(self._follow_secure, name))

    async def serve(self) -> None:
        """Serve all of them until cancelled."""
        try:
            async with asyncio.TaskGroup() as self._group:
                for key in self._open:
                    self._start(key)
                for name, uplinks in self._uplinks.items():
                    self._group.create_task(keep_serving(uplinks.serve))
                    self._follow_secure(name)
                self._group.create_task(keep_serving(self._network.links.serve))
                await asyncio.Event().wait()
        finally:
            self._group = None
            self._secure.clear()

    async def follow(self, station: StationSpec, changes: PortChanges) -> None:
        """Close and open transports after the ports of *station* have changed."""
        released = {PortName(station.name, port.name) for port in changes.gone}
        wanted = {each.key: each for each in self._network.table.sockets}
        leaving = [key for key in self._open if key not in wanted]
        tasks = [self._tasks.pop(key) for key in leaving if key in self._tasks]
        for task in tasks:
            task.cancel()
        # Their connections end first, while the routers still know them.
        await asyncio.gather(*tasks, return_exceptions=True)
        # From here on nothing waits: no packet meets a transport without its port.
        for key in leaving:
            self._open.pop(key).close()
        for user in self._open.values():
            for owner in released:
                user.release(owner)
        self._sources[station.name][:] = _addresses_of(station)
        self._ams[station.name][:] = _ams_addresses_of(station)
        self._follow_secure(station.name)
        self._follow_sockets()

    def close(self) -> None:
        """Close all sockets, which are not served any more."""
        for user in self._open.values():
            user.close()
        self._open.clear()

    def _follow_sockets(self) -> None:
        """Open new sockets; have the open ones serve their present owners."""
        sockets = self._network.table.sockets
        for kind, opener in self._openers.items():
            for shared in sockets:
                if shared.kind is not kind:
                    continue
                if (user := self._open.get(shared.key)) is not None:
                    user.follow(shared.owners)
                else:
                    self._open[shared.key] = opener(self._network, shared)
                    self._start(shared.key)

    def _follow_secure(self, station: str) -> None:
        """Have the listeners and connections of Secure ADS that *station* is configured for."""
        routes = self._network.routes[station]
        self._uplinks[station].follow()
        if station in self._secure:
            self._secure[station].follow()
        elif routes.spec.secure is not None and self._group is not None:
            # Imported here: few plants have it.
            from eap.services.transports.secure_listener import SecureListeners

            secure = self._secure[station] = SecureListeners(
                routes,
                self._ams[station],
                self._network.drop_counter([station]),
                self._network.listeners,
                self._network.route_logins,
            )
            self._group.create_task(keep_serving(secure.serve))

    def _start(self, key: SharedSocket) -> None:
        listener = self._open[key].listener
        if self._group is not None and listener is not None and key not in self._tasks:
            self._tasks[key] = self._group.create_task(keep_serving(listener.serve))


def _ams_addresses_of(station: StationSpec) -> list[str]:
    """Return the addresses where *station* serves AMS, each once."""
    uris = (port.interface for port in station.ports if port.ams)
    return list(dict.fromkeys(uri.host for uri in uris if uri.scheme in {"udp", "tcp"}))


def _addresses_of(station: StationSpec) -> list[str]:
    uris = (port.interface for port in station.ports)
    return [uri.host for uri in uris if uri.scheme in {"udp", "tcp"}]


AMS_TRANSPORT = TransportKind.AMS_TCP
"""Name of the transport of all clients that connect to AMS/TCP."""


class AmsStations:
    """AMS/TCP transports of the stations: one of each for the clients of all of its addresses."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._users: dict[str, set[object]] = {}
        self.clients = AmsClients()

    def use(self, user: object, stations: Collection[str]) -> None:
        """Have the transports of *stations*, and no others, for the listener *user*."""
        for station in stations:
            if not self._users.setdefault(station, set()):
                transport = Transport(AMS_TRANSPORT, is_stream=True, is_hub=True)
                self._network.routers[station].add_transport(transport, self.clients)
            self._users[station].add(user)
        for station, users in self._users.items():
            if station not in stations and user in users:
                users.remove(user)
                if not users:
                    self._network.routers[station].remove_transport(AMS_TRANSPORT)


class AmsTcpSocket:
    """AMS/TCP listener of an address."""

    def __init__(self, ams: AmsStations, network: Network, shared: SharedSocket) -> None:
        self._ams = ams
        self._network = network
        self._stations: list[str] = []
        self._demultiplexer = Demultiplexer([])
        self.listener = AmsTransport(
            owned_copy(shared.services_fd),
            self._demultiplexer,
            ams.clients,
            network.drop_counter(self._stations),
            network.listeners,
        )
        self.follow(shared.owners)

    def release(self, owner: PortName) -> None:
        """Remove nothing: the transport is that of the station."""

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve *owners*."""
        self._stations[:] = stations_of(owners)
        self._ams.use(self, self._stations)
        routers = self._network.routers
        self._demultiplexer.follow(
            [(routers[station], AMS_TRANSPORT) for station in self._stations]
        )

    def close(self) -> None:
        """Close the listener, whose connections have ended."""
        self._ams.use(self, ())
        self.listener.close()


class AmsUdpSocket:
    """UDP 48899 socket of an address, and those for broadcasts to its network."""

    listener = None

    def __init__(self, network: Network, shared: SharedSocket) -> None:
        self._network = network
        self._sock = owned_copy(shared.services_fd)
        self._broadcasts = []
        for other in network.table.sockets:
            # A socket that is bound to a unicast address receives no broadcasts.
            is_broadcast = other.kind is SocketKind.AMS_BROADCAST
            is_same = is_broadcast and other.address == shared.address
            if is_same and other.services_fd != NO_DESCRIPTOR:
                self._broadcasts.append(owned_copy(other.services_fd))
                network.links.addresses.keep_interface(self._broadcasts[-1], other.address)
        self._stations: list[str] = []
        self._requests: RouterRequests | None = None
        self._discovery: AmsDiscovery | None = None
        self.follow(shared.owners)

    def release(self, owner: PortName) -> None:
        """Remove nothing: the socket serves stations."""

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve the stations of *owners*."""
        network, names = self._network, stations_of(owners)
        if names == self._stations:
            return
        self._stop()
        self._stations = names
        routers = [RouterName(name, network.routers[name].net_id) for name in names]
        self._requests = RouterRequests(self._sock, [router.net_id for router in routers])
        self._discovery = AmsDiscovery(
            self._sock,
            routers,
            RouteAdmin([network.routes[name] for name in names], network.route_logins),
            self._requests,
            network.drop_counter(names),
        )
        self._discovery.watch()
        for sock in self._broadcasts:
            self._discovery.watch(sock)
        for name in names:
            network.routes[name].scanners.append(self._requests)

    def close(self) -> None:
        """Close the sockets."""
        self._stop()
        for sock in self._broadcasts:
            self._network.links.addresses.forget(sock)
            sock.close()
        self._sock.close()

    def _stop(self) -> None:
        if self._discovery is not None and self._requests is not None:
            self._discovery.stop()
            for name in self._stations:
                self._network.routes[name].scanners.remove(self._requests)
