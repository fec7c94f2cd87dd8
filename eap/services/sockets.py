"""Network side of services: sockets that the supervisor opened, and the transports on them."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from ipaddress import IPv4Address
from time import monotonic_ns
from typing import TYPE_CHECKING

from eap.ams.spec import TransportKind
from eap.ams.transport_table import Transport
from eap.codec.ethercat import MAX_ETHERNET_FRAME, MAX_UDP_FRAME
from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri, NetId
from eap.net.ethernet import EthernetInterface, EthernetPort, packet_batch
from eap.net.interface import interface_of, link_is_up
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import UdpChannel
from eap.pd.link import FrameOrigin
from eap.pd.spec import StationSpec
from eap.runtime.discards import DiscardCounters, Refusal
from eap.runtime.handover import NO_DESCRIPTOR, Handover, PortName, SharedSocket, SocketKind
from eap.services.gateway.gateway_transport import GatewayTransport
from eap.services.routing.neighbours import AmsQuestions
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes
from eap.services.transports.accepting import Listeners
from eap.services.transports.ams_discovery import AmsDiscovery, RouteAdmin, RouterName
from eap.services.transports.ams_tcp import AmsClients, AmsTransport, AmsUplinks
from eap.services.transports.demultiplexer import Demultiplexer
from eap.services.transports.mailbox_frames import (
    FRAME_OVERHEAD,
    ChannelSender,
    FrameIntake,
    MailboxIntake,
    Segment,
    SegmentSender,
    watch_channel,
)
from eap.services.transports.mailbox_stream import LARGEST_FRAME, MailboxStreams, TcpTransport

if TYPE_CHECKING:
    from eap.services.gateway.gateway import MailboxGateway


LOOK_S = 0.2
"""Between two looks."""


class LinkWatch:
    """Looks after the links of interfaces.

    Args:
        transports: By interface, which stations use it and by which of their doors.
        is_up: Says of an interface whether its link is up.
    """

    def __init__(
        self,
        transports: Mapping[str, Sequence[tuple[StationRouter, str]]],
        is_up: Callable[[str], bool] = link_is_up,
    ) -> None:
        self._transports = transports
        self._is_up = is_up
        self._down: set[str] = set()

    async def serve(self) -> None:
        """Look until cancelled; at once if there is nothing to look after."""
        while self._transports:
            self.look()
            await asyncio.sleep(LOOK_S)

    def look(self) -> None:
        """Tell the stations what has changed."""
        for interface, transports in self._transports.items():
            is_up, was_up = self._is_up(interface), interface not in self._down
            if is_up and not was_up:
                self._down.discard(interface)
                for station, transport in transports:
                    station.hop_up(transport, None)
            elif was_up and not is_up:
                self._down.add(interface)
                for station, transport in transports:
                    station.hop_down(transport, None, f"interface {interface} has no link")


AMS_TRANSPORT = TransportKind.AMS_TCP
"""By which clients come in that connect to AMS/TCP."""


def open_doors(
    handover: Handover,
    routers: Mapping[str, StationRouter],
    routes: Mapping[str, StationRoutes],
    gateways: Mapping[PortName, MailboxGateway],
    counters: DiscardCounters,
    link: socket.socket,
    listeners: Listeners,
    resources: ExitStack,
) -> list[TcpTransport | AmsTransport | AmsUplinks | LinkWatch]:
    """Take frames from all sockets of *handover*, as long as the running loop lives.

    Args:
        handover: What the supervisor opened.
        routers: Of the stations, by name; they get their doors.
        routes: Of these routers; tools may add some.
        gateways: To the buses, in their order.
        counters: Of what is not taken.
        link: To the engine, for connections that belong there.
        listeners: Of this process.
        resources: Closes what is opened here.

    Returns:
        The listeners for TCP, the connections to others and the watch over links, to be served.
    """
    transports = _Sockets(handover, routers, routes, gateways, counters, listeners, resources)
    return transports.open(link)


class _Sockets:
    def __init__(
        self,
        handover: Handover,
        routers: Mapping[str, StationRouter],
        routes: Mapping[str, StationRoutes],
        gateways: Mapping[PortName, MailboxGateway],
        counters: DiscardCounters,
        listeners: Listeners,
        resources: ExitStack,
    ) -> None:
        self._handover = handover
        self._listeners = listeners
        self._routers = routers
        self._routes = routes
        self._gateways = gateways
        self._first_gateways: dict[str, MailboxGateway] = {}
        for owner, gateway in gateways.items():
            self._first_gateways.setdefault(owner.station, gateway)
        self._counters = counters
        self._resources = resources
        self._batch = ReceiveBatch()
        self._now_ns = monotonic_ns()
        self._ams_clients = AmsClients()
        self._ams_stations: set[str] = set()
        self._links: dict[str, list[tuple[StationRouter, str]]] = {}

    def open(
        self, link: socket.socket
    ) -> list[TcpTransport | AmsTransport | AmsUplinks | LinkWatch]:
        by_kind: dict[SocketKind, list[SharedSocket]] = {kind: [] for kind in SocketKind}
        for shared in self._handover.sockets:
            by_kind[shared.kind].append(shared)
        for shared in by_kind[SocketKind.UDP]:
            self._watch_unicast(shared)
        for shared in by_kind[SocketKind.GROUP]:  # what comes there is answered by the others
            self._watch_group(shared)
        for shared in by_kind[SocketKind.PACKET]:
            self._watch_interface(shared)
        for shared in by_kind[SocketKind.AMS_UDP]:
            self._watch_discovery(shared)
        for shared in by_kind[SocketKind.GATEWAY_UDP]:
            self._watch_gateway(shared)
        transports: list[TcpTransport | AmsTransport | AmsUplinks | LinkWatch] = []
        transports += [self._transport(shared, link) for shared in by_kind[SocketKind.TCP]]
        transports += [
            self._gateway_door(shared, link) for shared in by_kind[SocketKind.GATEWAY_TCP]
        ]
        transports += [self._ams_door(shared) for shared in by_kind[SocketKind.AMS_TCP]]
        transports += [self._uplinks(station) for station in self._handover.stations]
        transports.append(LinkWatch(self._links))
        return transports

    def _channel(self, shared: SharedSocket) -> UdpChannel:
        channel = UdpChannel(socket.socket(fileno=shared.services_fd), self._batch)
        self._resources.callback(channel.close)
        return channel

    def _demultiplexer(self, kind: str, owners: Sequence[PortName]) -> Demultiplexer:
        """Return the way in to the stations of *owners*, by the doors of their ports."""
        transports = _transports(kind, owners)
        return Demultiplexer(
            [(self._routers[station], transport) for station, transport in transports.items()]
        )

    def _gateway(self, kind: str, owners: Sequence[PortName]) -> GatewayTransport:
        """Return the way in to the gateways of their stations' first buses."""
        transports = _transports(kind, owners)
        gateways = self._first_gateways
        return GatewayTransport(
            [
                (gateways[station], transport)
                for station, transport in transports.items()
                if station in gateways
            ]
        )

    def _own_gateway(self, kind: str, shared: SharedSocket) -> GatewayTransport:
        """Return the way in to the gateway that has a port number to itself."""
        (owner,) = shared.owners
        spec = next(each for each in self._handover.stations if each.name == owner.station)
        at = next(
            port.name
            for port in spec.ports
            if InterfaceUri.parse(port.interface).host == shared.address
        )
        return GatewayTransport([(self._gateways[owner], f"{kind}:{at}")])

    def _watch_gateway(self, shared: SharedSocket) -> None:
        channel = self._channel(shared)
        mailbox = MailboxIntake(
            Demultiplexer([]),
            self._own_gateway("udp", shared),
            ChannelSender(channel),
            lambda data: False,
            is_aoe_here=False,
        )
        stations = _stations_of(shared)
        channel.takers.append(
            FrameIntake(stations, self._counters, self._now_ns, mailbox.take).take
        )
        watch_channel(channel)

    def _gateway_door(self, shared: SharedSocket, link: socket.socket) -> TcpTransport:
        refuse = self._error_replier(_stations_of(shared))
        gateway = self._own_gateway("tcp", shared)
        streams = MailboxStreams(Demultiplexer([]), gateway, refuse, is_aoe_here=False)
        return TcpTransport(self._socket(shared), (), link, refuse, streams, self._listeners)

    def _watch_unicast(self, shared: SharedSocket) -> None:
        channel = self._channel(shared)
        sender = ChannelSender(channel)
        for owner in shared.owners:
            transport = Transport(f"udp:{owner.port}", MAX_UDP_FRAME - FRAME_OVERHEAD, is_hub=True)
            self._routers[owner.station].add_transport(transport, sender)
            self._watch_link(shared.address, owner, transport)
        self._take_datagrams(shared.owners, channel, sender, lambda data: False)
        watch_channel(channel)

    def _watch_group(self, shared: SharedSocket) -> None:
        channel = self._channel(shared)
        sender = ChannelSender(channel)
        for owner in shared.owners:
            self._take_datagrams([owner], channel, sender, lambda data: True)
        watch_channel(channel)

    def _take_datagrams(
        self,
        owners: Sequence[PortName],
        channel: UdpChannel,
        sender: ChannelSender,
        is_for_many: Callable[[memoryview], bool],
    ) -> None:
        demultiplexer, gateway = self._demultiplexer("udp", owners), self._gateway("udp", owners)
        mailbox = MailboxIntake(demultiplexer, gateway, sender, is_for_many)
        stations = list(dict.fromkeys(owner.station for owner in owners))
        intake = FrameIntake(stations, self._counters, self._now_ns, mailbox.take)
        channel.takers.append(intake.take)

    def _watch_interface(self, shared: SharedSocket) -> None:
        """One way in for each VLAN: its ports have one MAC address, and all get what comes there.

        Of two ports of a station in one VLAN the first one has the door.
        """
        interface = EthernetInterface(socket.socket(fileno=shared.services_fd), packet_batch())
        self._resources.callback(interface.close)
        intakes: dict[int, list[FrameIntake]] = {}
        ports: dict[int, dict[PortName, EthernetPort]] = {}
        for owner in shared.owners:
            spec = self._handover.port(owner)
            intake = FrameIntake([owner.station], self._counters, self._now_ns, _not_yet)
            port = interface.port(
                intake.take, vlan_id=spec.vlan_id, priority=spec.vlan_priority, join=spec.join
            )
            intakes.setdefault(spec.vlan_id, []).append(intake)
            in_vlan = ports.setdefault(spec.vlan_id, {})
            if owner.station not in {each.station for each in in_vlan}:
                in_vlan[owner] = port
        for vlan_id, (first, *others) in intakes.items():
            there = [*ports[vlan_id]]
            segment = Segment(self._demultiplexer("ethernet", there), interface.address)
            sender = ChannelSender(ports[vlan_id][there[0]])
            gateway = self._gateway("ethernet", there)
            mailbox = MailboxIntake(segment, gateway, sender, interface.is_for_many)
            first.mailbox = mailbox.take
            for each in others:
                each.mailbox = mailbox.admission
            for owner, port in ports[vlan_id].items():
                router = self._routers[owner.station]
                transport = Transport(f"ethernet:{owner.port}", MAX_ETHERNET_FRAME - FRAME_OVERHEAD)
                router.add_transport(transport, SegmentSender(segment, port, router.net_id))
                self._links.setdefault(shared.address, []).append((router, transport.name))
        watch_channel(port)

    def _watch_discovery(self, shared: SharedSocket) -> None:
        names = _stations_of(shared)
        routers = [
            RouterName(station.name, NetId.parse(station.net_id))
            for station in self._handover.stations
            if station.name in names
        ]
        desk = RouteAdmin([self._routes[name] for name in names])
        sock = self._socket(shared)
        questions = AmsQuestions(sock, [router.net_id for router in routers])
        discovery = AmsDiscovery(sock, routers, desk, questions, self._error_replier(names))
        discovery.watch()
        for other in self._handover.sockets:
            is_for_it = other.kind is SocketKind.AMS_BROADCAST and other.address == shared.address
            if is_for_it and other.services_fd != NO_DESCRIPTOR:
                discovery.watch(self._socket(other))
        for name in names:
            self._routes[name].scanners.append(questions)

    def _ams_door(self, shared: SharedSocket) -> AmsTransport:
        """Return the listener of an address; a station with several has one door for all."""
        stations = _stations_of(shared)
        for station in stations:
            if station not in self._ams_stations:
                self._ams_stations.add(station)
                transport = Transport(AMS_TRANSPORT, is_stream=True, is_hub=True)
                self._routers[station].add_transport(transport, self._ams_clients)
        demultiplexer = Demultiplexer(
            [(self._routers[station], AMS_TRANSPORT) for station in stations]
        )
        refuse = self._error_replier(stations)
        return AmsTransport(
            self._socket(shared), demultiplexer, self._ams_clients, refuse, self._listeners
        )

    def _uplinks(self, station: StationSpec) -> AmsUplinks:
        sources = [
            uri.host
            for port in station.ports
            if (uri := InterfaceUri.parse(port.interface)).scheme in {"udp", "tcp"}
        ]
        return AmsUplinks(self._routers[station.name], sources, self._error_replier([station.name]))

    def _transport(self, shared: SharedSocket, link: socket.socket) -> TcpTransport:
        refuse = self._error_replier(_stations_of(shared))
        demultiplexer, gateway = (
            self._demultiplexer("tcp", shared.owners),
            self._gateway("tcp", shared.owners),
        )
        streams = MailboxStreams(demultiplexer, gateway, refuse, shared.address)
        for owner in shared.owners:
            room = LARGEST_FRAME - FRAME_OVERHEAD
            transport = Transport(f"tcp:{owner.port}", room, is_stream=True, is_hub=True)
            self._routers[owner.station].add_transport(transport, streams)
            self._watch_link(shared.address, owner, transport)
        return TcpTransport(
            self._socket(shared),
            tuple(owner for owner in shared.owners if self._takes_tcp(owner)),
            link,
            refuse,
            streams,
            self._listeners,
        )

    def _watch_link(self, address: str, owner: PortName, transport: Transport) -> None:
        """Have an eye on the link of the interface with *address*, unless it is this host alone."""
        if IPv4Address(address).is_loopback or IPv4Address(address).is_unspecified:
            return
        with suppress(EnvironmentalError):  # the address has been taken from this machine
            transports = self._links.setdefault(interface_of(address), [])
            transports.append((self._routers[owner.station], transport.name))

    def _socket(self, shared: SharedSocket) -> socket.socket:
        return self._resources.enter_context(socket.socket(fileno=shared.services_fd))

    def _error_replier(self, stations: Sequence[str]) -> Callable[[Refusal], None]:
        def refuse(reason: Refusal) -> None:
            for station in stations:
                self._counters.count(station, reason)

        return refuse

    def _takes_tcp(self, name: PortName) -> bool:
        port = self._handover.port(name)
        return port.tcp or InterfaceUri.parse(port.interface).scheme == "tcp"


def _transports(kind: str, owners: Sequence[PortName]) -> dict[str, str]:
    """Return by what name each station of *owners* knows the door: that of its first port."""
    transports: dict[str, str] = {}
    for owner in owners:
        transports.setdefault(owner.station, f"{kind}:{owner.port}")
    return transports


def _stations_of(shared: SharedSocket) -> list[str]:
    return list(dict.fromkeys(owner.station for owner in shared.owners))


def _not_yet(data: memoryview, size: int, at_ns: int, origin: FrameOrigin) -> Refusal | None:
    """Take nothing of an interface whose ports are not all known."""
    del data, size, at_ns, origin
    return Refusal.MAILBOX
