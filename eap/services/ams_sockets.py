"""Sockets for AMS: TCP 48898, and UDP 48899 for tools that look for routers.

Each follows the ports that share it: a port that comes or goes changes nothing for the others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from eap.ams.spec import TransportKind
from eap.ams.transport_table import Transport
from eap.runtime.handover import NO_DESCRIPTOR, PortName, SharedSocket, SocketKind
from eap.services.network import Network, stations_of
from eap.services.routing.remote_routers import RouterRequests
from eap.services.socket_table import owned_copy
from eap.services.transports.ams_discovery import AmsDiscovery, RouteAdmin, RouterName
from eap.services.transports.ams_tcp import AmsClients, AmsTransport
from eap.services.transports.demultiplexer import Demultiplexer

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
