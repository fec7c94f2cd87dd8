"""Channels of the EAP ports of an engine: UDP, Ethernet, TCP and lines in memory.

Ports come and go while cycles run.  The thread that rebuilds a station opens the channels of its
new ports, which is slow and changes nothing yet.  The thread of the cycles then enters and removes
ports between two cycles; ports that share a socket with them miss no frame.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable
from time import monotonic_ns
from typing import NamedTuple

from eap.errors import EngineRefusedError
from eap.ids import Destination, DestinationKind
from eap.net.ethernet import EthernetInterface, EthernetPort, packet_batch
from eap.net.limits import CloseReason
from eap.net.loopback import LoopbackChannel, LoopbackLines
from eap.net.mmsg import ReceiveBatch
from eap.net.realtime import descriptor_reserve, spare_descriptors
from eap.net.tcp import TcpReceiver
from eap.net.tcpport import TcpPort
from eap.net.udp import UdpChannel
from eap.pd.link import FrameChannel, FrameHandler
from eap.pd.spec import REQUESTER, PortKind, PortSpec, StationSpec, Wake
from eap.pd.station import Station
from eap.runtime.drop_counters import DropCounterFeed, DropCounters, DropReason
from eap.runtime.handover import PortName, SharedSocket, SocketKind
from eap.runtime.passing import PassedConnection
from eap.runtime.socket_plan import sockets_of

_REFUSALS: dict[str, DropReason] = {
    CloseReason.OVERDUE: DropReason.TCP_SLOW,
    CloseReason.EVICTED: DropReason.TCP_EVICTED,
}
_OF_ENGINE = frozenset((SocketKind.UDP, SocketKind.GROUP, SocketKind.PACKET))


def sends_to(spec: StationSpec, port: str) -> set[str]:
    """Return the destinations to which frames of *port* go by TCP."""
    destinations = {frame.destination for frame in spec.frames if frame.port == port} - {REQUESTER}
    return {each for each in destinations if Destination.parse(each).kind is DestinationKind.TCP}


def has_tcp(spec: StationSpec, port: PortSpec) -> bool:
    """Return whether *port* sends or receives by TCP."""
    return port.tcp or port.interface.scheme == "tcp" or bool(sends_to(spec, port.name))


def engine_sockets(spec: StationSpec) -> list[SharedSocket]:
    """Return the sockets of the engine for the ports of *spec*, each once."""
    ports = (port for port in spec.ports if port.kind is PortKind.EAP)
    wanted = (each for port in ports for each in sockets_of(port) if each.kind in _OF_ENGINE)
    return list(dict.fromkeys(wanted))


class OpenedPort(NamedTuple):
    """A port with its channels, which receive nothing for it before it is entered."""

    name: PortName
    port: PortSpec
    handler: FrameHandler
    datagrams: UdpChannel | EthernetPort | LoopbackChannel | None
    """None for a port of TCP alone."""
    groups: tuple[UdpChannel, ...]
    tcp: TcpPort | None
    """Around *datagrams*, where the port has TCP."""
    sockets: tuple[SharedSocket, ...]

    @property
    def channel(self) -> FrameChannel:
        """Channel that the station sends by and drains, beside its groups."""
        channel = self.tcp or self.datagrams
        assert channel is not None  # noqa: S101  a port without datagrams has TCP
        return channel


class PortChannels:
    """All ports of an engine, with the sockets that they share.

    Args:
        counters: Of dropped frames and closed connections.
        arrivals: Callbacks for descriptors between the cycles; those of ports that wake on an
            arrival come and go in it.
    """

    def __init__(
        self, counters: DropCounters, arrivals: dict[int, Callable[[int], object]]
    ) -> None:
        self._counters = counters
        self._arrivals = arrivals
        self._batch = ReceiveBatch()
        self._lines = LoopbackLines()
        self._sockets: dict[SharedSocket, socket.socket] = {}
        """Those without a channel."""
        self._channels: dict[SharedSocket, UdpChannel | EthernetInterface] = {}
        self._ports: dict[PortName, OpenedPort] = {}
        self._tcp: dict[PortName, TcpPort] = {}
        self._feeds: dict[SharedSocket | PortName, DropCounterFeed] = {}
        self._stations: dict[SharedSocket, list[str]] = {}
        """Stations at which the frames that an interface drops are counted."""

    def add_socket(self, key: SharedSocket, sock: socket.socket) -> None:
        """Keep the socket of ports that come later; one that is here already is closed."""
        if key in self._channels or key in self._sockets:
            sock.close()
        else:
            self._sockets[key] = sock

    @property
    def unused(self) -> tuple[SharedSocket, ...]:
        """Sockets that no port has used yet."""
        return tuple(self._sockets)

    def open(self, spec: StationSpec, port: PortSpec, handler: FrameHandler) -> OpenedPort:
        """Return *port* of *spec* with its channels; in effect once it is entered.

        Raises:
            EngineRefusedError: services has passed no socket for it.
            ConfigError: the options of its interface are wrong.
        """
        name = PortName(spec.name, port.name)
        keys = tuple(each for each in sockets_of(port) if each.kind in _OF_ENGINE)
        channels = {key: self._channel(key, name) for key in keys}
        datagrams: UdpChannel | EthernetPort | LoopbackChannel | None = None
        groups: list[UdpChannel] = []
        if port.interface.scheme == "loop":
            datagrams = self._lines.make(port.interface)
        for key, channel in channels.items():
            if isinstance(channel, EthernetInterface):
                datagrams = channel.make_port(
                    handler,
                    vlan_id=port.vlan_id,
                    priority=port.vlan_priority,
                    join=port.join,
                )
            elif key.kind is SocketKind.UDP:
                datagrams = channel
            else:
                groups.append(channel)
        tcp = TcpPort(port.interface.host, datagrams) if has_tcp(spec, port) else None
        return OpenedPort(name, port, handler, datagrams, tuple(groups), tcp, keys)

    def enter(self, opened: OpenedPort) -> None:
        """Receive frames for a port from now on."""
        self.exchange((), (opened,))

    def exchange(self, gone: Iterable[PortName], added: Iterable[OpenedPort]) -> None:
        """Receive for ports that are added from now on, and for those that are gone no more.

        Connections of the latter end; what a port of either kind uses stays open.
        """
        keys: dict[SharedSocket, None] = {}
        for name in gone:
            keys.update(dict.fromkeys(self._leave(name)))
        for opened in added:
            self._join(opened)
            keys.update(dict.fromkeys(opened.sockets))
        for key in keys:
            self._follow_users(key)

    def _join(self, opened: OpenedPort) -> None:
        self._ports[opened.name] = opened
        datagrams = opened.datagrams
        if isinstance(datagrams, EthernetPort):
            datagrams.interface.add(datagrams)
        elif datagrams is not None:
            datagrams.handlers.append(opened.handler)
        if isinstance(datagrams, LoopbackChannel):
            datagrams.join()
        for group in opened.groups:
            group.handlers.append(opened.handler)
        if opened.tcp is not None:
            self.enter_tcp(opened.name, opened.tcp)

    def enter_tcp(self, name: PortName, tcp: TcpPort) -> None:
        """Take connections for a port that had no TCP before."""
        self._tcp[name] = tcp
        self._feeds[name] = DropCounterFeed(self._counters, [name.station], tcp.closed, _tcp_reason)

    def _leave(self, name: PortName) -> tuple[SharedSocket, ...]:
        """Receive nothing for a port any more and close its connections; return its sockets."""
        opened = self._ports.pop(name)
        datagrams = opened.datagrams
        if isinstance(datagrams, EthernetPort):
            datagrams.interface.remove(datagrams)
        elif isinstance(datagrams, LoopbackChannel):
            datagrams.close()
        elif datagrams is not None:
            datagrams.handlers.remove(opened.handler)
        for group in opened.groups:
            group.handlers.remove(opened.handler)
        if (tcp := self._tcp.pop(name, None)) is not None:
            tcp.close()
            self._feeds.pop(name).publish()
        for other in self._tcp.values():
            other.forget(opened.handler)
        return opened.sockets

    def has_tcp(self, name: PortName) -> bool:
        """Return whether a port takes connections, or has some."""
        return name in self._tcp

    def update_tcp(self, station: Station) -> None:
        """Keep connections only to the present destinations of *station*."""
        spec = station.spec
        for name, port in self._tcp.items():
            if name.station == spec.name:
                polls = (pd for pd in spec.subscriptions if pd.port == name.port)
                asks = any(pd.poll_request for pd in polls)
                answers = [station.handlers[name.port]] if asks else []
                port.follow(sends_to(spec, name.port), answers)

    def add_connection(
        self,
        connection: socket.socket,
        passed: PassedConnection,
        handler_of: Callable[[PortName], FrameHandler],
    ) -> None:
        """Take frames from a connection that services accepted, for all ports behind it.

        *handler_of* returns the present handler of a port, which may be that of a recording.
        """
        owners = [owner for owner in passed.owners if owner in self._tcp]
        if not owners:  # the ports were removed while it was under way
            connection.close()
            return
        # A recording exchanges the handlers of a station at the station's own ports alone.
        handlers = [
            handler_of(owner) if owner.station == owners[0].station else self._ports[owner].handler
            for owner in owners
        ]
        spare = spare_descriptors(connection.fileno(), descriptor_reserve())
        try:
            receiver = TcpReceiver(connection, handlers, host=passed.host)
        except OSError:
            connection.close()  # the peer has left again
            return
        # Services accepts for all; only the engine knows how many connections the port has.
        port = self._tcp[owners[0]]
        if not port.accept(receiver, monotonic_ns(), spare_descriptors=spare):
            receiver.close()
            for station in {owner.station for owner in owners}:
                self._counters.count(station, DropReason.TCP_FULL)

    def publish_discards(self) -> None:
        """Add the frames that were dropped since the last call to the counters."""
        for feed in self._feeds.values():
            feed.publish()

    def close_unused(self, wanted: Iterable[SharedSocket]) -> None:
        """Close those of *wanted* that no port uses: a change that needed them was refused."""
        for key in wanted:
            if (sock := self._sockets.pop(key, None)) is not None:
                sock.close()
            elif key in self._channels:
                self._follow_users(key)

    def close(self) -> None:
        """Close all sockets and connections."""
        for tcp in self._tcp.values():
            tcp.close()
        for channel in (*self._channels.values(), *self._sockets.values()):
            channel.close()

    def _channel(self, key: SharedSocket, name: PortName) -> UdpChannel | EthernetInterface:
        if key not in self._channels:
            if key not in self._sockets:
                where = f"{key.kind} {key.group or key.address}"
                raise EngineRefusedError(f"port {name.port}: its socket is missing: {where}")
            sock = self._sockets.pop(key)
            self._channels[key] = (
                EthernetInterface(sock, packet_batch(), key.address)
                if key.kind is SocketKind.PACKET
                else UdpChannel(sock, self._batch)
            )
        return self._channels[key]

    def _follow_users(self, key: SharedSocket) -> None:
        """Have the channel of *key* wake as its ports want it; close it without any."""
        users = [each for each in self._ports.values() if key in each.sockets]
        channel = self._channels[key]
        if not users or all(each.port.wake is not Wake.ARRIVAL for each in users):
            self._arrivals.pop(channel.fileno(), None)
        else:
            self._arrivals.setdefault(channel.fileno(), _drain_of(channel))
        if isinstance(channel, EthernetInterface):
            stations = self._stations.setdefault(key, [])
            if key not in self._feeds:
                self._feeds[key] = DropCounterFeed(
                    self._counters, stations, channel.discarded, DropReason
                )
            self._feeds[key].publish()
            stations[:] = sorted({each.name.station for each in users})
        if not users:
            self._feeds.pop(key, None)
            self._stations.pop(key, None)
            self._channels.pop(key).close()


def _drain_of(channel: UdpChannel | EthernetInterface) -> Callable[[int], object]:
    if isinstance(channel, UdpChannel):
        return channel.drain
    drain: Callable[[int], object] = channel.compiled or (lambda now_ns: channel.drain())
    return drain


def _tcp_reason(closed: str) -> DropReason | None:
    """Return the reason to count for a connection that ended, None for an orderly close."""
    if closed.startswith("frame of type"):
        return DropReason.TCP_TYPE
    return _REFUSALS.get(closed)
