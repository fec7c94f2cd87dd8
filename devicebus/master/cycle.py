"""Cyclic exchange of process data: logical datagrams, expected working counters, statistics.

A slave counts in the expected working counter from the configuration of its FMMUs and sync managers
until it is lost, so that the inputs of the others stay valid without it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from enum import Enum, auto
from typing import Any, NamedTuple

import msgspec

from devicebus.master.cyclicframe import CyclicExchange, PreparedFrame, prepare_frames
from devicebus.master.image import BusImage, DatagramGroup, SlaveLayout
from devicebus.master.link import Link
from devicebus.master.quietcycle import QuietPlan, QuietWord, compile_frame, make_words
from devicebus.wire.datagram import OVERHEAD, Command, DatagramRequest, logical
from devicebus.wire.register import SmStatus
from eap.codec.wire import Buffer

(_CYCLES, _GOOD, _RECEIVED_WKC, _TRIP_NS, _MAX_TRIP_NS, _IS_GOOD) = map(
    int,
    (
        QuietWord.CYCLES,
        QuietWord.GOOD,
        QuietWord.RECEIVED_WKC,
        QuietWord.TRIP_NS,
        QuietWord.MAX_TRIP_NS,
        QuietWord.IS_GOOD,
    ),
)
_U64 = (1 << 64) - 1
_UNTIL_NS, _INDEX = int(QuietWord.UNTIL_NS), int(QuietWord.INDEX)

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
        words: Counters and state that the compiled part shares.
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
        self.words = make_words()
        self._compiled: tuple[Any, Any] | None = None
        self._is_compiled = False
        self._sent_looks = False
        self._under_way: deque[CyclicExchange] = deque()
        self._newest = 0
        self._wkc_errors = self._late = self._lost = self._skipped = 0
        self._extra: Sequence[DatagramRequest] = ()
        self._looks: Sequence[DatagramRequest] = ()
        self._note_full: Callable[[int, int], None] | None = None
        self._prepare()

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
        self._link.end_quiet()
        self._is_compiled = False
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
            self._link.end_quiet()
            self._is_compiled = False
            self._participation[station] = participation
            self._update_expected(self._image.layout.slaves[station].group)

    def participation(self, station: int) -> Participation:
        """Return the participation of a slave."""
        return self._participation.get(station, Participation.ABSENT)

    @property
    def is_good(self) -> bool:
        """True if the last cycle has come back with the expected working counters."""
        return self.words[_IS_GOOD] != 0

    @property
    def is_full(self) -> bool:
        """True if the last cycle came back with the full working counter of all active slaves."""
        words = self.words
        return words[_IS_GOOD] != 0 and words[_RECEIVED_WKC] >= self._expected > 0

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
        words = self.words
        words[_CYCLES] += 1
        words[_IS_GOOD] = 0
        self._link.submit_cycle(self._begin_exchange(now_ns, looks=looks))

    def _begin_exchange(self, now_ns: int, *, looks: bool) -> CyclicExchange:
        frames = self._looking if looks else self._frames
        number = self.words[_CYCLES]
        exchange = CyclicExchange(frames, number, now_ns, self._allowed, self._finish)
        self._under_way.append(exchange)
        return exchange

    def is_quiet(self, now_ns: int) -> bool:
        """Return whether :meth:`quiet_frame` has the frame of this cycle."""
        return self.words[_INDEX] < 0 and now_ns < self.words[_UNTIL_NS]

    def begin_quiet(self, until_ns: int) -> bool:
        """Have the compiled part exchange cycles until *until_ns*; return false if it cannot."""
        if not self._is_compiled:
            self._is_compiled = True
            self._compiled = self._compile()
        if self._compiled is None or not self._link.begin_quiet(self):
            return False
        self.words[_UNTIL_NS] = until_ns
        return True

    def quiet_frame(self, now_ns: int, *, looks: bool) -> bytes | None:
        """Return the frame of a quiet cycle, to be sent now; None if it is not quiet any more."""
        assert self._compiled is not None  # noqa: S101  it is quiet
        self._sent_looks = looks
        frame: bytes | None = self._compiled[looks].send(now_ns)
        return frame

    def receive_quiet(self, data: Buffer, now_ns: int) -> bool:
        """Take the frame of a quiet cycle; return false, with nothing changed, for any other."""
        assert self._compiled is not None  # noqa: S101  it is quiet
        outcome = self._compiled[self._sent_looks].receive(data, now_ns)
        if outcome > 1:
            words = self.words
            if words[QuietWord.HAS_TIME] and self.note_time is not None:
                self.note_time(words[QuietWord.TIME_NS] & _U64, now_ns)
            full = words[QuietWord.FULL]
            for number in range(full.bit_length()):
                if full >> number & 1 and self._note_full is not None:
                    self._note_full(number, now_ns)
        return bool(outcome)

    def take_over(self, sent_ns: int) -> CyclicExchange:
        """Return the exchange of the quiet cycle whose frame is under way, as start() makes it."""
        return self._begin_exchange(sent_ns, looks=self._sent_looks)

    def _compile(self) -> tuple[Any, Any] | None:
        """Return the frames for quiet cycles, without and with looks; None if there are none."""
        is_one = len(self._frames) == len(self._looking) == 1
        is_exact = all(counts & counts - 1 == 0 for counts in self._allowed)
        if not (is_one and is_exact and all(self._all_active)):
            return None
        image = self._image
        writes, reads, counters = [], [], []
        for datagram, (_, start, end), counts in zip(
            self._datagrams, self._replies, self._allowed, strict=True
        ):
            group = image.layout.groups[datagram.group]
            counters.append((end, counts.bit_length() - 1))
            if datagram.command is not Command.LRD:
                writes.append((start, group.outputs, group.outputs_size))
                start += group.outputs_size  # noqa: PLW2901  inputs follow outputs in an LRW
            if datagram.command is not Command.LWR:
                reads.append((start, group.inputs, group.inputs_size))
        time_at = -1
        if self.note_time is not None:
            time_at = next((start for _, start, _ in self._extra_replies), -1)
        looks = [start for _, start, _ in self._look_replies]
        plain = QuietPlan(writes, reads, counters, (), time_at)
        plans = (self._frames[0], plain), (self._looking[0], plain._replace(looks=looks))
        first, second = (
            compile_frame(frame, plan, self.words, image.outputs, image.inputs)
            for frame, plan in plans
        )
        return None if first is None else (first, second)

    def stats(self) -> CycleStats:
        """Return a snapshot of the counters."""
        words = self.words
        return CycleStats(
            cycles=words[_CYCLES],
            good=words[_GOOD],
            wkc_errors=self._wkc_errors,
            late=self._late,
            lost=self._lost,
            skipped=self._skipped,
            expected_wkc=self._expected,
            received_wkc=words[_RECEIVED_WKC],
            trip_ns=words[_TRIP_NS],
            max_trip_ns=words[_MAX_TRIP_NS],
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
        words = self.words
        words[_TRIP_NS] = trip_ns = now_ns - exchange.begun_ns
        if trip_ns > words[_MAX_TRIP_NS]:  # noqa: PLR1730  max() takes five times as long
            words[_MAX_TRIP_NS] = trip_ns
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
        self.words[_RECEIVED_WKC] = received
        self.words[_IS_GOOD] = is_good
        if is_good:
            self.words[_GOOD] += 1
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
