"""Diagnosis of a bus: AL status and error counters of the ports of every slave.

The first slave that receives a damaged frame counts it as invalid, the slaves behind it as
forwarded; the first port that counts is next to the faulty cable or slave (ESC data sheet).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import msgspec

from devicebus.errors import FrameLostError
from devicebus.master.procedure import Procedure
from devicebus.master.scan import find_topology
from devicebus.wire.alstatus import ERROR, name_of, state_name
from devicebus.wire.datagram import DatagramReply, fprd, fpwr
from devicebus.wire.register import AlStatus, DlStatus, Register

_PORTS = 4
COUNTERS = 0x14
"""Bytes of all error counters of a controller."""
_PER_STEP = 15


class PortErrors(msgspec.Struct, frozen=True):
    """Counters of one port; each stops at 255."""

    port: int
    is_open: bool
    invalid_frames: int
    physical: int
    forwarded: int
    lost_links: int

    @property
    def total(self) -> int:
        """Sum of the errors that arose at this port, without forwarded ones."""
        return self.invalid_frames + self.physical + self.lost_links


class SlaveDiagnosis(msgspec.Struct, frozen=True):
    """Diagnosis of one slave; empty if it does not answer."""

    station: int
    answers: bool
    state: str = ""
    code: int = 0
    text: str = ""
    """Text of *code*."""
    ports: tuple[PortErrors, ...] = ()


class Fault(msgspec.Struct, frozen=True):
    """Port at which errors start, at the slave or on the cable of that port."""

    station: int
    port: int
    neighbour: int | None
    """Station address of the slave at the other end; None for the master or an open end."""


class BusDiagnosis(msgspec.Struct, frozen=True):
    """Diagnosis of all slaves in the order of the segment."""

    slaves: tuple[SlaveDiagnosis, ...]
    faults: tuple[Fault, ...] = ()
    """Ports that have counted errors, in the order of the frame."""
    is_silent: bool = False
    """True if no frame came back, so that the state of every slave is unknown."""

    @property
    def first_fault(self) -> Fault | None:
        """The first port in the order of the frame that has counted errors."""
        return self.faults[0] if self.faults else None


def diagnose(stations: Sequence[int]) -> Procedure[BusDiagnosis]:
    """Read AL status and counters of slaves given in the order of the segment."""
    found = []
    statuses = []
    try:
        read = yield from _read(stations)
    except FrameLostError:
        silent = tuple(SlaveDiagnosis(station, answers=False) for station in stations)
        return BusDiagnosis(silent, is_silent=True)
    for station, replies in read:
        slave, status = _slave(station, replies)
        found.append(slave)
        statuses.append(status)
    return BusDiagnosis(tuple(found), tuple(_faults(found, statuses)))


def port_counters(octets: bytes) -> tuple[int, ...]:
    """Return the sum of the errors that arose at each port."""
    return tuple(
        octets[2 * port] + octets[2 * port + 1] + octets[16 + port] for port in range(_PORTS)
    )


def clear_counters(stations: Sequence[int]) -> Procedure[None]:
    """Reset all error counters; slaves that do not answer are skipped."""
    for start in range(0, len(stations), _PER_STEP):
        part = stations[start : start + _PER_STEP]
        yield [fpwr(at, Register.RX_ERROR, bytes(COUNTERS)) for at in part]


def _read(stations: Sequence[int]) -> Procedure[list[tuple[int, list[DatagramReply]]]]:
    found = []
    for station in stations:
        replies, _ = yield [
            fprd(station, Register.AL_STATUS, AlStatus.SIZE),
            fprd(station, Register.DL_STATUS, DlStatus.SIZE),
            fprd(station, Register.RX_ERROR, COUNTERS),
        ]
        found.append((station, list(replies)))
    return found


def _slave(station: int, replies: Sequence[DatagramReply]) -> tuple[SlaveDiagnosis, DlStatus]:
    al, dl, counters = replies
    if not (al.wkc and dl.wkc and counters.wkc):
        return SlaveDiagnosis(station, answers=False), DlStatus()
    status = AlStatus.decode(al.data)
    dl_status = DlStatus.decode(dl.data)
    open_ports = find_topology([dl_status])[0].ports
    octets = counters.data
    ports = tuple(
        PortErrors(
            port,
            port in open_ports,
            octets[2 * port],
            octets[2 * port + 1],
            octets[8 + port],
            octets[16 + port],
        )
        for port in range(_PORTS)
    )
    shown = state_name(status.state | (ERROR if status.error else 0))
    text = name_of(status.code) if status.code else ""
    return SlaveDiagnosis(station, True, shown, status.code, text, ports), dl_status


def _faults(slaves: Sequence[SlaveDiagnosis], statuses: Sequence[DlStatus]) -> Iterator[Fault]:
    nodes = find_topology(statuses)
    for position, slave in enumerate(slaves):
        node = nodes[position]
        for port in slave.ports:
            if not port.total:
                continue
            if port.port == node.entry_port:
                parent = node.parent
                neighbour = None if parent is None else slaves[parent].station
            else:
                children = (
                    slaves[number].station
                    for number, each in enumerate(nodes)
                    if (each.parent, each.parent_port) == (position, port.port)
                )
                neighbour = next(children, None)
            yield Fault(slave.station, port.port, neighbour)
