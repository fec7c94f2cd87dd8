"""Shared sockets of an appliance: planned from the stations, opened once, kept open, handed down.

The kernel sorts frames between engine and services by the order in which the two sockets of a pair
joined, and that order changes when one of them closes.  Hence one process opens them all, and holds
each as long as a port needs it: both processes may restart meanwhile.

A simulated segment is a process at the other end of a pair.  Both ends stay open here, so either
process may die and restart: what was sent meanwhile is lost, as frames are on a cut cable.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from msgspec.structs import replace

from eap.closeable import Closeable
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
from eap.pd.spec import StationSpec
from eap.runtime.handover import (
    NO_DESCRIPTOR,
    BusSocket,
    Handover,
    PortName,
    SharedSocket,
    SocketKind,
)
from eap.runtime.passing import (
    CloseSocket,
    KeepBuses,
    OpenBus,
    OpenSocket,
    SupervisorRequests,
)
from eap.runtime.socket_plan import plan_buses, plan_sockets


def open_message_pair(opened: ExitStack) -> tuple[int, int]:
    """Open a pair of descriptors on which messages keep their borders."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    first, second = (opened.enter_context(end).fileno() for end in ends)
    return first, second


def _open_bus(planned: BusSocket, opened: ExitStack) -> BusSocket:
    if not planned.is_simulated:
        uris = [planned.interface, *([planned.redundant] if planned.redundant else [])]
        fds = [
            opened.enter_context(open_bus_socket(InterfaceUri.parse(uri))).fileno() for uri in uris
        ]
        return replace(planned, engine_fd=fds[0], second_fd=fds[1] if fds[1:] else NO_DESCRIPTOR)
    engine_fd, segment_fd = open_message_pair(opened)
    command_fd, segment_command_fd = open_message_pair(opened)
    second_fd = segment_second_fd = NO_DESCRIPTOR
    if planned.redundant:
        second_fd, segment_second_fd = open_message_pair(opened)
    return replace(
        planned,
        engine_fd=engine_fd,
        segment_fd=segment_fd,
        segment_command_fd=segment_command_fd,
        command_fd=command_fd,
        second_fd=second_fd,
        segment_second_fd=segment_second_fd,
    )


CONTROL_BACKLOG = 512


class UnavailableSocketError(EnvironmentalError):
    """A socket cannot be opened.

    Attributes:
        owners: Ports that need it.
    """

    def __init__(self, text: str, owners: tuple[PortName, ...]) -> None:
        super().__init__(text)
        self.owners = owners


class SharedSockets(Closeable):
    """All open descriptors of an appliance; the supervisor closes them at its very end.

    Sockets of ports are a table that follows the ports: services requests additions and removals.
    Each address and port number is a reuseport group of its own, so an addition changes no other.

    Attributes:
        engine_link: The engine's side of its pair with services.
        services_link: The other side.
        engine_bus: The engine's side of the pair for requests to stations and buses.
        services_bus: The other side.
        services_end: Services' side of the pair for requests to the supervisor.
        control: The listening control socket.
    """

    def __init__(self, control_path: Path) -> None:
        """Open all but the sockets of ports, or nothing.

        Raises:
            EnvironmentalError: something cannot be opened, and why.
        """
        self._table: dict[SharedSocket, SharedSocket] = {}
        self._buses: dict[BusSocket, BusSocket] = {}
        self._owned: dict[SharedSocket | BusSocket, ExitStack] = {}
        self._last_bus = 0
        self._waiting: dict[int, BusSocket] = {}
        """Requests for buses by id, until their simulated slaves are ready."""
        with ExitStack() as opened:
            opened.callback(self._close_table)
            self.engine_link, self.services_link = open_message_pair(opened)
            self.engine_bus, self.services_bus = open_message_pair(opened)
            own_end, self.services_end = open_message_pair(opened)
            self._requests = SupervisorRequests(
                opened.enter_context(socket.socket(fileno=os.dup(own_end)))
            )
            self.control = _open_control(control_path, opened).fileno()
            self._opened = opened.pop_all()

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when services requests sockets."""
        return self._requests.fileno()

    def serve(self) -> None:
        """Serve the requests of services that are there."""
        while (request := self._requests.receive()) is not None:
            match request:
                case CloseSocket():
                    self._close(request.socket.key)
                case KeepBuses():
                    self._keep_buses(request)
                case _:
                    try:
                        self._serve(request)
                    except EnvironmentalError as exc:
                        self._requests.refuse(request.id, str(exc))

    def _serve(self, request: OpenSocket | OpenBus) -> None:
        if isinstance(request, OpenSocket):
            opened = self._open(request.socket)
            pair = {"engine_fd": opened.engine_fd, "services_fd": opened.services_fd}
            self._requests.reply(request.id, _open_ones(pair))
            return
        bus = self._open_bus(request.bus)
        self._waiting[request.id] = bus.key
        if not bus.is_simulated:
            self.confirm(bus)

    @property
    def buses(self) -> tuple[BusSocket, ...]:
        """All open buses."""
        return tuple(self._buses.values())

    def confirm(self, bus: BusSocket) -> None:
        """Answer the requests for *bus*, whose slaves are ready if they are simulated."""
        lines = {
            "engine_fd": bus.engine_fd,
            "second_fd": bus.second_fd,
            "command_fd": bus.command_fd,
        }
        for number in self._take_waiting(bus):
            self._requests.reply(number, _open_ones(lines), bus.number)

    def refuse(self, bus: BusSocket, reason: str) -> bool:
        """Close *bus*, whose slaves cannot be simulated; return False if no request waits for it.

        It stays open then.
        """
        numbers = self._take_waiting(bus)
        for number in numbers:
            self._requests.refuse(number, reason)
        if numbers:
            self._close(bus.key)
        return bool(numbers)

    def fit(self, stations: Sequence[StationSpec]) -> tuple[SharedSocket, ...]:
        """Open the sockets that *stations* need beside what is open; return all of theirs.

        Raises:
            UnavailableSocketError: one cannot be opened; those that were opened stay open.
        """
        return tuple(
            replace(self._open(planned), owners=planned.owners)
            for planned in plan_sockets(stations)
        )

    def fit_buses(self, stations: Sequence[StationSpec]) -> tuple[BusSocket, ...]:
        """Open the buses that *stations* need beside what is open; returns and raises as fit."""
        return tuple(self._open_bus(planned) for planned in plan_buses(stations))

    def beyond(self, wanted: Iterable[SharedSocket]) -> list[SharedSocket]:
        """Return the open sockets of EAP ports and gateways that are not among *wanted*."""
        keys = {each.key for each in wanted}
        return [opened for key, opened in self._table.items() if key not in keys]

    def keep_only(self, wanted: Iterable[SharedSocket | BusSocket]) -> None:
        """Close all sockets and buses of ports but *wanted*."""
        for key in self._owned.keys() - {each.key for each in wanted}:
            self._close(key)

    def close(self) -> None:
        """Close all."""
        self._opened.close()

    def _open(self, planned: SharedSocket) -> SharedSocket:
        key = planned.key
        if key not in self._table:
            with ExitStack() as opened:
                try:
                    self._table[key] = _open(key, opened)
                except EnvironmentalError as exc:
                    raise UnavailableSocketError(str(exc), planned.owners) from None
                self._owned[key] = opened.pop_all()
        return self._table[key]

    def _open_bus(self, planned: BusSocket) -> BusSocket:
        key = planned.key
        if key not in self._buses:
            with ExitStack() as opened:
                try:
                    bus = _open_bus(key, opened)
                except EnvironmentalError as exc:
                    raise UnavailableSocketError(str(exc), (key.owner,)) from None
                # Counted up for each: requests to a bus that is gone must not reach another one.
                self._last_bus += 1
                self._buses[key] = replace(bus, number=self._last_bus)
                self._owned[key] = opened.pop_all()
        return self._buses[key]

    def _keep_buses(self, request: KeepBuses) -> None:
        kept = {bus.key for bus in request.buses}
        for key in [*self._buses]:
            if key.owner.station == request.station and key not in kept:
                self._close(key)

    def _take_waiting(self, bus: BusSocket) -> list[int]:
        numbers = [number for number, key in self._waiting.items() if key == bus.key]
        for number in numbers:
            del self._waiting[number]
        return numbers

    def _close(self, key: SharedSocket | BusSocket) -> None:
        if isinstance(key, BusSocket):
            self._buses.pop(key, None)
        else:
            self._table.pop(key, None)
        if (opened := self._owned.pop(key, None)) is not None:
            opened.close()

    def _close_table(self) -> None:
        self.keep_only(())


def inherited_by_engine(handover: Handover) -> list[int]:
    """Return the descriptors in the *handover* to the engine."""
    wanted = [shared.engine_fd for shared in handover.sockets]
    wanted += [fd for bus in handover.buses for fd in (bus.engine_fd, bus.second_fd)]
    return _existing(*wanted, handover.link_fd, handover.bus_fd)


def inherited_by_services(handover: Handover) -> list[int]:
    """Return the descriptors in the *handover* to services."""
    wanted = [shared.services_fd for shared in handover.sockets]
    # Those of the engine, too: services passes them to an engine that lacks them, reads what ICMP
    # says of the frames that the engine sends, and renews memberships, which end with their
    # interface.
    wanted += [shared.engine_fd for shared in handover.sockets]
    wanted += [
        fd for bus in handover.buses for fd in (bus.engine_fd, bus.second_fd, bus.command_fd)
    ]
    return _existing(
        *wanted, handover.link_fd, handover.bus_fd, handover.control_fd, handover.supervisor_fd
    )


def _open_ones(descriptors: Mapping[str, int]) -> dict[str, int]:
    return {name: fd for name, fd in descriptors.items() if fd != NO_DESCRIPTOR}


def _existing(*descriptors: int) -> list[int]:
    return [fd for fd in descriptors if fd != NO_DESCRIPTOR]


def _open(planned: SharedSocket, opened: ExitStack) -> SharedSocket:
    if planned.kind is SocketKind.AMS_BROADCAST:
        broadcast = open_ams_broadcast(planned.address, planned.group)
        if broadcast is None:
            return planned
        opened.enter_context(broadcast)
        return replace(planned, services_fd=broadcast.fileno())
    if (single := _open_single(planned)) is not None:
        opened.enter_context(single)
        return replace(planned, services_fd=single.fileno())
    engine, services = _open_pair(planned)
    opened.enter_context(engine)
    opened.enter_context(services)
    return replace(planned, engine_fd=engine.fileno(), services_fd=services.fileno())


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
