"""Link of a master: datagrams are packed into frames, sent, matched and repeated.

Every datagram of a frame carries the frame's index.  A frame that comes back is accepted only if
its index is in flight and each datagram is the one that was sent, so that foreign and damaged
frames answer nothing.

A frame is overdue after a time-out that follows the measured round trip (:class:`RoundTrip`); its
acyclic datagrams are sent again.  The overdue frame keeps its index for LINGER_NS.  If it comes
back in this time it is late, and answers the datagrams that have no answer yet; otherwise it is
lost.  A busy machine therefore makes frames late, and nothing fails.

Cyclic datagrams go first; a few short acyclic ones share their frame, which saves a frame.  While
cycles run, acyclic datagrams share a budget that each cycle refills: a cycle sends at most the
budget and one frame more, whatever is queued.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, TypeAlias

import msgspec

from devicebus.errors import FrameLostError
from devicebus.master.cyclicframe import (
    FIXED_ADP,
    MAX_BODY,
    MAX_DATAGRAMS,
    CyclicExchange,
    PreparedFrame,
    encode_datagrams,
    encode_header,
)
from devicebus.master.quietcycle import QuietWord
from devicebus.wire.datagram import (
    OVERHEAD,
    Command,
    DatagramHeader,
    DatagramReply,
    DatagramRequest,
)
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.wire import Buffer

# 200 slaves take less than 1 ms, the rest is reserve for this machine.
FLOOR_NS = 2_000_000
"""Minimum time-out."""
CEILING_NS = 1_000_000_000
"""Default for the maximum time-out."""
# Late frames show a slow bus, and a silent bus must be detected soon.
BACKOFF_LIMIT_NS = 100_000_000
"""Time-out before the first measurement, and limit of the back-off."""


class RoundTrip:
    """Round trip estimate and the time-out that follows from it (RFC 6298).

    RFC 6298 ignores the round trip of a repeated segment (Karn's rule), because the answer does not
    tell which transmission it belongs to.  Here each transmission has a frame index of its own, so
    every round trip is measured, also that of a late frame, which shows a slow bus.

    Args:
        ceiling_ns: Maximum time-out.

    Attributes:
        timeout_ns: Time-out of a frame that is sent for the first time.
        smoothed_ns: Smoothed round trip, 0 before the first.
    """

    __slots__ = (
        "_backoff_limit_ns",
        "_ceiling_ns",
        "_floor_ns",
        "_variation_ns",
        "smoothed_ns",
        "timeout_ns",
    )

    def __init__(self, ceiling_ns: int = CEILING_NS) -> None:
        self._floor_ns = min(FLOOR_NS, ceiling_ns)
        self._ceiling_ns = ceiling_ns
        self._backoff_limit_ns = min(BACKOFF_LIMIT_NS, ceiling_ns)
        self._variation_ns = 0
        self.smoothed_ns = 0
        self.timeout_ns = self._backoff_limit_ns

    def save(self, words: array[int]) -> None:
        """Store the estimate for quiet cycles."""
        words[QuietWord.TIMEOUT_NS] = self.timeout_ns
        words[QuietWord.SMOOTHED_NS] = self.smoothed_ns
        words[QuietWord.VARIATION_NS] = self._variation_ns
        words[QuietWord.FLOOR_NS] = self._floor_ns
        words[QuietWord.CEILING_NS] = self._ceiling_ns

    def load(self, words: array[int]) -> None:
        """Take the estimate that quiet cycles have made."""
        self.timeout_ns = words[QuietWord.TIMEOUT_NS]
        self.smoothed_ns = words[QuietWord.SMOOTHED_NS]
        self._variation_ns = words[QuietWord.VARIATION_NS]

    def timeout_of(self, number: int, last: int) -> int:
        """Return the time-out of attempt *number* of *last*.

        It doubles with each attempt up to BACKOFF_LIMIT_NS, which is the minimum of the last one.
        """
        if number == last > 1:
            return max(self.timeout_ns, self._backoff_limit_ns)
        return max(self.timeout_ns, min(self.timeout_ns << number - 1, self._backoff_limit_ns))

    def measure(self, round_trip_ns: int) -> None:
        """Add a round trip to the estimate."""
        smoothed_ns, variation_ns = self.smoothed_ns, self._variation_ns
        if not smoothed_ns:
            smoothed_ns, variation_ns = round_trip_ns, round_trip_ns >> 1
        else:
            difference_ns = round_trip_ns - smoothed_ns
            variation_ns += (abs(difference_ns) - variation_ns) >> 2
            smoothed_ns += difference_ns >> 3
        smoothed_ns = max(smoothed_ns, 1)
        timeout_ns = smoothed_ns + 4 * variation_ns
        # Called for each frame: comparisons cost half of what max() and min() do.
        if timeout_ns < self._floor_ns:
            timeout_ns = self._floor_ns
        elif timeout_ns > self._ceiling_ns:
            timeout_ns = self._ceiling_ns
        self.smoothed_ns, self._variation_ns = smoothed_ns, variation_ns
        self.timeout_ns = timeout_ns


RETRIES = 4
"""Default for the repetitions of a datagram."""
LINGER_NS = 1_000_000_000
"""Time after the time-out in which a frame is late; after it the frame is lost."""
INDEXES = 256
MAX_DATA = MAX_BODY - OVERHEAD
"""Bytes of one datagram."""
# A short datagram takes as much time as so many bytes.
MIN_COST = 64
"""Minimum cost of a datagram in the budget."""
MAX_PIGGYBACK = 256
"""Default for the bytes of acyclic datagrams in a cyclic frame: 20 µs at 100 Mbit/s."""
# More frames would only wait in buffers.
MAX_ACYCLIC_FRAMES = 8
"""Limit for acyclic frames in flight."""

Done: TypeAlias = Callable[[list[DatagramReply] | FrameLostError, int], None]

_LAYOUT = DatagramHeader.LAYOUT
_LENGTH = 0x07FF
_BROADCAST = frozenset((Command.BRD, Command.BWR, Command.BRW))


class LinkStats(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of frames since the start, and the present time-out."""

    sent: int
    received: int
    """Frames that came back, in time or late."""
    late: int
    """Frames that came back after their time-out."""
    lost: int
    """Frames that have not come back for LINGER_NS."""
    retried: int
    """Frames with a repeated datagram."""
    unexpected: int
    """Frames that were not sent by this master, came twice, or came after LINGER_NS."""
    malformed: int
    """Frames that came back with other datagrams."""
    timeout_ns: int
    """Time-out of the next frame."""
    round_trip_ns: int
    """Smoothed round trip, 0 before the first."""
    max_acyclic_octets: int = 0
    """Largest number of bytes of acyclic datagrams in a cycle, headers included."""


class Exchange:
    """Datagrams whose replies are reported together.

    Attributes:
        missing: Number of datagrams without a reply.
    """

    __slots__ = ("cancelled", "done", "missing", "replies")

    def __init__(self, count: int, done: Done) -> None:
        self.done = done
        self.missing = count
        self.replies: list[DatagramReply] = [DatagramReply(b"", 0)] * count
        self.cancelled = False

    def cancel(self) -> None:
        """Cancel: no datagram is sent any more, and *done* is not called."""
        self.cancelled = True

    def fail(self, error: FrameLostError, now_ns: int) -> None:
        """Report the error to *done*, unless the exchange was cancelled."""
        if not self.cancelled:
            self.cancelled = True
            self.done(error, now_ns)


class _QueuedDatagram:
    """Datagram that is queued or in flight."""

    __slots__ = ("datagram", "exchange", "is_answered", "limit", "number", "tries")

    def __init__(
        self, datagram: DatagramRequest, exchange: Exchange, number: int, limit: int
    ) -> None:
        self.datagram = datagram
        self.exchange = exchange
        self.number = number
        self.limit = limit
        self.tries = 0
        self.is_answered = False

    @property
    def is_over(self) -> bool:
        return self.is_answered or self.exchange.cancelled


class _CyclicPart(NamedTuple):
    """Frame *number* of a cycle."""

    exchange: CyclicExchange
    number: int
    frame: PreparedFrame


class _SentFrame:
    """Frame that is in flight or overdue: *items*, behind its cyclic part if it has one."""

    __slots__ = ("cyclic", "deadline_ns", "items", "sent_ns")

    def __init__(
        self,
        cyclic: _CyclicPart | None,
        items: Sequence[_QueuedDatagram],
        sent_ns: int,
        deadline_ns: int,
    ) -> None:
        self.cyclic = cyclic
        self.items = items
        self.sent_ns = sent_ns
        self.deadline_ns = deadline_ns


class QuietCycles(Protocol):
    """Cycle that sends and receives its frames without the link while nothing else is under way."""

    words: array[int]

    def receive_quiet(self, data: Buffer, now_ns: int) -> bool:
        """Take the frame of a quiet cycle; return false, with nothing changed, for any other."""

    def take_over(self, sent_ns: int) -> CyclicExchange:
        """Return the exchange of the frame that is under way."""


class Link:
    """Link to the segment.

    Args:
        ceiling_ns: Maximum time-out of a frame.
        retries: Repetitions of a datagram that sets no number of its own.
        acyclic_octets: Budget of acyclic datagrams in a cycle in bytes, headers included.
        piggyback: Bytes of acyclic datagrams in a cyclic frame.
        indexes: Number of frame indexes, from 0 on; a ring needs the rest for its second line.
    """

    def __init__(
        self,
        *,
        ceiling_ns: int = CEILING_NS,
        retries: int = RETRIES,
        acyclic_octets: int = 1536,
        indexes: int = INDEXES,
        piggyback: int = MAX_PIGGYBACK,
    ) -> None:
        self._indexes = indexes
        self._piggyback = piggyback
        self._round_trip = RoundTrip(ceiling_ns)
        self._tries = 1 + retries
        self._budget = acyclic_octets
        self._credit: int | None = None  # None while no cycles run
        self._cyclic: deque[_CyclicPart] = deque()
        self._acyclic: deque[_QueuedDatagram] = deque()
        self._in_flight: dict[int, _SentFrame] = {}
        self._overdue: dict[int, _SentFrame] = {}  # the oldest first
        self._quiet: QuietCycles | None = None
        self._acyclic_in_flight = 0
        self._index = 0
        self._spent = self._max_spent = 0
        self._sent = self._received = self._late = self._lost = self._retried = 0
        self._unexpected = self._malformed = 0

    def submit(self, datagrams: Sequence[DatagramRequest], done: Done) -> Exchange:
        """Queue acyclic datagrams; *done* is called once, with all replies or with an error.

        They are sent in order, as many as fit in one frame, and again when their frame is overdue.

        Raises:
            ValueError: there is no datagram, or one does not fit a frame.
        """
        if not datagrams or max(len(datagram.data) for datagram in datagrams) > MAX_DATA:
            raise ValueError(f"no datagram, or one with more than {MAX_DATA} bytes")
        self.end_quiet()
        exchange = Exchange(len(datagrams), done)
        tries = self._tries
        self._acyclic.extend(
            _QueuedDatagram(datagram, exchange, number, datagram.tries or tries)
            for number, datagram in enumerate(datagrams)
        )
        return exchange

    def submit_cycle(self, exchange: CyclicExchange) -> None:
        """Queue the frames of a cycle, which are sent once.

        The exchange takes the reply of a late frame too, and learns of a lost one.
        """
        self._cyclic.extend(
            _CyclicPart(exchange, number, frame) for number, frame in enumerate(exchange.frames)
        )

    def room_behind(self, size: int, count: int) -> tuple[int, int]:
        """Return the bytes and datagrams that fit behind *count* datagrams of a cyclic frame."""
        return min(MAX_BODY + EtherCatHeader.SIZE - size, self._piggyback), MAX_DATAGRAMS - count

    def start_cycle(self) -> None:
        """Begin a cycle: refill the budget, less the overdraft of the cycle before."""
        self.end_quiet()
        self._max_spent = max(self._max_spent, self._spent)
        self._spent = 0
        credit = self._credit or 0
        # Unused budget expires: acyclic datagrams must not pile up into one cycle.
        self._credit = min(credit, 0) + self._budget

    def stop_cycles(self) -> None:
        """End the cyclic operation: acyclic datagrams are sent without a budget."""
        self.end_quiet()
        self._credit = None
        self._spent = 0

    def frames_to_send(self, now_ns: int) -> list[bytes]:
        """Return the frames to send now."""
        frames: list[bytes] = []
        # A quiet time goes on: nothing is queued in it.
        while self._cyclic and len(self._in_flight) < self._indexes:
            frames.append(self._send_cyclic(self._cyclic.popleft(), now_ns))
        while self._may_send_acyclic():
            items = self._take(MAX_BODY, MAX_DATAGRAMS)
            if items:
                index = self._note_sent(None, items, now_ns)
                body = encode_datagrams([each.datagram for each in items], index)
                frames.append(encode_header(len(body)) + body)
        return frames

    def receive_frame(self, data: Buffer, now_ns: int) -> None:
        """Handle a frame that came back; one that answers nothing is counted."""
        if self._quiet is None or not self._quiet.receive_quiet(data, now_ns):
            self.end_quiet()
            self._receive_frame(data, now_ns)

    def _receive_frame(self, data: Buffer, now_ns: int) -> None:
        # Index of the first datagram; all datagrams of a frame carry the same one.
        index = data[3] if len(data) > EtherCatHeader.SIZE + DatagramHeader.SIZE else -1
        sent = self._in_flight.get(index)
        is_late = sent is None
        if sent is None:
            sent = self._overdue.get(index)
            if sent is None:
                self._unexpected += 1
                return
        results = _match(data, index, sent)
        if results is None:
            self._malformed += 1
            return
        self._received += 1
        if is_late:
            del self._overdue[index]
            self._late += 1
        else:
            self._end_flight(index)
        # Karn's rule is not needed: each transmission has its own index (see RoundTrip).
        self._round_trip.measure(now_ns - sent.sent_ns)
        if sent.cyclic is not None:
            sent.cyclic.exchange.take(sent.cyclic.number, bytes(data), now_ns)
        for item, (reply, wkc) in zip(sent.items, results, strict=True):
            if item.is_over:
                continue
            item.is_answered = True
            exchange = item.exchange
            exchange.replies[item.number] = DatagramReply(reply, wkc, item.tries)
            exchange.missing -= 1
            if not exchange.missing:
                exchange.done(exchange.replies, now_ns)

    @property
    def is_waiting(self) -> bool:
        """True while a frame may come back."""
        if self._quiet is not None:
            return self._quiet.words[QuietWord.INDEX] >= 0
        return bool(self._in_flight or self._overdue)

    def next_timeout(self) -> int | None:
        """Return the time at which the next frame in flight is overdue."""
        self.end_quiet()
        return min([sent.deadline_ns for sent in self._in_flight.values()], default=None)

    def handle_timeout(self, now_ns: int) -> None:
        """Repeat or fail the datagrams of overdue frames."""
        self.end_quiet()
        while self._overdue:
            index, oldest = next(iter(self._overdue.items()))
            if now_ns - oldest.deadline_ns < LINGER_NS:
                break
            self._count_lost(index, now_ns)
        due = [index for index, each in self._in_flight.items() if each.deadline_ns <= now_ns]
        again: list[_QueuedDatagram] = []
        for index in due:
            sent = self._overdue[index] = self._end_flight(index)
            if sent.cyclic is not None:
                sent.cyclic.exchange.is_overdue = True
            for item in sent.items:
                if item.is_over:
                    continue
                if item.tries < item.limit:
                    again.append(item)
                else:
                    item.exchange.fail(_lost(item), now_ns)
        # In front of the queue and in their order: a repetition must not overtake a later write.
        self._acyclic.extendleft(reversed(again))

    def stats(self) -> LinkStats:
        """Return a snapshot of the counters."""
        self.end_quiet()
        return LinkStats(
            sent=self._sent,
            received=self._received,
            late=self._late,
            lost=self._lost,
            retried=self._retried,
            unexpected=self._unexpected,
            malformed=self._malformed,
            timeout_ns=self._round_trip.timeout_ns,
            round_trip_ns=self._round_trip.smoothed_ns,
            max_acyclic_octets=max(self._max_spent, self._spent),
        )

    def begin_quiet(self, cycle: QuietCycles) -> bool:
        """Begin a cycle that *cycle* exchanges without the link, and those behind it.

        Returns false if a datagram or a frame waits or is under way, or no budget is left.
        """
        is_idle = not (self._cyclic or self._acyclic or self._in_flight or self._overdue)
        if not is_idle or self._credit is None or self._credit <= 0:
            return False
        self.start_cycle()
        words = cycle.words
        words[QuietWord.NEXT_INDEX], words[QuietWord.INDEXES] = self._index, self._indexes
        words[QuietWord.SENT] = words[QuietWord.BACK] = 0
        self._round_trip.save(words)
        self._quiet = cycle
        return True

    def end_quiet(self) -> None:
        """Take the frame and the counters of quiet cycles over, if there are any."""
        cycle, self._quiet = self._quiet, None
        if cycle is None:
            return
        words = cycle.words
        words[QuietWord.UNTIL_NS] = 0
        self._index = words[QuietWord.NEXT_INDEX]
        self._sent += words[QuietWord.SENT]
        self._received += words[QuietWord.BACK]
        self._round_trip.load(words)
        index, words[QuietWord.INDEX] = words[QuietWord.INDEX], -1
        if index >= 0:
            sent_ns = words[QuietWord.SENT_NS]
            exchange = cycle.take_over(sent_ns)
            part = _CyclicPart(exchange, 0, exchange.frames[0])
            deadline_ns = sent_ns + self._round_trip.timeout_ns
            self._in_flight[index] = _SentFrame(part, (), sent_ns, deadline_ns)

    def _may_send_acyclic(self) -> bool:
        return (
            bool(self._acyclic)
            and self._acyclic_in_flight < MAX_ACYCLIC_FRAMES
            and (self._credit is None or self._credit > 0)
            and len(self._in_flight) < self._indexes
        )

    def _send_cyclic(self, cyclic: _CyclicPart, now_ns: int) -> bytes:
        """Return a frame of a cycle; its last one takes short acyclic datagrams along."""
        frame = cyclic.frame
        items: Sequence[_QueuedDatagram] = ()
        has_credit = self._credit is not None and self._credit > 0
        if self._acyclic and has_credit and not self._cyclic:
            items = self._take(*self.room_behind(frame.size, len(frame.places)))
        index = self._note_sent(cyclic, items, now_ns)
        if not items:
            return frame.encode(index)
        return frame.encode(index, encode_datagrams([each.datagram for each in items], index))

    def _note_sent(
        self, cyclic: _CyclicPart | None, items: Sequence[_QueuedDatagram], now_ns: int
    ) -> int:
        """Note a frame that is sent now; return its index."""
        index = self._free_index(now_ns)
        timeout_ns = self._round_trip.timeout_ns
        if items:
            tries, limit = max((item.tries, item.limit) for item in items)
            if tries > 1:
                self._retried += 1
                timeout_ns = self._round_trip.timeout_of(tries, limit)
        self._in_flight[index] = _SentFrame(cyclic, items, now_ns, now_ns + timeout_ns)
        self._acyclic_in_flight += cyclic is None
        self._sent += 1
        return index

    def _free_index(self, now_ns: int) -> int:
        """Return a free index; if all are in use, that of the oldest overdue frame."""
        in_flight, overdue = self._in_flight, self._overdue
        if len(in_flight) + len(overdue) >= self._indexes:
            self._count_lost(next(iter(overdue)), now_ns)
        index = self._index
        while index in in_flight or index in overdue:
            index = (index + 1) % self._indexes
        self._index = (index + 1) % self._indexes
        return index

    def _count_lost(self, index: int, now_ns: int) -> None:
        """Count an overdue frame as lost."""
        sent = self._overdue.pop(index)
        self._lost += 1
        if sent.cyclic is not None:
            sent.cyclic.exchange.lose(now_ns)

    def _take(self, max_size: int, count: int) -> list[_QueuedDatagram]:
        """Return queued datagrams, at most *count* with *max_size* bytes, within the budget."""
        items: list[_QueuedDatagram] = []
        queue = self._acyclic
        size = 0
        while queue and len(items) < count:
            octets = OVERHEAD + len(queue[0].datagram.data)
            if size + octets > max_size:
                break
            item = queue.popleft()
            if item.is_over:
                continue
            item.tries += 1
            items.append(item)
            size += octets
            if self._credit is not None:
                self._spent += octets
                self._credit -= max(octets, MIN_COST)
                if self._credit <= 0:
                    break
        return items

    def _end_flight(self, index: int) -> _SentFrame:
        sent = self._in_flight.pop(index)
        self._acyclic_in_flight -= sent.cyclic is None
        return sent


def _match(data: Buffer, index: int, sent: _SentFrame) -> Sequence[tuple[bytes, int]] | None:
    """Return data and working counter of each item; None if *data* is another frame."""
    offset = EtherCatHeader.SIZE
    if sent.cyclic is not None:
        if not sent.cyclic.frame.matches(data, index):
            return None
        offset = sent.cyclic.frame.size
    items = sent.items
    if not items:
        return ()
    results = []
    need = offset + sum(OVERHEAD + len(item.datagram.data) for item in items)
    if len(data) < need or data[1] >> 4 != FrameType.DATAGRAM:
        return None
    for item in items:
        datagram = item.datagram
        command, size = datagram.command, len(datagram.data)
        there = _LAYOUT.unpack_from(data, offset)
        same = (command, index, datagram.ado, size) == (*there[:2], there[3], there[4] & _LENGTH)
        # ADP of position and broadcast commands is incremented by every slave on the way.
        if not same or (command in FIXED_ADP and datagram.adp != there[2]):
            return None
        start = offset + DatagramHeader.SIZE
        offset = start + size
        wkc = data[offset] | data[offset + 1] << 8
        results.append((bytes(data[start:offset]), wkc))
        offset += 2
    return results


def _lost(item: _QueuedDatagram) -> FrameLostError:
    datagram = item.datagram
    # Only a lost broadcast gives a hint about the cable: it does not depend on one slave.
    is_broadcast = datagram.command in _BROADCAST
    advice = "; check the cable to the first slave and its power" if is_broadcast else ""
    return FrameLostError(
        f"{datagram.command.name} 0x{datagram.adp:04X}:0x{datagram.ado:04X}: no frame came back,"
        f" sent {item.tries} times{advice}"
    )
