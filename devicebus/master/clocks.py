"""Distributed clocks: delays, offsets, drift, SYNC0 (ETG.1000.4; ESC data sheet, section I 9).

Every slave latches the time at which one frame passes its ports.  The propagation delay of each
slave and the offset of its clock follow from these times.  The first slave with a clock is the
reference clock; a datagram in every cycle distributes its time to the others.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from devicebus.errors import FrameLostError
from devicebus.master.procedure import Procedure, not_answered, read, write
from devicebus.master.scan import FoundSlave, TopologyNode
from devicebus.wire.datagram import DatagramRequest, bwr, fprd, frmw
from devicebus.wire.register import Register
from eap.od.slave_config import SyncSignals

_U32 = 0xFFFF_FFFF
_U64 = (1 << 64) - 1
_ORDER = (0, 3, 1, 2)
_SPEED_START = 0x1000
_DRIFT_FRAMES = 20
_DRIFT_PER_FRAME = 15
SYNC_LEAD_NS = 100_000_000
"""Lead time of the first SYNC0 pulse, within which its registers must be written."""


class Latched(NamedTuple):
    """Times at which one frame passed a slave, by that slave's local clock."""

    ports: tuple[int, int, int, int]
    """Receive time of each port, 32 bits."""
    processing: int
    """Receive time of the processing unit, 64 bits."""


class ClockState(NamedTuple):
    """Clock registers written to one slave."""

    station: int
    delay_ns: int
    """Propagation delay from the reference to this slave."""
    offset_ns: int


def synchronize(
    slaves: Sequence[FoundSlave],
    time_ns: int,
    *,
    only: frozenset[int] | None = None,
    measured: int | None = None,
) -> Procedure[tuple[ClockState, ...]]:
    """Set delays and offsets; return them, the reference clock first, empty without a clock.

    Args:
        slaves: All slaves in the order of the segment.
        time_ns: System time since 2000-01-01, used unless a clock already runs.
        only: Station addresses of slaves that came back; the others stay unchanged.
        measured: Number of slaves before the cut of a ring.  Those behind it get a delay of 0:
            their frame enters at port 1 of the last slave, for which find_delays() has no rule.

    Raises:
        WorkingCounterError: a slave does not answer.
        FrameLostError: no frame comes back.
    """
    clocks = [slave for slave in slaves if slave.esc.has_clock]
    if not clocks:
        return ()
    # A broadcast write to 0x0900 latches the receive times of all slaves by one frame.
    yield [bwr(Register.DC_RECEIVE_TIME, bytes(4))]
    latched: dict[int, Latched] = {}
    for slave in clocks:
        latched[slave.position] = yield from _read_latched(slave.station)
    line = {at: times for at, times in latched.items() if measured is None or at < measured}
    delays = dict.fromkeys(latched, 0)
    delays |= find_delays({each.position: each.node for each in slaves}, line)
    start_ns = time_ns
    # Clocks that run keep their time: a returned slave is set to the system time of the others.
    running = [slave for slave in clocks if only is not None and slave.station not in only]
    if running:
        base = running[0]
        octets = yield from read(base.station, Register.DC_SYSTEM_TIME_OFFSET, 8, "DC offset")
        shown = latched[base.position].processing + int.from_bytes(octets, "little")
        start_ns = shown - delays[base.position]
    states = []
    for slave in clocks:
        offset = (start_ns + delays[slave.position] - latched[slave.position].processing) & _U64
        state = ClockState(slave.station, delays[slave.position], offset)
        states.append(state)
        if only is None or slave.station in only:
            yield from _write_state(state)
    for _ in range(_DRIFT_FRAMES):
        # The control loops of the slaves settle by many drift datagrams before SYNC0 may start.
        with suppress(FrameLostError):  # one time less
            yield [drift_datagram(clocks[0].station)] * _DRIFT_PER_FRAME
    return tuple(states)


def find_delays(
    nodes: Mapping[int, TopologyNode], latched: Mapping[int, Latched]
) -> dict[int, int]:
    """Return the delay to each slave with a clock, by position; 0 for the first."""
    delays: dict[int, int] = {}
    for position in sorted(latched):
        # A slave without a clock is treated as part of the cable.
        parent, port = _clocked_parent(position, nodes, latched)
        if parent is None:
            delays[position] = 0
            continue
        above, times = nodes[parent], latched[parent].ports
        before = _port_before(above, port)
        # Receive times are 32 bits and wrap every 4.3 s: differences are taken modulo 2**32.
        round_trip = times[port] - times[before] & _U32
        inside = _inside(nodes[position], latched[position].ports)
        earlier = times[before] - times[above.entry_port] & _U32
        # Half of the cable's round trip: both directions are taken as equally long.
        delays[position] = delays[parent] + earlier + max(0, round_trip - inside) // 2
    return delays


def drift_datagram(reference: int) -> DatagramRequest:
    """Return the datagram that distributes the reference's time; one is part of every cycle."""
    return frmw(reference, Register.DC_SYSTEM_TIME, 8)


def start_sync(station: int, signals: SyncSignals) -> Procedure[int]:
    """Start SYNC0 and SYNC1 in a slave whose clock is set; return the time of the first pulse.

    Raises WorkingCounterError if the slave does not answer.
    """
    # The sync unit is stopped while its start time and cycles change.
    yield from stop_sync(station, signals.activate)
    octets = yield from read(station, Register.DC_SYSTEM_TIME, 8, "DC system time")
    earliest = int.from_bytes(octets, "little") + SYNC_LEAD_NS
    # A multiple of the cycle: slaves with one cycle and shift pulse together, whenever they start.
    start = -(-earliest // signals.cycle0_ns) * signals.cycle0_ns + signals.shift0_ns
    yield from write(station, Register.DC_START_TIME, start.to_bytes(8, "little"), "SYNC0 start")
    cycles = signals.cycle0_ns.to_bytes(4, "little") + signals.cycle1_ns.to_bytes(4, "little")
    yield from write(station, Register.DC_SYNC0_CYCLE, cycles, "SYNC cycles")
    activation = bytes((signals.activate >> 8,))
    yield from write(station, Register.DC_ACTIVATION, activation, "DC activation")
    return start


def stop_sync(station: int, activate: int) -> Procedure[None]:
    """Stop SYNC0 and SYNC1; the low byte of *activate* (AssignActivate) stays in effect.

    Raises WorkingCounterError if the slave does not answer.
    """
    yield from write(station, Register.DC_ACTIVATION, b"\0", "DC activation")
    owner = bytes((activate & 0xFF,))
    yield from write(station, Register.DC_CYCLIC_UNIT, owner, "DC cyclic unit")


def read_difference(station: int) -> Procedure[int]:
    """Return the difference of a slave's clock from the reference in ns, positive if ahead."""
    octets = yield from read(station, Register.DC_SYSTEM_TIME_DIFFERENCE, 4, "DC difference")
    value = int.from_bytes(octets, "little")
    # 0x092C is sign and magnitude, not two's complement; bit 31 means behind the reference.
    magnitude = value & 0x7FFF_FFFF
    return -magnitude if value >> 31 else magnitude


def _read_latched(station: int) -> Procedure[Latched]:
    replies, _ = yield [
        fprd(station, Register.DC_RECEIVE_TIME, 16),
        fprd(station, Register.DC_RECEIVE_TIME_ECAT, 8),
    ]
    for reply in replies:
        if reply.wkc != 1:
            raise not_answered(f"slave {station}: reading receive times", reply)
    ports, processing = (reply.data for reply in replies)
    first, second, third, fourth = (
        int.from_bytes(ports[at : at + 4], "little") for at in range(0, 16, 4)
    )
    return Latched((first, second, third, fourth), int.from_bytes(processing, "little"))


def _write_state(state: ClockState) -> Procedure[None]:
    offset = state.offset_ns.to_bytes(8, "little")
    yield from write(state.station, Register.DC_SYSTEM_TIME_OFFSET, offset, "DC offset")
    delay = state.delay_ns.to_bytes(4, "little")
    yield from write(state.station, Register.DC_SYSTEM_TIME_DELAY, delay, "DC delay")
    speed = _SPEED_START.to_bytes(2, "little")
    yield from write(state.station, Register.DC_SPEED_START, speed, "DC speed")


def _clocked_parent(
    position: int, nodes: Mapping[int, TopologyNode], latched: Mapping[int, Latched]
) -> tuple[int | None, int]:
    """Return the nearest slave with a clock towards the master, and its port to this slave."""
    node = nodes[position]
    while node.parent is not None and node.parent not in latched:
        if node.parent not in nodes:
            return None, 0
        node = nodes[node.parent]
    return node.parent, node.parent_port


def _port_order(node: TopologyNode) -> list[int]:
    """Return the open ports in the order in which a frame enters them."""
    turn = _ORDER.index(node.entry_port)
    return [port for port in _ORDER[turn:] + _ORDER[:turn] if port in node.ports]


def _port_before(node: TopologyNode, port: int) -> int:
    order = _port_order(node)
    return order[order.index(port) - 1]


def _inside(node: TopologyNode, times: Sequence[int]) -> int:
    """Return the time from a frame's arrival at a slave to its last return from behind it."""
    return times[_port_order(node)[-1]] - times[node.entry_port] & _U32
