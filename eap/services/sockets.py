"""All transports of the services process, on the sockets that the supervisor opened.

Each socket has one user by its kind, in ``mailbox_sockets`` or ``ams_sockets``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

from eap.pd.handover import PortChanges
from eap.pd.spec import StationSpec
from eap.runtime.handover import PortName, SharedSocket, SocketKind
from eap.services.ams_sockets import AmsStations, AmsTcpSocket, AmsUdpSocket
from eap.services.mailbox_sockets import (
    EthernetSocket,
    GatewayTcpSocket,
    GatewayUdpSocket,
    GroupSocket,
    TcpSocket,
    UdpSocket,
)
from eap.services.network import Network, OpenSocketUser
from eap.services.tasks import keep_serving
from eap.services.transports.ams_tcp import AmsUplinks

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
