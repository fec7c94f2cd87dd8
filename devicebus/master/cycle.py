"""Cyclic exchange of process data: logical datagrams, expected working counters, statistics.

A slave counts in the expected working counter from the configuration of its FMMUs and sync managers
until it is lost, so that the inputs of the others stay valid without it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from enum import Enum, auto
from typing import NamedTuple

import msgspec

from devicebus.master.cyclicframe import CyclicExchange, PreparedFrame, prepare_frames
from devicebus.master.image import BusImage, DatagramGroup, SlaveLayout
from devicebus.master.link import Link
from devicebus.wire.datagram import OVERHEAD, Command, DatagramRequest, logical
from devicebus.wire.register import SmStatus

# More cycles in flight would only delay the later ones, and acyclic frames too.
MAX_UNDER_WAY = 2
"""Limit for cycles in flight."""


class Participation(Enum):
    """Participation of a slave in the cycle."""

    ABSENT = auto()
    """Not configured: it does not count."""
    UNCERTAIN = auto()
    """Counts or not: it is being configured, or is lost and may return as it was."""
    AWAY = auto()
    """Unplugged: it does not count, but may return as it was."""
    ACTIVE = auto()


_COUNTING = frozenset((Participation.ACTIVE, Participation.UNCERTAIN))


class CycleStats(msgspec.Struct, frozen=True, kw_only=True):
    """Counters since the start of the exchange; times in nanoseconds."""

    cycles: int
    good: int
    """Cycles that came back with the expected working counters."""
    wkc_errors: int
    late: int
    """Cycles that came back after their time-out; their inputs were used."""
    lost: int
    """Cycles that never came back."""
    skipped: int
    """Cycles not sent because MAX_UNDER_WAY were in flight."""
    expected_wkc: int
    received_wkc: int
    """Expected and received working counter of the last cycle, over all datagrams."""
    trip_ns: int
    """Time from queueing the last cycle to its reply."""
    max_trip_ns: int


class _CyclicDatagram(NamedTuple):
    """One datagram of a cycle."""

    command: Command
    address: int
    group: int


class _Reply(NamedTuple):
    """Place of a datagram's reply."""

    frame: int
    """Number of its frame in the cycle."""
    start: int
    end: int
    """Of its data; the working counter follows."""


class Cycle:
    """Exchange of the process data of *image*, once per call of start().

    Args:
        link: Link that sends the datagrams.
        image: Outputs and inputs.
        knows_lrw: True if all slaves support LRW.
        on_fault: Called with the time when a cycle does not come back as expected.

    Attributes:
        is_good: True if the last cycle has come back with the expected working counters.
        note_time: Called with the time that the first extra datagram brought, and the present one.
    """

    def __init__(
        self, link: Link, image: BusImage, on_fault: Callable[[int], None], *, knows_lrw: bool
    ) -> None:
        self._link = link
        self._image = image
        self._on_fault = on_fault
        self.note_time: Callable[[int, int], None] | None = None
        self._participation = dict.fromkeys(image.layout.slaves, Participation.ABSENT)
        self._datagrams = tuple(
            datagram
            for number, group in enumerate(image.layout.groups)
            for datagram in _datagrams_of(number, group, knows_lrw=knows_lrw)
        )
        self._members = [
            [slave for slave in image.layout.slaves.values() if slave.group == number]
            for number in range(len(image.layout.groups))
        ]
        self._all_active = [False] * len(self._members)
        self._allowed = (0,) * len(self._datagrams)
        self._expected_each = (0,) * len(self._datagrams)
        self._expected = 0
        for number in range(len(self._members)):
            self._update_expected(number)
        self.is_good = False
        self._extra: Sequence[DatagramRequest] = ()
        self._looks: Sequence[DatagramRequest] = ()
        self._note_full: Callable[[int, int], None] | None = None
        self._prepare()
        self._under_way: deque[CyclicExchange] = deque()
        self._newest = 0
        self._cycles = self._good = self._wkc_errors = 0
        self._late = self._lost = self._skipped = 0
        self._received = self._trip_ns = self._max_trip_ns = 0

    @property
    def extra(self) -> Sequence[DatagramRequest]:
        """Additional datagrams of each cycle."""
        return self._extra

    @extra.setter
    def extra(self, datagrams: Sequence[DatagramRequest]) -> None:
        self._extra = datagrams
        self._prepare()

    def set_looks(
        self, datagrams: Sequence[DatagramRequest], note_full: Callable[[int, int], None]
    ) -> int:
        """Have cycles with *looks* take status reads of mailboxes along, as many as fit.

        Args:
            datagrams: Reads of one byte, the status of the sync manager.
            note_full: Called with the number of each datagram that found a message, and the time.

        Returns:
            The number of datagrams that fit.
        """
        room, count = 0, 0
        if self._frames:
            last = self._frames[-1]
            room, count = self._link.room_behind(last.size, len(last.places))
        self._looks = datagrams[: min(count, room // (OVERHEAD + 1))]
        self._note_full = note_full
        self._prepare()
        return len(self._looks)

    def _prepare(self) -> None:
        """Prepare the frames of the next cycles; those that are under way stay as they are."""
        requests = [*map(self._request, self._datagrams), *self._extra]
        self._frames = prepare_frames(requests)
        self._looking = prepare_frames([*requests, *self._looks]) if self._looks else self._frames
        places = [
            _Reply(number, *place)
            for number, frame in enumerate(self._looking)
            for place in frame.places
        ]
        count = len(self._datagrams)
        self._replies, self._extra_replies = places[:count], places[count : len(requests)]
        self._look_replies = places[len(requests) :]
        self._writes = [
            write
            for frames in (self._frames, self._looking)[: 2 if self._looks else 1]
            for write in self._writes_of(frames)
        ]

    def set_participation(self, station: int, participation: Participation) -> None:
        """Change the participation of a slave."""
        if station in self._participation and self._participation[station] is not participation:
            self._participation[station] = participation
            self._update_expected(self._image.layout.slaves[station].group)

    def participation(self, station: int) -> Participation:
        """Return the participation of a slave."""
        return self._participation.get(station, Participation.ABSENT)

    @property
    def is_full(self) -> bool:
        """True if the last cycle came back with the full working counter of all active slaves."""
        return self.is_good and self._received >= self._expected > 0

    def is_expected(self, address: int, wkc: int) -> bool | None:
        """Return whether a datagram may have this working counter; None for another address."""
        for datagram, counts in zip(self._datagrams, self._allowed, strict=True):
            if datagram.address == address:
                return bool(counts >> wkc & 1)
        return None

    def start(self, now_ns: int, *, looks: bool = False) -> None:
        """Queue this cycle's datagrams, unless MAX_UNDER_WAY cycles are in flight."""
        self._link.start_cycle()
        under_way = self._under_way
        while under_way and (not under_way[0].missing or under_way[0].is_overdue):
            under_way.popleft()
        if len(under_way) >= MAX_UNDER_WAY:
            self._skipped += 1
            return
        if not self._frames:
            return
        outputs = self._image.outputs
        for octets, where, what in self._writes:
            octets[where] = outputs[what]
        self._cycles += 1
        self.is_good = False
        frames = self._looking if looks else self._frames
        exchange = CyclicExchange(frames, self._cycles, now_ns, self._allowed, self._finish)
        self._link.submit_cycle(exchange)
        under_way.append(exchange)

    def stats(self) -> CycleStats:
        """Return a snapshot of the counters."""
        return CycleStats(
            cycles=self._cycles,
            good=self._good,
            wkc_errors=self._wkc_errors,
            late=self._late,
            lost=self._lost,
            skipped=self._skipped,
            expected_wkc=self._expected,
            received_wkc=self._received,
            trip_ns=self._trip_ns,
            max_trip_ns=self._max_trip_ns,
        )

    def _request(self, datagram: _CyclicDatagram) -> DatagramRequest:
        group = self._image.layout.groups[datagram.group]
        # LRW covers both by one address range: outputs first, then the place of the inputs.
        size = group.outputs_size if datagram.command is not Command.LRD else 0
        size += group.inputs_size if datagram.command is not Command.LWR else 0
        return logical(datagram.command, datagram.address, bytes(size))

    def _writes_of(
        self, frames: Sequence[PreparedFrame]
    ) -> Iterator[tuple[bytearray, slice, slice]]:
        """Yield where the outputs of each datagram go, and which of the image they are."""
        for datagram, reply in zip(self._datagrams, self._replies, strict=True):
            if datagram.command is not Command.LRD:
                group = self._image.layout.groups[datagram.group]
                where = slice(reply.start, reply.start + group.outputs_size)
                what = slice(group.outputs, group.outputs + group.outputs_size)
                yield frames[reply.frame].octets, where, what

    def _finish(self, exchange: CyclicExchange, now_ns: int) -> None:
        """Take the replies of a cycle."""
        if exchange.is_lost:
            self._lost += 1
            return
        self._late += exchange.is_overdue
        self._trip_ns = trip_ns = now_ns - exchange.begun_ns
        if trip_ns > self._max_trip_ns:  # noqa: PLR1730  max() takes five times as long
            self._max_trip_ns = trip_ns
        if exchange.number > self._newest:  # an overdue frame may be overtaken
            self._newest = exchange.number
            self._handle_replies(exchange, now_ns)

    def _handle_replies(self, exchange: CyclicExchange, now_ns: int) -> None:
        is_good = True
        received = 0
        frames = exchange.replies
        for datagram, (number, start, end), counts in zip(
            self._datagrams, self._replies, exchange.allowed, strict=True
        ):
            data = frames[number]
            wkc = data[end] | data[end + 1] << 8
            received += wkc
            if counts >> wkc & 1:
                self._copy_inputs(datagram, data, start)
            else:
                is_good = False
        self._received = received
        self.is_good = is_good
        if is_good:
            self._good += 1
        else:
            self._wkc_errors += 1
            self._on_fault(now_ns)
        self._handle_others(exchange, now_ns)

    def _handle_others(self, exchange: CyclicExchange, now_ns: int) -> None:
        """Take the time of the reference clock, and what was found in mailboxes."""
        if exchange.frames is not self._frames and exchange.frames is not self._looking:
            return  # other datagrams have gone with that cycle
        if self.note_time is not None:
            for number, start, end in self._extra_replies[:1]:
                data = exchange.replies[number]
                if data[end] | data[end + 1]:
                    self.note_time(int.from_bytes(data[start:end], "little"), now_ns)
        if exchange.frames is self._looking and self._note_full is not None:
            for at, (number, start, end) in enumerate(self._look_replies):
                data = exchange.replies[number]
                if data[start] & SmStatus.MAILBOX_FULL and data[end] | data[end + 1]:
                    self._note_full(at, now_ns)

    def _copy_inputs(self, datagram: _CyclicDatagram, data: bytes, start: int) -> None:
        if datagram.command is Command.LWR:
            return
        group = self._image.layout.groups[datagram.group]
        begin = start + (group.outputs_size if datagram.command is Command.LRW else 0)
        inputs = self._image.inputs
        # The common case is one slice; only a bus with a lost slave copies slave by slave, so that
        # the lost slave keeps its last inputs.
        if self._all_active[datagram.group]:
            size = group.inputs_size
            inputs[group.inputs : group.inputs + size] = data[begin : begin + size]
            return
        for slave in self._members[datagram.group]:
            if self._participation[slave.station] is Participation.ACTIVE:
                first = begin + slave.inputs - group.inputs
                end = first + slave.inputs_size
                inputs[slave.inputs : slave.inputs + slave.inputs_size] = data[first:end]

    def _update_expected(self, number: int) -> None:
        """Compute the allowed working counters of a group's datagrams, as a bit set."""
        members = self._members[number]
        participations = [self._participation[slave.station] for slave in members]
        self._all_active[number] = all(each is Participation.ACTIVE for each in participations)
        allowed, expected = list(self._allowed), list(self._expected_each)
        for at, datagram in enumerate(self._datagrams):
            if datagram.group != number:
                continue
            # Bit n: working counter n is allowed.  An active slave shifts all, an uncertain one
            # adds the shifted alternatives.
            counts = 1
            expected[at] = 0
            for slave, participation in zip(members, participations, strict=True):
                count = _count(datagram.command, slave)
                if participation is Participation.ACTIVE:
                    counts <<= count
                elif participation is not Participation.ABSENT:
                    counts |= counts << count
                if participation in _COUNTING:
                    expected[at] += count
            allowed[at] = counts
        self._allowed = tuple(allowed)
        self._expected_each = tuple(expected)
        self._expected = sum(expected)


def _datagrams_of(number: int, group: DatagramGroup, *, knows_lrw: bool) -> list[_CyclicDatagram]:
    # Half the datagrams, but a controller may lack LRW (features register, bit 9).
    if knows_lrw and group.outputs_size and group.inputs_size:
        return [_CyclicDatagram(Command.LRW, group.address, number)]
    datagrams = []
    if group.outputs_size:
        datagrams.append(_CyclicDatagram(Command.LWR, group.address, number))
    if group.inputs_size:
        datagrams.append(_CyclicDatagram(Command.LRD, group.address + group.outputs_size, number))
    return datagrams


def _count(command: Command, slave: SlaveLayout) -> int:
    """Return a slave's increment of the working counter (ETG.1000.4)."""
    reads = int(slave.inputs_size > 0)
    writes = int(slave.outputs_size > 0)
    match command:
        case Command.LRD:
            return reads
        case Command.LWR:
            return writes
        case _:  # LRW: a successful write counts 2
            return reads + 2 * writes
