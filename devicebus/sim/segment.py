"""Simulated segment: slaves, cables, and the path of frames through them.

A controller forwards a frame from port to port in the order 0, 3, 1, 2 and processes it at port 0;
a port without a link loops it back.  The order of the slaves, branches, the reach behind a cut
cable, and the ring with a second line to the master follow from this rule.

A frame begins at its EtherCAT header; Ethernet and UDP belong to drivers.  The caller passes the
time, so that a run is repeatable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple, TypeAlias

from devicebus.sim.processing import Chain
from devicebus.sim.slave import SimulatedSlave
from devicebus.wire.register import Register

FORWARD_NS = 300
"""Delay from the arrival at a port to the exit at the next."""
CABLE_NS = 50
_NEXT_PORT = {0: 3, 3: 1, 1: 2, 2: 0}

PortAt: TypeAlias = "tuple[int, int]"
"""Number of a slave, and one of its ports."""


SECOND_LINE = -1
"""Number of the cable from the ring's end to the second line of the master."""


class SegmentEnd(IntEnum):
    """End of the segment at the master; the secondary end exists in a ring only."""

    PRIMARY = 0
    SECONDARY = 1


class FramePath(NamedTuple):
    """Path of a frame that enters at one end."""

    order: tuple[int, ...]
    """Slaves that process the frame, in order."""
    arrivals: dict[PortAt, int]
    """Time from its entry to its arrival at each port, in ns."""
    processed: dict[int, int]
    """Time from its entry to each slave's processing unit; a looped port 0 leads there, too."""
    exit: SegmentEnd
    closed_at: int | None
    """Index in *order* of the first slave without a link at port 0."""


Links: TypeAlias = Mapping[PortAt, "PortAt | SegmentEnd"]
"""Other end of each port's cable; ports without a link are missing."""


def trace_path(links: Links, enters: PortAt, cable_ns: int = CABLE_NS) -> FramePath:
    """Return the path of a frame from the port where it enters until it leaves the segment."""
    order: list[int] = []
    arrivals: dict[PortAt, int] = {}
    processed: dict[int, int] = {}
    closed_at = None
    slave, port = enters
    time_ns = 0
    is_loop = False
    while True:
        if not is_loop:
            arrivals[slave, port] = time_ns
        # The processing unit is behind port 0, on the way in.
        if port == 0:
            if is_loop and closed_at is None:
                closed_at = len(order)
            order.append(slave)
            processed[slave] = time_ns
        port = _NEXT_PORT[port]
        target = links.get((slave, port))
        if isinstance(target, SegmentEnd):
            return FramePath(tuple(order), arrivals, processed, target, closed_at)
        is_loop = target is None
        if target is not None:
            slave, port = target
            time_ns += FORWARD_NS + cable_ns


def dl_status(joined: frozenset[int], closed_links: frozenset[int] = frozenset()) -> int:
    """Return the DL status of a powered controller with a link at the ports *joined*.

    Ports of *closed_links* have a link, too, but their loop was closed by the master.
    """
    status = 0x0007
    for port in range(4):
        closed = port not in joined
        status |= (port in joined or port in closed_links) << 4 + port
        status |= (0x01 if closed else 0x02) << 8 + 2 * port
    return status


POLL_NS = 1_000_000
"""Period of the timers of slaves, MAX_POLLED slaves at once."""
# With 200 slaves each timer is checked every 4 ms; all at once would use half of a processor.
MAX_POLLED = 64
"""Limit per period."""
CATCH_UP_NS = 20_000_000
"""Time in which a late caller passes the frames that wait."""


class Cable(NamedTuple):
    """Cable from port 0 of slave number *child* to a port of slave number *parent*."""

    child: int
    parent: int
    parent_port: int = 1


class SimulatedSegment:
    """Slaves in a tree; port 0 of the first is connected to the master.

    Args:
        slaves: Slaves, numbered from 0.
        cables: One for each slave but the first; by default a line through ports 1.
        ring_end: Port with the second line to the master; None without a ring.
        cable_ns: Delay of each cable.
    """

    def __init__(
        self,
        slaves: Sequence[SimulatedSlave],
        cables: Sequence[Cable] | None = None,
        *,
        ring_end: PortAt | None = None,
        cable_ns: int = CABLE_NS,
    ) -> None:
        self.slaves = tuple(slaves)
        if cables is None:
            cables = [Cable(number, number - 1) for number in range(1, len(slaves))]
        self._cables = tuple(cables)
        self._ring_end = ring_end
        self._cable_ns = cable_ns
        self._cut: set[int] = set()
        self._poll_at_ns: int | None = None
        self._next_polled = 0
        self._update_wiring()

    @property
    def is_ring(self) -> bool:
        """True if it has a second line to the master."""
        return self._ring_end is not None

    def cut(self, child: int) -> None:
        """Cut the cable at port 0 of slave *child* (0: to the master), or SECOND_LINE."""
        self._cut.add(child)
        self._update_wiring()

    def mend(self, child: int) -> None:
        """Reconnect that cable."""
        self._cut.discard(child)
        self._update_wiring()

    def switch(self, number: int, *, on: bool) -> None:
        """Switch a slave off or on."""
        self.slaves[number].switch(on=on)
        self._update_wiring()

    def process_frame(
        self, frame: bytearray, now_ns: int, side: SegmentEnd = SegmentEnd.PRIMARY
    ) -> SegmentEnd | None:
        """Pass *frame* through the segment, modified in place.

        Returns:
            End at which it comes out, None if it is lost.
        """
        self.handle_timeout(now_ns)
        chain = self._chains[side]
        if chain is None:
            return None
        survives = chain.process(frame, now_ns)
        self._run_slaves(side, now_ns)
        path = self._paths[side]
        return path.exit if survives and path is not None else None

    def break_frame(self, frame: bytearray, now_ns: int, side: SegmentEnd, number: int) -> None:
        """Damage a frame on the cable in front of slave *number*.

        The slaves in front process it; the slave counts an error, those behind a forwarded error,
        and none of these processes it.
        """
        self.handle_timeout(now_ns)
        path = self._paths[side]
        if path is None or number not in path.order:
            return
        position = path.order.index(number)
        reached = self._reached[side]
        # A chain of its own: the cached one of the segment belongs to whole paths.
        Chain([slave.esc for slave in reached[:position]]).process(frame, now_ns)
        self._run_slaves(side, now_ns)
        reached[position].esc.count_error(Register.RX_ERROR)
        for slave in reached[position + 1 :]:
            slave.esc.count_error(Register.FORWARDED_RX_ERROR)

    def next_timeout(self) -> int | None:
        """Return the next time for :meth:`handle_timeout`."""
        first = None
        for slave in self.slaves:
            at = slave.next_timeout()
            if at is not None and (first is None or at < first):
                first = at
        # Timers of slaves are checked once per POLL_NS: an earlier call has no effect.
        return first if first is None else max(first, self._poll_at_ns or 0)

    def handle_timeout(self, now_ns: int) -> None:
        """Handle the timers of slaves; calls within POLL_NS cost nothing."""
        if self._poll_at_ns is not None and now_ns < self._poll_at_ns:
            return
        self._poll_at_ns = now_ns + POLL_NS
        first = self._next_polled
        end = first + MAX_POLLED
        # In turn, so that every slave is polled, whatever their number.
        self._next_polled = end if end < len(self.slaves) else 0
        for slave in self.slaves[first:end]:
            slave.handle_timeout(now_ns)

    def postpone_timeouts(self, now_ns: int) -> None:
        """Process frames that waited while the caller did not run before any timer."""
        # A watchdog must not expire because the simulation's process was late to pass outputs that
        # had arrived in time.
        self._poll_at_ns = now_ns + CATCH_UP_NS

    def _run_slaves(self, side: SegmentEnd, now_ns: int) -> None:
        is_changed = False
        for slave in self._reached[side]:
            esc = slave.esc
            if esc.al_event:
                slave.run(now_ns)
            # Rewired after the frame only: it keeps the path on which it entered.
            is_changed |= esc.loops_changed
        if is_changed:
            self._update_wiring()

    def _update_wiring(self) -> None:
        links = self._links()
        self._paths: list[FramePath | None] = [None, None]
        self._chains: list[Chain | None] = [None, None]
        self._reached: list[tuple[SimulatedSlave, ...]] = [(), ()]
        for end, side in [(position, side) for position, side in links.items() if side in _SIDES]:
            assert isinstance(side, SegmentEnd)  # noqa: S101  by the filter
            path = trace_path(links, end, self._cable_ns)
            reached = tuple(self.slaves[number] for number in path.order)
            self._paths[side] = path
            self._reached[side] = reached
            self._chains[side] = Chain([each.esc for each in reached], closed_at=path.closed_at)
            for number in path.order:
                self.slaves[number].esc.port_delays = tuple(
                    path.arrivals.get((number, port)) for port in range(4)
                )
                self.slaves[number].esc.processing_delay = path.processed[number]
        joined: list[set[int]] = [set() for _ in self.slaves]
        for number, port in links:
            joined[number].add(port)
        for slave, ports in zip(self.slaves, joined, strict=True):
            slave.esc.loops_changed = False
            slave.esc.set_dl_status(dl_status(frozenset(ports), self._closed_links(slave)))

    def _closed_links(self, slave: SimulatedSlave) -> frozenset[int]:
        """Return the port of the second line if its loop was closed: its link is not lost."""
        if self._ring_end is None or SECOND_LINE in self._cut:
            return frozenset()
        number, port = self._ring_end
        return frozenset((port,)) if slave is self.slaves[number] else frozenset()

    def _links(self) -> dict[PortAt, PortAt | SegmentEnd]:
        links: dict[PortAt, PortAt | SegmentEnd] = {}
        if self.slaves and 0 not in self._cut and self._is_open(0, 0):
            links[0, 0] = SegmentEnd.PRIMARY
        for child, parent, port in self._cables:
            is_connected = child not in self._cut
            if is_connected and self._is_open(child, 0) and self._is_open(parent, port):
                links[child, 0] = (parent, port)
                links[parent, port] = (child, 0)
        has_second = self._ring_end is not None and SECOND_LINE not in self._cut
        if self._ring_end is not None and has_second and self._is_open(*self._ring_end):
            links[self._ring_end] = SegmentEnd.SECONDARY
        return links

    def _is_open(self, number: int, port: int) -> bool:
        slave = self.slaves[number]
        return slave.is_powered and slave.esc.loop_control(port) != 3


_SIDES = frozenset(SegmentEnd)
