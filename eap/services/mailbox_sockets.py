"""Sockets for frames of type 4 and 5: EtherType 0x88A4, UDP and TCP 34980, ports of gateways.

Each follows the ports that share it: a port that comes or goes changes nothing for the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from ipaddress import IPv4Address

from eap.ams.transport_table import Transport
from eap.codec.ethercat import MAX_ETHERNET_FRAME, MAX_UDP_FRAME
from eap.errors import EnvironmentalError
from eap.net.ethernet import EthernetInterface, EthernetPort, packet_batch
from eap.net.interface import interface_of
from eap.net.udp import UdpChannel
from eap.pd.link import FrameOrigin
from eap.pd.spec import PortSpec
from eap.runtime.drop_counters import DropReason
from eap.runtime.handover import PortName, SharedSocket
from eap.services.gateway.gateway_transport import GatewayTransport
from eap.services.network import Network, PortTransports, stations_of, transport_names
from eap.services.socket_table import owned_copy
from eap.services.transports.demultiplexer import Demultiplexer
from eap.services.transports.mailbox_frames import (
    FRAME_OVERHEAD,
    ChannelSender,
    EthernetSegment,
    FrameIntake,
    MailboxIntake,
    SegmentSender,
    stop_watching,
    watch_channel,
)
from eap.services.transports.mailbox_stream import LARGEST_FRAME, MailboxStreams, TcpTransport


class UdpSocket:
    """UDP socket of an address."""

    listener = None

    def __init__(self, network: Network, shared: SharedSocket) -> None:
        self._network = network
        self._address = shared.address
        self._channel = UdpChannel(owned_copy(shared.services_fd), network.batch)
        self._sender = ChannelSender(self._channel)
        self._transports = PortTransports(network)
        self._outgoing = owned_copy(shared.engine_fd)
        if not IPv4Address(shared.address).is_unspecified:
            network.links.addresses.keep_outgoing(self._outgoing, shared.address)
        self.follow(shared.owners)
        watch_channel(self._channel)

    def release(self, owner: PortName) -> None:
        """Remove the transport of a port."""
        self._transports.remove(owner)

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve *owners*."""
        network = self._network
        for owner in owners:
            if owner not in self._transports:
                # A hub: a packet may leave by the transport that it came by, to another address.
                size = MAX_UDP_FRAME - FRAME_OVERHEAD
                transport = Transport(f"udp:{owner.port}", size, is_hub=True)
                interface = _watched_interface(self._address)
                self._transports.add(owner, transport, self._sender, interface)
        intake = _datagram_intake(network, owners, self._sender, lambda data: False)
        self._channel.handlers[:] = [intake.receive]

    def close(self) -> None:
        """Close the socket."""
        self._transports.clear()
        self._network.links.addresses.forget(self._outgoing)
        self._outgoing.close()
        stop_watching(self._channel)
        self._channel.close()


class GroupSocket:
    """Socket of a multicast group, or of broadcasts; each owner gets all of its frames."""

    listener = None

    def __init__(self, network: Network, shared: SharedSocket) -> None:
        self._network = network
        self._channel = UdpChannel(owned_copy(shared.services_fd), network.batch)
        self._sender = ChannelSender(self._channel)
        # Of the engine, too: each socket has memberships of its own.
        self._members = [owned_copy(fd) for fd in (shared.engine_fd, shared.services_fd)]
        if not IPv4Address(shared.address).is_unspecified:
            for sock in self._members:
                network.links.addresses.keep_group(sock, shared.group, shared.address)
        self.follow(shared.owners)
        watch_channel(self._channel)

    def release(self, owner: PortName) -> None:
        """Remove nothing: answers go out by the socket of the unicast address."""

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve *owners*."""
        # An intake for each owner, not a demultiplexer: all members of a group get the frame.
        self._channel.handlers[:] = [
            _datagram_intake(self._network, [owner], self._sender, lambda data: True).receive
            for owner in owners
        ]

    def close(self) -> None:
        """Close the socket."""
        for sock in self._members:
            self._network.links.addresses.forget(sock)
            sock.close()
        stop_watching(self._channel)
        self._channel.close()


class EthernetSocket:
    """Socket of an Ethernet interface: one segment for each VLAN, with all ports in it.

    The ports of a VLAN have one MAC address, so each of them gets every frame.  Of two ports of a
    station in one VLAN the first one has the transport.
    """

    listener = None

    def __init__(self, network: Network, shared: SharedSocket) -> None:
        self._network = network
        self._interface = EthernetInterface(
            owned_copy(shared.services_fd), packet_batch(), shared.address
        )
        network.links.find_again(self._interface)
        self._transports = PortTransports(network)
        self._ports: dict[PortName, tuple[EthernetPort, FrameIntake]] = {}
        self._segments: dict[int, _VlanSegment] = {}
        self.follow(shared.owners)
        watch_channel(next(port for port, _ in self._ports.values()))

    def release(self, owner: PortName) -> None:
        """Remove a port from its segment."""
        self._transports.remove(owner)
        if owner in self._ports:
            port, _ = self._ports.pop(owner)
            self._interface.remove(port)

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve *owners*."""
        network, interface = self._network, self._interface
        vlans: dict[int, list[PortName]] = {}
        for owner in owners:
            spec = network.table.port(owner)
            vlans.setdefault(spec.vlan_id, []).append(owner)
            if owner not in self._ports:
                intake = FrameIntake(
                    [owner.station], network.counters, network.from_ns, _drop_mailbox
                )
                port = interface.port(
                    intake.receive,
                    vlan_id=spec.vlan_id,
                    priority=spec.vlan_priority,
                    join=spec.join,
                )
                self._ports[owner] = port, intake
        for gone in self._segments.keys() - vlans.keys():
            interface.on_found.remove(self._segments.pop(gone).segment.forget)
        for vlan_id, members in vlans.items():
            self._follow_vlan(vlan_id, members)

    def close(self) -> None:
        """Close the socket."""
        self._transports.clear()
        self._network.links.forget(self._interface)
        stop_watching(self._interface)
        self._interface.close()

    def _follow_vlan(self, vlan_id: int, members: Sequence[PortName]) -> None:
        network, interface = self._network, self._interface
        vlan = self._segments.get(vlan_id)
        if vlan is None:
            vlan = self._segments[vlan_id] = _VlanSegment(interface, network)
            interface.on_found.append(vlan.segment.forget)
        firsts = {each.station: each for each in reversed(members)}
        owners = [each for each in members if firsts[each.station] == each]
        vlan.demultiplexer.follow(network.behind("ethernet", owners))
        vlan.follow(transport_names("ethernet", owners))
        mailbox = vlan.mailbox_by(self._ports[owners[0]][0])
        for number, owner in enumerate(members):
            # The first intake handles a frame for all ports of the VLAN; the others only count it
            # at their stations.
            _, intake = self._ports[owner]
            intake.mailbox = mailbox.drop_reason if number else mailbox.receive
        for owner in owners:
            if owner not in self._transports:
                router = network.routers[owner.station]
                transport = Transport(f"ethernet:{owner.port}", MAX_ETHERNET_FRAME - FRAME_OVERHEAD)
                sender = SegmentSender(vlan.segment, self._ports[owner][0], router.net_id)
                self._transports.add(owner, transport, sender, interface.name)


class _VlanSegment:
    """A VLAN of an interface, with what its ports share."""

    def __init__(self, interface: EthernetInterface, network: Network) -> None:
        self.demultiplexer = Demultiplexer([])
        self._names: dict[str, str] = {}
        self._gateway = GatewayTransport(network.gateways, self._names)
        self.segment = EthernetSegment(self.demultiplexer, lambda: interface.address)
        self._interface = interface
        self._port: EthernetPort | None = None
        self._mailbox: MailboxIntake | None = None

    def follow(self, names: Mapping[str, str]) -> None:
        """Serve the stations of *names*, each with the name of its transport."""
        self._names.clear()
        self._names.update(names)

    def mailbox_by(self, port: EthernetPort) -> MailboxIntake:
        """Return the intake of type 5, which answers by *port*."""
        if self._mailbox is None or port is not self._port:
            self._port = port
            self._mailbox = MailboxIntake(
                self.segment, self._gateway, ChannelSender(port), self._interface.is_group_frame
            )
        return self._mailbox


class TcpSocket:
    """TCP listener of an address: frames of type 5, and of type 4 for the engine."""

    def __init__(self, network: Network, shared: SharedSocket) -> None:
        self._network = network
        self._address = shared.address
        self._stations: list[str] = []
        count_dropped = network.drop_counter(self._stations)
        self._demultiplexer = Demultiplexer([])
        self._names: dict[str, str] = {}
        gateway = GatewayTransport(network.gateways, self._names)
        self._streams = MailboxStreams(self._demultiplexer, gateway, count_dropped, shared.address)
        self._transports = PortTransports(network)
        sock = owned_copy(shared.services_fd)
        self.listener = TcpTransport(
            sock, (), network.engine, count_dropped, self._streams, network.listeners
        )
        self.follow(shared.owners)

    def release(self, owner: PortName) -> None:
        """Remove the transport of a port."""
        self._transports.remove(owner)

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve *owners*."""
        network = self._network
        self._stations[:] = stations_of(owners)
        self._demultiplexer.follow(network.behind("tcp", owners))
        self._names.clear()
        self._names.update(transport_names("tcp", owners))
        for owner in owners:
            if owner not in self._transports:
                size = LARGEST_FRAME - FRAME_OVERHEAD
                transport = Transport(f"tcp:{owner.port}", size, is_stream=True, is_hub=True)
                interface = _watched_interface(self._address)
                self._transports.add(owner, transport, self._streams, interface)
        self.listener.takers = tuple(each for each in owners if _has_tcp(network.table.port(each)))

    def close(self) -> None:
        """Close the listener, whose connections have ended."""
        self._transports.clear()
        self.listener.close()


class GatewayUdpSocket:
    """UDP port of one gateway."""

    listener = None

    def __init__(self, network: Network, shared: SharedSocket) -> None:
        self._network = network
        self._shared = shared
        self._channel = UdpChannel(owned_copy(shared.services_fd), network.batch)
        (owner,) = shared.owners
        self._names: dict[str, str] = {}
        mailbox = MailboxIntake(
            Demultiplexer([]),
            GatewayTransport(network.gateways, self._names, owner),
            ChannelSender(self._channel),
            lambda data: False,
            is_aoe_here=False,
        )
        stations = stations_of(shared.owners)
        intake = FrameIntake(stations, network.counters, network.from_ns, mailbox.receive)
        self._channel.handlers.append(intake.receive)
        self.follow(shared.owners)
        watch_channel(self._channel)

    def release(self, owner: PortName) -> None:
        """Remove nothing: the socket has one owner."""

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve the gateway by the first EAP port of its station at the address."""
        del owners
        self._names.update(self._network.own_transport("udp", self._shared))

    def close(self) -> None:
        """Close the socket."""
        stop_watching(self._channel)
        self._channel.close()


class GatewayTcpSocket:
    """TCP listener of one gateway."""

    def __init__(self, network: Network, shared: SharedSocket) -> None:
        self._network = network
        self._shared = shared
        (owner,) = shared.owners
        self._names: dict[str, str] = {}
        gateway = GatewayTransport(network.gateways, self._names, owner)
        count_dropped = network.drop_counter(stations_of(shared.owners))
        # Without stations: the port belongs to the gateway, which gets AoE too.
        streams = MailboxStreams(Demultiplexer([]), gateway, count_dropped, is_aoe_here=False)
        sock = owned_copy(shared.services_fd)
        self.listener = TcpTransport(
            sock, (), network.engine, count_dropped, streams, network.listeners
        )
        self.follow(shared.owners)

    def release(self, owner: PortName) -> None:
        """Remove nothing: the socket has one owner."""

    def follow(self, owners: Sequence[PortName]) -> None:
        """Serve the gateway by the first EAP port of its station at the address."""
        del owners
        self._names.update(self._network.own_transport("tcp", self._shared))

    def close(self) -> None:
        """Close the listener, whose connections have ended."""
        self.listener.close()


def _datagram_intake(
    network: Network,
    owners: Sequence[PortName],
    sender: ChannelSender,
    is_group_frame: Callable[[memoryview], bool],
) -> FrameIntake:
    mailbox = MailboxIntake(
        Demultiplexer(network.behind("udp", owners)),
        GatewayTransport(network.gateways, transport_names("udp", owners)),
        sender,
        is_group_frame,
    )
    return FrameIntake(stations_of(owners), network.counters, network.from_ns, mailbox.receive)


def _watched_interface(address: str) -> str:
    """Return the interface with *address*, empty if its link is not watched."""
    if not (IPv4Address(address).is_loopback or IPv4Address(address).is_unspecified):
        with suppress(EnvironmentalError):  # the address was removed from this host
            return interface_of(address)
    return ""


def _has_tcp(port: PortSpec) -> bool:
    return port.tcp or port.interface.scheme == "tcp"


def _drop_mailbox(
    data: memoryview, size: int, at_ns: int, origin: FrameOrigin
) -> DropReason | None:
    """Drop each frame: the ports of the interface are not all known yet."""
    del data, size, at_ns, origin
    return DropReason.MAILBOX
