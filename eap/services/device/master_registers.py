"""Registers of slaves that the dictionary of a master shows, and the scan of its bus."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from devicebus.master.procedure import Procedure
from devicebus.master.scan import (
    Identity,
    count_slaves,
    find_topology,
    read_identity,
    read_stations,
)
from devicebus.wire.datagram import DatagramRequest, fprd
from devicebus.wire.register import AlStatus, DlStatus, Register

PORTS = 4
LOOPS = Register.DL_CONTROL + 1
"""Register with the loop control of the four ports, two bits each."""
# Every step takes a cycle.
_EACH, _AT_ONCE = 4, 15
"""Registers of a slave, and slaves that are read at a time."""


class SlaveRegisters(NamedTuple):
    """The registers of one slave; all 0 for one that does not answer."""

    al: AlStatus = AlStatus(0)
    dl: DlStatus = DlStatus()
    dl_word: int = 0
    loops: int = 0
    errors: tuple[int, ...] = (0,) * PORTS


class DetectedSlave(NamedTuple):
    """A slave that a scan has found."""

    station: int
    identity: Identity
    dl_word: int


def communicating(status: DlStatus) -> int:
    """Return the ports with communication, bit n for port n."""
    alive = (
        status.communication0,
        status.communication1,
        status.communication2,
        status.communication3,
    )
    return sum(bool(bit) << port for port, bit in enumerate(alive))


def neighbour(
    registers: Mapping[int, SlaveRegisters], order: Sequence[int], station: int, port: int
) -> int:
    """Return the slave that is connected to a port of a slave, 0 for the master or none.

    Args:
        registers: Of the slaves that answered.
        order: Station addresses in the order of the bus.
        station: Address of the slave.
        port: Of that slave.
    """
    stations = [each for each in order if each in registers]
    nodes = find_topology([registers[each].dl for each in stations])
    for position, node in enumerate(nodes):
        there = None if node.parent is None else stations[node.parent]
        if stations[position] == station and node.entry_port == port:
            return there or 0
        if there == station and node.parent_port == port:
            return stations[position]
    return 0


def read_registers(stations: Sequence[int]) -> Procedure[dict[int, SlaveRegisters]]:
    """Read the registers that the dictionary shows, of all slaves that answer."""
    found: dict[int, SlaveRegisters] = {}
    for start in range(0, len(stations), _AT_ONCE):
        part = stations[start : start + _AT_ONCE]
        replies, _ = yield [access for station in part for access in _accesses(station)]
        for number, station in enumerate(part):
            al, dl, loops, errors = own = replies[number * _EACH : (number + 1) * _EACH]
            # A slave that answers only some of the reads is just leaving or joining the bus.
            if all(reply.wkc for reply in own):
                found[station] = SlaveRegisters(
                    AlStatus.decode(al.data),
                    DlStatus.decode(dl.data),
                    int.from_bytes(dl.data, "little"),
                    loops.data[0],
                    # Each port has two counters: invalid frames, and RX errors, which are left out.
                    tuple(errors.data[::2]),
                )
    return found


def _accesses(station: int) -> list[DatagramRequest]:
    return [
        fprd(station, Register.AL_STATUS, AlStatus.SIZE),
        fprd(station, Register.DL_STATUS, DlStatus.SIZE),
        fprd(station, LOOPS, 1),
        fprd(station, Register.RX_ERROR, 2 * PORTS),
    ]


def detect_slaves() -> Procedure[tuple[DetectedSlave, ...]]:
    """Scan the bus without disturbing it."""
    count = yield from count_slaves()
    stations = yield from read_stations(count)
    found = []
    for station in stations:
        identity = yield from read_identity(station)
        replies, _ = yield [fprd(station, Register.DL_STATUS, DlStatus.SIZE)]
        found.append(DetectedSlave(station, identity, int.from_bytes(replies[0].data, "little")))
    return tuple(found)
