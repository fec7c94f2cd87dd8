"""What belongs to the bus ports of an appliance: opened once, kept open, handed on.

A simulated segment is a process at the other end of a pair.  Both ends stay open here, so either
side may die and come back: what was sent meanwhile is lost, as frames are on a cut cable.
"""

from __future__ import annotations

import socket
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack

from eap.ids import InterfaceUri
from eap.net.busport import open_bus_socket
from eap.pd.spec import PortKind, PortSpec, StationSpec
from eap.runtime.handover import BusSocket, PortName, SegmentHandover

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
    return tuple(_open(name, port, opened) for name, port in bus_ports(stations))


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
                    realtime=realtime,
                ),
            )


def _open(name: PortName, port: PortSpec, opened: ExitStack) -> BusSocket:
    if not _is_simulated(port):
        sock = opened.enter_context(open_bus_socket(InterfaceUri.parse(port.interface)))
        return BusSocket(name, engine_fd=sock.fileno())
    engine_fd, segment_fd = open_message_pair(opened)
    command_fd, segment_command_fd = open_message_pair(opened)
    return BusSocket(name, engine_fd, segment_fd, segment_command_fd, command_fd)


def _is_simulated(port: PortSpec) -> bool:
    return InterfaceUri.parse(port.interface).scheme == SIMULATED
