"""Faults of a segment: by a script, or by command while it runs.

What hits frames is counted in frames, what hits slaves begins and ends at a time, so that a run can
be repeated exactly.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any, NamedTuple

from devicebus.sim.devices.pdoobjects import TX_PDO
from devicebus.sim.findentry import find_entry
from devicebus.sim.segment import Segment
from devicebus.sim.slave import Slave
from devicebus.sim.slavefault import SLAVE_FAULTS
from devicebus.sim.spec import FaultKind, FaultSpec
from devicebus.sim.wiring import Side
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import OVERHEAD, DatagramHeader
from eap.codec.ethercat import EtherCatHeader
from eap.ids import ObjectId

_MS = 1_000_000
_ON_FRAMES = frozenset((FaultKind.LOSS, FaultKind.DELAY, FaultKind.CORRUPT, FaultKind.WKC))


class Outgoing(NamedTuple):
    """A frame on its way back; *origin* is what it was received with."""

    frame: bytearray
    side: Side
    origin: Any


class FaultySegment:
    """A segment to which things happen.

    Args:
        segment: The segment.
        script: Faults with their times, counted from the first call that has a time.
    """

    def __init__(self, segment: Segment, script: Iterable[FaultSpec] = ()) -> None:
        self.segment = segment
        self._numbers = {slave.device.name: n for n, slave in enumerate(segment.slaves)}
        self._script = list(script)
        for spec in self._script:
            self.check(spec)
        self._started_ns: int | None = None
        self._due: list[tuple[int, int, Callable[[int], None]]] = []
        self._order = count()
        self._on_frames: dict[FaultSpec, int] = {}
        self._returning: list[tuple[int, int, Outgoing]] = []

    def check(self, spec: FaultSpec) -> None:
        """Raise ValueError if there is no such slave, object or state."""
        needs_slave = spec.kind not in _ON_FRAMES or spec.kind is FaultKind.CORRUPT
        if needs_slave and spec.slave not in self._numbers:
            known = ", ".join(self._numbers)
            problem = f"no slave {spec.slave!r}" if spec.slave else "it needs a slave"
            raise ValueError(f"fault {spec.kind.value}: {problem} (one of {known})")
        if spec.kind is FaultKind.SDO:
            ObjectId.parse(spec.object)
        is_tx_pdo = spec.kind is FaultKind.TX_PDO
        if is_tx_pdo and not 0 <= ObjectId.parse(spec.object).object_index - TX_PDO < 0x200:
            raise ValueError(f"fault tx-pdo: {spec.object} is no TxPDO (0x1A00 to 0x1BFF)")
        if spec.kind is FaultKind.REFUSE and spec.state not in AlState.__members__:
            known = ", ".join(AlState.__members__)
            raise ValueError(f"fault refuse: no state {spec.state!r} (one of {known})")

    def begin(self, spec: FaultSpec, now_ns: int) -> None:
        """Let a fault happen now or, if it has a time, then; *at_ms* counts from now.

        Raises:
            ValueError: there is no such slave, object or state.
        """
        self.check(spec)
        at = now_ns + spec.at_ms * _MS
        self._push(at, lambda now: self._switch(spec, now, on=True))
        if spec.for_ms is not None:
            self._push(at + spec.for_ms * _MS, lambda now: self._switch(spec, now, on=False))
        self._run_due(now_ns)

    def end(self, spec: FaultSpec, now_ns: int) -> None:
        """End the fault that *spec* describes."""
        self.check(spec)
        self._switch(spec, now_ns, on=False)

    def set_value(self, slave: str, entry: str, value: object, now_ns: int) -> None:
        """Let an entry of a slave keep *value*, whatever changes it otherwise.

        Args:
            slave: Its name.
            entry: Name of an input, an output or another entry, or such as ``0x6000:1``.
            value: Of the entry's type.
            now_ns: The time.

        Raises:
            ValueError: there is no such slave or entry, or it has no such value.
        """
        found = self._slave(slave)
        found.device.override(*find_entry(found.device, entry), value)
        found.offer_inputs(now_ns)

    def release(self, slave: str, entry: str, now_ns: int) -> None:
        """End :meth:`set_value`; raise ValueError if there was none."""
        found = self._slave(slave)
        if not found.device.release(*find_entry(found.device, entry)):
            raise ValueError(f"{slave}: {entry} was not set")
        found.offer_inputs(now_ns)

    def _slave(self, name: str) -> Slave:
        if name not in self._numbers:
            raise ValueError(f"no slave {name!r} (one of {', '.join(self._numbers)})")
        return self.segment.slaves[self._numbers[name]]

    def receive_frame(
        self, frame: bytearray, now_ns: int, *, side: Side = Side.PRIMARY, origin: Any = None
    ) -> None:
        """Let a frame enter; what comes back is in :meth:`frames_to_send`."""
        self.handle_timeout(now_ns)
        delay_ns = 0
        change_wkc = False
        for spec in [spec for spec in self._on_frames if self._hits(spec)]:
            if spec.kind is FaultKind.LOSS:
                return
            if spec.kind is FaultKind.CORRUPT:
                self.segment.break_frame(frame, now_ns, side, self._numbers[spec.slave])
                return
            if spec.kind is FaultKind.DELAY:
                delay_ns += 1000 * spec.delay_us
            change_wkc |= spec.kind is FaultKind.WKC
        out = self.segment.process_frame(frame, now_ns, side)
        if out is None:
            return
        if change_wkc:
            spoil_working_counters(frame)
        entry = (now_ns + delay_ns, next(self._order), Outgoing(frame, out, origin))
        heapq.heappush(self._returning, entry)

    def frames_to_send(self, now_ns: int) -> list[Outgoing]:
        """Take the frames that are back."""
        ready = []
        while self._returning and self._returning[0][0] <= now_ns:
            ready.append(heapq.heappop(self._returning)[2])
        return ready

    def next_timeout(self) -> int | None:
        """Return when something is due: a frame, a fault, or a slave."""
        times = [self.segment.next_timeout()]
        times += [queue[0][0] for queue in (self._due, self._returning) if queue]
        return min((at for at in times if at is not None), default=None)

    def handle_timeout(self, now_ns: int) -> None:
        """Let faults begin and end, and slaves look at the time."""
        if self._started_ns is None:
            self._started_ns = now_ns
            for spec in self._script:
                self.begin(spec, now_ns)
        self._run_due(now_ns)
        self.segment.handle_timeout(now_ns)

    def _push(self, at_ns: int, action: Callable[[int], None]) -> None:
        heapq.heappush(self._due, (at_ns, next(self._order), action))

    def _run_due(self, now_ns: int) -> None:
        while self._due and self._due[0][0] <= now_ns:
            heapq.heappop(self._due)[2](now_ns)

    def _hits(self, spec: FaultSpec) -> bool:
        self._on_frames[spec] += 1
        return self._on_frames[spec] % spec.every == 0

    def _switch(self, spec: FaultSpec, now_ns: int, *, on: bool) -> None:
        if spec.kind in _ON_FRAMES:
            if on:
                self._on_frames[spec] = 0
            else:
                self._on_frames.pop(spec, None)
            return
        number = self._numbers[spec.slave]
        if spec.kind is FaultKind.CUT:
            (self.segment.cut if on else self.segment.mend)(number)
        elif spec.kind is FaultKind.POWER:
            self.segment.switch(number, on=not on)
        else:
            SLAVE_FAULTS[spec.kind](self.segment.slaves[number], spec, now_ns, on)


def spoil_working_counters(frame: bytearray) -> None:
    """Make every working counter of a whole frame one too small."""
    offset = EtherCatHeader.SIZE
    while offset + OVERHEAD <= len(frame):
        header = DatagramHeader.decode(frame, offset)
        at = offset + DatagramHeader.SIZE + header.length
        wkc = int.from_bytes(frame[at : at + 2], "little")
        frame[at : at + 2] = max(0, wkc - 1).to_bytes(2, "little")
        offset += OVERHEAD + header.length
        if not header.more:
            break
