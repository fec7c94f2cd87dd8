"""Shared sockets of an appliance: planned from the stations, opened once, kept open, handed down.

The kernel sorts frames between engine and services by the order in which their sockets joined, and
that order changes when a member closes.  Hence one process opens them all, in the order of the
plan, and holds them as long as the appliance lives.

A simulated segment is a process at the other end of a pair.  Both ends stay open here, so either
process may die and restart: what was sent meanwhile is lost, as frames are on a cut cable.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import msgspec

from eap.closeable import Closeable
from eap.codec.ethercat import EAP_PORT
from eap.errors import EnvironmentalError
from eap.ids import InterfaceUri
from eap.net.busport import open_bus_socket
from eap.net.ipsocket import (
    open_ams_broadcast,
    open_ams_listener,
    open_ams_socket,
    open_tcp_listener,
    open_udp_group_pair,
    open_udp_pair,
    open_udp_receiver,
)
from eap.net.packetsocket import open_arp, open_packet_pair
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.handover import (
    NO_DESCRIPTOR,
    BusSocket,
    PortName,
    SegmentHandover,
    SharedSocket,
    SocketKind,
)

SIMULATED = "sim"


def bus_ports(stations: Iterable[StationSpec]) -> Iterator[tuple[PortName, PortSpec]]:
    """Yield all bus ports, in the order that numbers them."""
    for station in stations:
        for port in station.ports:
            if port.kind is PortKind.BUS:
                yield PortName(station.name, port.name), port


def open_buses(stations: Sequence[StationSpec], opened: ExitStack) -> tuple[BusSocket, ...]:
    """Open what all bus ports need; *opened* closes it.

    Raises:
        EnvironmentalError: an interface cannot be opened, and why.
    """
    return tuple(_open_bus(name, port, opened) for name, port in bus_ports(stations))


def open_message_pair(opened: ExitStack) -> tuple[int, int]:
    """Open a pair of descriptors on which messages keep their borders."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    first, second = (opened.enter_context(end).fileno() for end in ends)
    return first, second


def segments(
    stations: Sequence[StationSpec],
    buses: Sequence[BusSocket],
    supervisor: int,
    *,
    realtime: bool,
) -> Iterator[tuple[PortName, SegmentHandover]]:
    """Yield what the process of each simulated segment is given."""
    for (name, port), bus in zip(bus_ports(stations), buses, strict=True):
        if _is_simulated(port) and port.bus is not None:
            yield (
                name,
                SegmentHandover(
                    supervisor,
                    port.bus.file,
                    frames_fd=bus.segment_fd,
                    command_fd=bus.segment_command_fd,
                    second_fd=bus.segment_second_fd,
                    realtime=realtime,
                ),
            )


def _open_bus(name: PortName, port: PortSpec, opened: ExitStack) -> BusSocket:
    if not _is_simulated(port):
        sock = opened.enter_context(open_bus_socket(port.interface))
        second_fd = NO_DESCRIPTOR
        if port.bus is not None and port.bus.redundant:
            second = open_bus_socket(InterfaceUri.parse(port.bus.redundant))
            second_fd = opened.enter_context(second).fileno()
        return BusSocket(name, engine_fd=sock.fileno(), second_fd=second_fd)
    engine_fd, segment_fd = open_message_pair(opened)
    command_fd, segment_command_fd = open_message_pair(opened)
    lines = (NO_DESCRIPTOR, NO_DESCRIPTOR)
    if port.bus is not None and port.bus.redundant:
        lines = open_message_pair(opened)
    return BusSocket(name, engine_fd, segment_fd, segment_command_fd, command_fd, *lines)


def _is_simulated(port: PortSpec) -> bool:
    return port.interface.scheme == SIMULATED


BROADCAST = "255.255.255.255"
EVERY_ADDRESS = "0.0.0.0"  # noqa: S104  what a plant file may say
CONTROL_BACKLOG = 512
_ORDER = tuple(SocketKind)


def plan_sockets(stations: Sequence[StationSpec]) -> tuple[SharedSocket, ...]:
    """Return the sockets to open for *stations*, each once, in fixed order."""
    owners: dict[SharedSocket, list[PortName]] = {}
    ports = [(station.name, port) for station in stations for port in station.ports]
    ports = [(station, port) for station, port in ports if port.kind is PortKind.EAP]
    for each in stations:
        for name, wanted in _gateway_sockets(each):
            owners.setdefault(wanted, []).append(name)
    for station, port in ports:
        for wanted in _sockets_of(port):
            owners.setdefault(wanted, []).append(PortName(station, port.name))
    ams = [(PortName(station, port.name), _ams_address(port)) for station, port in ports]
    # A socket on 0.0.0.0 occupies the port at every address, so all stations share it.
    every = any(address == EVERY_ADDRESS for _, address in ams)
    for name, address in ams:
        if address:
            for wanted in _ams_sockets(EVERY_ADDRESS if every else address):
                owners.setdefault(wanted, []).append(name)
    planned = [
        msgspec.structs.replace(wanted, owners=tuple(names)) for wanted, names in owners.items()
    ]
    return tuple(sorted(planned, key=lambda item: _ORDER.index(item.kind)))


def _sockets_of(port: PortSpec) -> Iterator[SharedSocket]:
    uri = port.interface
    number = uri.port or EAP_PORT
    if uri.scheme == "ethernet":
        yield SharedSocket(SocketKind.PACKET, uri.host)
        yield SharedSocket(SocketKind.ARP, uri.host, vlan_id=port.vlan_id)
    if uri.scheme == "udp":
        yield SharedSocket(SocketKind.UDP, uri.host, number)
        for group in port.join:
            yield SharedSocket(SocketKind.GROUP, uri.host, number, group=group)
        if port.broadcast:
            yield SharedSocket(SocketKind.GROUP, uri.host, number, group=BROADCAST)
    if uri.scheme in {"udp", "tcp"}:
        # Beside UDP too: gateway requests and published frames may come by TCP to the same port
        # (ETG.8200 has TCP as an option).
        yield SharedSocket(SocketKind.TCP, uri.host, number)


def _ams_sockets(address: str) -> Iterator[SharedSocket]:
    yield SharedSocket(SocketKind.AMS_TCP, address)
    yield SharedSocket(SocketKind.AMS_UDP, address)
    if address != EVERY_ADDRESS:  # which broadcasts arrive at too
        yield SharedSocket(SocketKind.AMS_BROADCAST, address)
        yield SharedSocket(SocketKind.AMS_BROADCAST, address, group=BROADCAST)


def _gateway_sockets(station: StationSpec) -> Iterator[tuple[PortName, SharedSocket]]:
    """Yield what gateways have to themselves, at each address of their station."""
    uris = [port.interface for port in station.ports if port.bus is None]
    hosts = dict.fromkeys(uri.host for uri in uris if uri.scheme in {"udp", "tcp"})
    for port in station.ports:
        if port.gateway is not None and port.gateway.port:
            name = PortName(station.name, port.name)
            for host in hosts:
                yield name, SharedSocket(SocketKind.GATEWAY_UDP, host, port.gateway.port)
                yield name, SharedSocket(SocketKind.GATEWAY_TCP, host, port.gateway.port)


def _ams_address(port: PortSpec) -> str:
    """Return where AMS routers listen for *port*, nothing if nowhere."""
    uri = port.interface
    return uri.host if port.ams and uri.scheme in {"udp", "tcp"} else ""


class SharedSockets(Closeable):
    """All open descriptors of an appliance; the supervisor closes them at its very end.

    Attributes:
        descriptions: The plan, with the descriptors filled in.
        buses: What belongs to each bus port.
        engine_link: The engine's side of its pair with services.
        services_link: The other side.
        engine_bus: The engine's side of the pair for requests to stations and buses.
        services_bus: The other side.
        control: The listening control socket.
    """

    def __init__(self, stations: Sequence[StationSpec], control_path: Path) -> None:
        """Open everything, or nothing: EnvironmentalError says what could not be opened."""
        with ExitStack() as opened:
            self.descriptions = tuple(_open(planned, opened) for planned in plan_sockets(stations))
            self.buses = open_buses(stations, opened)
            self.engine_link, self.services_link = open_message_pair(opened)
            self.engine_bus, self.services_bus = open_message_pair(opened)
            self.control = _open_control(control_path, opened).fileno()
            self._opened = opened.pop_all()

    def engine_descriptors(self) -> list[int]:
        """Return what the engine inherits."""
        wanted = [shared.engine_fd for shared in self.descriptions]
        wanted += [fd for bus in self.buses for fd in (bus.engine_fd, bus.second_fd)]
        return _existing(*wanted, self.engine_link, self.engine_bus)

    def services_descriptors(self) -> list[int]:
        """Return what services inherits."""
        wanted = [shared.services_fd for shared in self.descriptions]
        # Beside what it receives, what ICMP says of the frames that the engine sends, and the
        # memberships of the engine's sockets, which end with their interface:
        shared_kinds = SocketKind.UDP, SocketKind.GROUP
        wanted += [each.engine_fd for each in self.descriptions if each.kind in shared_kinds]
        wanted += [bus.command_fd for bus in self.buses]
        return _existing(*wanted, self.services_link, self.services_bus, self.control)

    def close(self) -> None:
        """Close all."""
        self._opened.close()


def _existing(*descriptors: int) -> list[int]:
    return [fd for fd in descriptors if fd != NO_DESCRIPTOR]


def _open(planned: SharedSocket, opened: ExitStack) -> SharedSocket:
    if planned.kind is SocketKind.AMS_BROADCAST:
        broadcast = open_ams_broadcast(planned.address, planned.group)
        if broadcast is None:
            return planned
        opened.enter_context(broadcast)
        return msgspec.structs.replace(planned, services_fd=broadcast.fileno())
    if (single := _open_single(planned)) is not None:
        opened.enter_context(single)
        return msgspec.structs.replace(planned, services_fd=single.fileno())
    engine, services = _open_pair(planned)
    opened.enter_context(engine)
    opened.enter_context(services)
    return msgspec.structs.replace(
        planned, engine_fd=engine.fileno(), services_fd=services.fileno()
    )


def _open_single(planned: SharedSocket) -> socket.socket | None:
    """Open what services alone gets; return None for a pair."""
    if planned.kind is SocketKind.GATEWAY_UDP:
        return open_udp_receiver(planned.address, planned.port)
    if planned.kind in {SocketKind.TCP, SocketKind.GATEWAY_TCP}:
        return open_tcp_listener(planned.address, planned.port)
    if planned.kind is SocketKind.ARP:
        return open_arp(planned.address)
    if planned.kind is SocketKind.AMS_TCP:
        return open_ams_listener(planned.address)
    if planned.kind is SocketKind.AMS_UDP:
        return open_ams_socket(planned.address)
    return None


def _open_pair(planned: SharedSocket) -> tuple[socket.socket, socket.socket]:
    if planned.kind is SocketKind.UDP:
        return open_udp_pair(planned.address, planned.port)
    if planned.kind is SocketKind.PACKET:
        return open_packet_pair(planned.address)
    return open_udp_group_pair(planned.group, planned.address, planned.port)


def _open_control(path: Path, opened: ExitStack) -> socket.socket:
    listener = opened.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
    try:
        listener.bind(str(path))
        listener.listen(CONTROL_BACKLOG)
    except OSError as exc:
        raise EnvironmentalError(f"control socket {path}: {exc.strerror}") from None
    return listener
