"""Network side of services: the transports on the sockets that the supervisor opened.

:class:`MailboxTransports` opens frames of type 4 and 5 (EtherType 0x88A4, UDP and TCP 34980, ports
of gateways), :class:`AmsTransports` AMS/TCP 48898 and UDP 48899.  :func:`open_transports` gives
each socket to one of them by its kind.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from ipaddress import IPv4Address
from time import monotonic_ns
from typing import TYPE_CHECKING, NamedTuple, Protocol

from eap.ams.spec import TransportKind
from eap.ams.transport_table import Transport
from eap.codec.ethercat import MAX_ETHERNET_FRAME, MAX_UDP_FRAME
from eap.errors import EnvironmentalError
from eap.net.ethernet import EthernetInterface, EthernetPort, packet_batch
from eap.net.interface import interface_of, link_is_up
from eap.net.ipsocket import AddressKeeper
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import UdpChannel
from eap.pd.link import FrameOrigin
from eap.pd.spec import StationSpec
from eap.runtime.drop_counters import DropCounters, DropReason
from eap.runtime.handover import NO_DESCRIPTOR, Handover, PortName, SharedSocket, SocketKind
from eap.services.gateway.gateway_transport import GatewayTable, GatewayTransport
from eap.services.routing.remote_routers import RouterRequests
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes
from eap.services.transports.accepting import Listeners
from eap.services.transports.ams_discovery import AmsDiscovery, RouteAdmin, RouterName
from eap.services.transports.ams_tcp import AmsClients, AmsTransport, AmsUplinks
from eap.services.transports.demultiplexer import Demultiplexer
from eap.services.transports.mailbox_frames import (
    FRAME_OVERHEAD,
    ChannelSender,
    EthernetSegment,
    FrameIntake,
    MailboxIntake,
    SegmentSender,
    watch_channel,
)
from eap.services.transports.mailbox_stream import LARGEST_FRAME, MailboxStreams, TcpTransport

if TYPE_CHECKING:
    pass

AMS_TRANSPORT = TransportKind.AMS_TCP
"""Name of the transport of all clients that connect to AMS/TCP."""
LINK_POLL_S = 0.2
"""Interval between two polls of the links."""


class ServedTransport(Protocol):
    """Transport with a task of its own, such as a listener."""

    async def serve(self) -> None:
        """Serve until cancelled."""


class Network(NamedTuple):
    """Routers, gateways and resources that all transports of the process are opened with."""

    handover: Handover
    routers: Mapping[str, StationRouter]
    """Of the stations, by name."""
    routes: Mapping[str, StationRoutes]
    """Of these routers; tools may add some."""
    gateways: GatewayTable
    """To the buses."""
    counters: DropCounters
    """Of dropped frames and closed connections."""
    listeners: Listeners
    """Of this process."""
    resources: ExitStack
    """Closes the sockets."""

    def open_socket(self, shared: SharedSocket) -> socket.socket:
        """Return the socket of services; *resources* closes it."""
        return self.resources.enter_context(socket.socket(fileno=shared.services_fd))

    def demultiplexer(self, kind: str, owners: Sequence[PortName]) -> Demultiplexer:
        """Return the demultiplexer to the stations of *owners*."""
        names = _transport_names(kind, owners)
        return Demultiplexer([(self.routers[station], name) for station, name in names.items()])

    def first_gateways(self, kind: str, owners: Sequence[PortName]) -> GatewayTransport:
        """Return the gateways of the first bus of each station of *owners*."""
        return GatewayTransport(self.gateways, _transport_names(kind, owners))

    def own_gateway(self, kind: str, shared: SharedSocket) -> GatewayTransport:
        """Return the gateway that has a port number to itself."""
        (owner,) = shared.owners
        spec = next(each for each in self.handover.stations if each.name == owner.station)
        name = next(port.name for port in spec.ports if port.interface.host == shared.address)
        return GatewayTransport(self.gateways, {owner.station: f"{kind}:{name}"}, owner)

    def drop_counter(self, stations: Sequence[str]) -> Callable[[DropReason], None]:
        """Return the function that counts a reason at each of *stations*."""

        def count_dropped(reason: DropReason) -> None:
            for station in stations:
                self.counters.count(station, reason)

        return count_dropped


def open_transports(network: Network, engine: socket.socket) -> list[ServedTransport]:
    """Open all transports on the sockets of the handover, as long as the running loop lives.

    Args:
        network: What they are opened with.
        engine: Link to the engine, for connections that belong there.

    Returns:
        The listeners, the connections to other routers and the link watch, to be served.
    """
    links = LinkWatch()
    mailbox = MailboxTransports(network, links, engine)
    ams = AmsTransports(network, links)
    openers: dict[SocketKind, Callable[[SharedSocket], ServedTransport | None]] = {
        # Unicast first: answers to frames of a group go out by the socket of the unicast address.
        SocketKind.UDP: mailbox.open_unicast,
        SocketKind.GROUP: mailbox.open_group,
        SocketKind.PACKET: mailbox.open_interface,
        SocketKind.AMS_UDP: ams.open_discovery,
        SocketKind.GATEWAY_UDP: mailbox.open_gateway_datagrams,
        SocketKind.TCP: mailbox.open_listener,
        SocketKind.GATEWAY_TCP: mailbox.open_gateway_listener,
        SocketKind.AMS_TCP: ams.open_listener,
    }
    opened = [
        opener(shared)
        for kind, opener in openers.items()
        for shared in network.handover.sockets
        if shared.kind is kind
    ]
    uplinks = [ams.open_uplinks(station) for station in network.handover.stations]
    return [*(each for each in opened if each is not None), *uplinks, links]


class LinkWatch:
    """Link state of the interfaces: a pulled cable takes the hops of their transports down.

    Interfaces that were deleted and made again are joined again.

    Args:
        is_up: Returns whether the link of an interface is up.

    Attributes:
        addresses: What sockets have at the interfaces of local addresses.
    """

    def __init__(self, is_up: Callable[[str], bool] = link_is_up) -> None:
        self.addresses = AddressKeeper()
        self._interfaces: list[EthernetInterface] = []
        self._transports: dict[str, list[tuple[StationRouter, str]]] = {}
        self._is_up = is_up
        self._down: set[str] = set()

    def add(self, interface: str, router: StationRouter, transport: str) -> None:
        """Watch *interface* for one transport of *router*."""
        self._transports.setdefault(interface, []).append((router, transport))

    def find_again(self, interface: EthernetInterface) -> None:
        """Look for *interface* by its name while it is lost."""
        self._interfaces.append(interface)

    async def serve(self) -> None:
        """Poll until cancelled; return at once without any interface."""
        while self._transports or self._interfaces or not self.addresses.is_empty:
            self.poll()
            await asyncio.sleep(LINK_POLL_S)

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
                    station.hop_down(transport, None, f"interface {interface} has no link")


class MailboxTransports:
    """Transports of frames of type 5, and of TCP connections with type 4 to the engine.

    Args:
        network: What they are opened with.
        links: Watches the interfaces.
        engine: Link to the engine.
    """

    def __init__(self, network: Network, links: LinkWatch, engine: socket.socket) -> None:
        self._network = network
        self._links = links
        self._engine = engine
        # One set of buffers for all UDP channels: only one of them is drained at a time.
        self._batch = ReceiveBatch()
        self._from_ns = monotonic_ns()

    def open_unicast(self, shared: SharedSocket) -> None:
        """Open the UDP socket of an address."""
        channel = self._channel(shared)
        sender = ChannelSender(channel)
        max_size = MAX_UDP_FRAME - FRAME_OVERHEAD
        for owner in shared.owners:
            # A hub: a packet may leave by the transport that it came by, to another address.
            transport = Transport(f"udp:{owner.port}", max_size, is_hub=True)
            self._network.routers[owner.station].add_transport(transport, sender)
            self._watch_link(shared.address, owner, transport)
        if not IPv4Address(shared.address).is_unspecified:
            self._links.addresses.keep_outgoing(self._copy(shared.engine_fd), shared.address)
        self._add_intake(shared.owners, channel, sender, lambda data: False)
        watch_channel(channel)

    def open_group(self, shared: SharedSocket) -> None:
        """Open a multicast group; each owner gets all of its frames."""
        channel = self._channel(shared)
        sender = ChannelSender(channel)
        if not IPv4Address(shared.address).is_unspecified:
            # Of the engine, too: each socket has memberships of its own.
            for fd in (shared.engine_fd, shared.services_fd):
                sock = self._copy(fd)
                self._links.addresses.keep_group(sock, shared.group, shared.address)
        # An intake for each owner, not a demultiplexer: all members of a group get the frame.
        for owner in shared.owners:
            self._add_intake([owner], channel, sender, lambda data: True)
        watch_channel(channel)

    def open_interface(self, shared: SharedSocket) -> None:
        """Open an Ethernet interface: one segment for each VLAN, with all ports in it.

        The ports of a VLAN have one MAC address, so each of them gets every frame.  Of two ports of
        a station in one VLAN the first one has the transport.
        """
        network = self._network
        interface = EthernetInterface(
            socket.socket(fileno=shared.services_fd), packet_batch(), shared.address
        )
        network.resources.callback(interface.close)
        self._links.find_again(interface)
        intakes: dict[int, list[FrameIntake]] = {}
        ports: dict[int, dict[PortName, EthernetPort]] = {}
        for owner in shared.owners:
            spec = network.handover.port(owner)
            intake = FrameIntake([owner.station], network.counters, self._from_ns, _drop_mailbox)
            port = interface.port(
                intake.receive, vlan_id=spec.vlan_id, priority=spec.vlan_priority, join=spec.join
            )
            intakes.setdefault(spec.vlan_id, []).append(intake)
            in_vlan = ports.setdefault(spec.vlan_id, {})
            if owner.station not in {each.station for each in in_vlan}:
                in_vlan[owner] = port
        for vlan_id, (first, *others) in intakes.items():
            owners = [*ports[vlan_id]]
            demultiplexer = network.demultiplexer("ethernet", owners)
            segment = EthernetSegment(demultiplexer, lambda: interface.address)
            interface.on_found.append(segment.forget)
            sender = ChannelSender(ports[vlan_id][owners[0]])
            gateway = network.first_gateways("ethernet", owners)
            mailbox = MailboxIntake(segment, gateway, sender, interface.is_group_frame)
            first.mailbox = mailbox.receive
            for each in others:
                # The first intake handles a frame for all ports of the VLAN; the others only
                # count it at their stations.
                each.mailbox = mailbox.drop_reason
            for owner, port in ports[vlan_id].items():
                router = network.routers[owner.station]
                transport = Transport(f"ethernet:{owner.port}", MAX_ETHERNET_FRAME - FRAME_OVERHEAD)
                router.add_transport(transport, SegmentSender(segment, port, router.net_id))
                self._links.add(shared.address, router, transport.name)
        watch_channel(port)

    def open_listener(self, shared: SharedSocket) -> TcpTransport:
        """Open the TCP listener of an address."""
        network, owners = self._network, shared.owners
        count_dropped = network.drop_counter(_stations_of(shared))
        streams = MailboxStreams(
            network.demultiplexer("tcp", owners),
            network.first_gateways("tcp", owners),
            count_dropped,
            shared.address,
        )
        max_size = LARGEST_FRAME - FRAME_OVERHEAD
        for owner in owners:
            transport = Transport(f"tcp:{owner.port}", max_size, is_stream=True, is_hub=True)
            network.routers[owner.station].add_transport(transport, streams)
            self._watch_link(shared.address, owner, transport)
        accepting = tuple(owner for owner in owners if self._accepts_process_data(owner))
        return self._tcp_transport(shared, accepting, count_dropped, streams)

    def open_gateway_datagrams(self, shared: SharedSocket) -> None:
        """Open the UDP port of one gateway."""
        channel = self._channel(shared)
        mailbox = MailboxIntake(
            Demultiplexer([]),
            self._network.own_gateway("udp", shared),
            ChannelSender(channel),
            lambda data: False,
            is_aoe_here=False,
        )
        stations = _stations_of(shared)
        intake = FrameIntake(stations, self._network.counters, self._from_ns, mailbox.receive)
        channel.handlers.append(intake.receive)
        watch_channel(channel)

    def open_gateway_listener(self, shared: SharedSocket) -> TcpTransport:
        """Open the TCP port of one gateway."""
        count_dropped = self._network.drop_counter(_stations_of(shared))
        gateway = self._network.own_gateway("tcp", shared)
        # Without stations: the port belongs to the gateway, which gets AoE too.
        streams = MailboxStreams(Demultiplexer([]), gateway, count_dropped, is_aoe_here=False)
        return self._tcp_transport(shared, (), count_dropped, streams)

    def _tcp_transport(
        self,
        shared: SharedSocket,
        accepting: tuple[PortName, ...],
        count_dropped: Callable[[DropReason], None],
        streams: MailboxStreams,
    ) -> TcpTransport:
        listener, listeners = self._network.open_socket(shared), self._network.listeners
        return TcpTransport(listener, accepting, self._engine, count_dropped, streams, listeners)

    def _channel(self, shared: SharedSocket) -> UdpChannel:
        channel = UdpChannel(socket.socket(fileno=shared.services_fd), self._batch)
        self._network.resources.callback(channel.close)
        return channel

    def _copy(self, fd: int) -> socket.socket:
        """Return a socket of a descriptor that others close."""
        sock = socket.fromfd(fd, socket.AF_INET, socket.SOCK_DGRAM)
        return self._network.resources.enter_context(sock)

    def _add_intake(
        self,
        owners: Sequence[PortName],
        channel: UdpChannel,
        sender: ChannelSender,
        is_group_frame: Callable[[memoryview], bool],
    ) -> None:
        network = self._network
        mailbox = MailboxIntake(
            network.demultiplexer("udp", owners),
            network.first_gateways("udp", owners),
            sender,
            is_group_frame,
        )
        stations = list(dict.fromkeys(owner.station for owner in owners))
        intake = FrameIntake(stations, network.counters, self._from_ns, mailbox.receive)
        channel.handlers.append(intake.receive)

    def _watch_link(self, address: str, owner: PortName, transport: Transport) -> None:
        """Watch the link of the interface with *address*, which a loopback address has not."""
        if IPv4Address(address).is_loopback or IPv4Address(address).is_unspecified:
            return
        with suppress(EnvironmentalError):  # the address was removed from this host
            router = self._network.routers[owner.station]
            self._links.add(interface_of(address), router, transport.name)

    def _accepts_process_data(self, name: PortName) -> bool:
        port = self._network.handover.port(name)
        return port.tcp or port.interface.scheme == "tcp"


class AmsTransports:
    """Transports of AMS/TCP, and discovery by UDP 48899.

    Args:
        network: What they are opened with.
        links: Watches the interfaces.
    """

    def __init__(self, network: Network, links: LinkWatch) -> None:
        self._network = network
        self._links = links
        self._clients = AmsClients()
        self._stations: set[str] = set()

    def open_discovery(self, shared: SharedSocket) -> None:
        """Open the UDP 48899 socket of an address, and that for broadcasts to its network."""
        network, names = self._network, _stations_of(shared)
        routers = [
            RouterName(station.name, station.net_id)
            for station in network.handover.stations
            if station.name in names
        ]
        sock = network.open_socket(shared)
        requests = RouterRequests(sock, [router.net_id for router in routers])
        discovery = AmsDiscovery(
            sock,
            routers,
            RouteAdmin([network.routes[name] for name in names]),
            requests,
            network.drop_counter(names),
        )
        discovery.watch()
        for other in network.handover.sockets:
            # A socket that is bound to a unicast address receives no broadcasts.
            is_broadcast = other.kind is SocketKind.AMS_BROADCAST
            is_same = is_broadcast and other.address == shared.address
            if is_same and other.services_fd != NO_DESCRIPTOR:
                broadcasts = network.open_socket(other)
                self._links.addresses.keep_interface(broadcasts, other.address)
                discovery.watch(broadcasts)
        for name in names:
            network.routes[name].scanners.append(requests)

    def open_listener(self, shared: SharedSocket) -> AmsTransport:
        """Open the AMS/TCP listener of an address; all listeners of a station are one transport."""
        network, stations = self._network, _stations_of(shared)
        for station in stations:
            # A station with several addresses has one transport for all of its clients.
            if station not in self._stations:
                self._stations.add(station)
                transport = Transport(AMS_TRANSPORT, is_stream=True, is_hub=True)
                network.routers[station].add_transport(transport, self._clients)
        return AmsTransport(
            network.open_socket(shared),
            Demultiplexer([(network.routers[station], AMS_TRANSPORT) for station in stations]),
            self._clients,
            network.drop_counter(stations),
            network.listeners,
        )

    def open_uplinks(self, station: StationSpec) -> AmsUplinks:
        """Return the AMS/TCP connections of *station* to other routers."""
        sources = [
            uri.host for port in station.ports if (uri := port.interface).scheme in {"udp", "tcp"}
        ]
        count_dropped = self._network.drop_counter([station.name])
        return AmsUplinks(self._network.routers[station.name], sources, count_dropped)


def _transport_names(kind: str, owners: Sequence[PortName]) -> dict[str, str]:
    """Return the transport of each station of *owners*: that of its first port."""
    names: dict[str, str] = {}
    for owner in owners:
        names.setdefault(owner.station, f"{kind}:{owner.port}")
    return names


def _stations_of(shared: SharedSocket) -> list[str]:
    return list(dict.fromkeys(owner.station for owner in shared.owners))


def _drop_mailbox(
    data: memoryview, size: int, at_ns: int, origin: FrameOrigin
) -> DropReason | None:
    """Drop each frame: the ports of the interface are not all known yet."""
    del data, size, at_ns, origin
    return DropReason.MAILBOX
