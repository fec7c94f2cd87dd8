"""Cable redundancy: both ends of a ring of slaves are connected to the master.

Each frame is sent on both lines, and the two copies that come back are merged into one frame for
:class:`~devicebus.master.link.Link`.  The rules follow from the way of a frame through a controller
(ETG.1000.4): it is processed behind port 0 only, and a port without a link loops it back.

- Whole ring: the copy of the first line passes all slaves and arrives on the second line, with all
  that they did.  The copy of the second line enters the last slave at port 1 and leaves each slave
  by port 0, so that none processes it: it arrives on the first line as it was sent, and is dropped.
- Cut ring: each copy is looped back at the cut and returns on its own line.  The slaves before the
  cut process the first copy.  The second copy is looped back at port 0 of the first slave behind
  the cut; therefore the slaves behind the cut process it, in the same order as in a whole ring.  No
  slave processes both, so the working counters add.  Bytes that are read leave the master as zeros:
  of a datagram that both halves answered, the data is ORed, otherwise it is that of the half that
  answered.

A position counts from the end at which a frame enters, so a copy with a position command for the
second line is counted on as if the slaves before the cut had been passed; while their number is not
known, it is replaced by a NOP.  So is the datagram that distributes the time of the reference clock
(FRMW): without the reference on its half it would write zeros into all clocks there.  Instead
another slave can distribute its time behind the cut.

If one copy of a frame does not come, its line may be slow or dead.  A cyclic frame passes with one
half if its working counters are those of all slaves, which the other line has then not reached.
Other frames wait until the line is known to be dead.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from enum import IntEnum

import msgspec

from devicebus.master.link import INDEXES, RoundTrip
from devicebus.wire.datagram import OVERHEAD, Command, DatagramHeader
from eap.codec.ethercat import EtherCatHeader
from eap.codec.wire import Buffer

RING_INDEXES = INDEXES // 2
"""Frame indexes of a link with a ring: those of the second line have _SECOND_BIT set."""
# Slaves whose answers are on a line that is only slow must not be taken for lost ones.
DEAD_NS = 50_000_000
"""Minimum time without a copy after which a line is dead."""
DEAD_TIMEOUTS = 4
"""The same in time-outs that follow the round trip of copies: a slow bus is not dead."""
# Time alone is no sign: nothing comes back while nothing is sent.
DEAD_COPIES = 3
"""Copies that have to be missing on it meanwhile."""
# Of the fields that no controller changes, the index is the one that a master may choose: it tells
# the copies apart, on whichever line they return.
_SECOND_BIT = RING_INDEXES
_HEADER = struct.Struct("<BBHHHH")
_SIZE = DatagramHeader.SIZE
_LENGTH = 0x07FF
_MORE = 0x8000
_BY_POSITION = frozenset((Command.APRD, Command.APWR, Command.APRW, Command.ARMW))
_BROADCAST = frozenset((Command.BRD, Command.BWR, Command.BRW))
_LOGICAL = frozenset((Command.LRD, Command.LWR, Command.LRW))
# Only these are answered on both sides of a cut: a station, or a position, is on one side.
_JOINED = _LOGICAL | _BROADCAST
_COUNTED = _BY_POSITION | _BROADCAST
_NOP, _FRMW = int(Command.NOP), int(Command.FRMW)


class RingEnd(IntEnum):
    """Line from the master to an end of the ring."""

    FIRST = 0
    SECOND = 1


class RingReport(msgspec.Struct, frozen=True, kw_only=True):
    """State of a ring; times are those of the master."""

    is_whole: bool | None
    """None before the first frame."""
    reached: int | None
    """Number of slaves before the last cut; None if it is not known."""
    silent: tuple[int, ...]
    """Lines (1, 2) whose frames do not come back at all."""
    cuts: int
    cut_ns: int | None
    """Time of the last cut, None before the first."""
    mended_ns: int | None
    """Time at which it was mended, None while it lasts."""


class _SentCopies:
    """Frame with its copy for the second line."""

    __slots__ = ("copies", "halves", "is_done", "number", "second_is_unprocessed", "sent_ns")

    def __init__(self, first: bytes, second: bytes, number: int, sent_ns: int) -> None:
        self.copies = (first, second)
        self.halves: list[bytes | None] = [None, None]
        self.number = number
        self.sent_ns = sent_ns
        self.second_is_unprocessed = False
        self.is_done = False

    @property
    def missing_line(self) -> RingEnd:
        """Line whose copy has not come; the other has."""
        return RingEnd.FIRST if self.halves[RingEnd.FIRST] is None else RingEnd.SECOND


class Ring:
    """Copies of the frames of a link, and the merging of what comes back.

    Args:
        on_change: Called with the time when the ring was cut or mended, or when the number of
            slaves before the cut is known.
        is_expected: Returns true if a working counter is that of all slaves, for a logical datagram
            with an address, or None for another address.

    Attributes:
        is_whole: True while frames pass the whole ring; None before the first one.
        reached: Number of slaves before the cut, None while it is not known.
        second_reference: Station address of the slave that distributes its time behind a cut.
        is_opened: True while the master itself has opened the ring, which is no cut.
        unexpected: Frames that came back and were no copies.
    """

    def __init__(
        self, on_change: Callable[[int], None], is_expected: Callable[[int, int], bool | None]
    ) -> None:
        self._on_change = on_change
        self._is_expected = is_expected
        self.is_whole: bool | None = None
        self.reached: int | None = None
        self.second_reference: int | None = None
        self.is_opened = False
        self.unexpected = 0
        self._sent: dict[int, _SentCopies] = {}
        self._waiting: dict[int, _SentCopies] = {}
        self._silent = [False, False]
        self._heard_ns = [0, 0]
        self._missing = [0, 0]
        self._number = self._judged = 0
        self._trip = RoundTrip()
        self._cuts = 0
        self._place: int | None = None
        self._cut_ns: int | None = None
        self._mended_ns: int | None = None

    def copy_frames(self, frames: Sequence[bytes], now_ns: int) -> list[bytes]:
        """Return the copies for the second line of frames that leave on the first one."""
        copies = []
        for frame in frames:
            copy = self._copy(frame)
            copies.append(copy)
            index = frame[3]
            self._waiting.pop(index, None)
            self._number += 1
            self._sent[index] = _SentCopies(frame, copy, self._number, now_ns)
        if not self._heard_ns[0]:
            # Silence counts from the first frame on.
            self._heard_ns = [now_ns, now_ns]
        return copies

    def receive_frame(self, line: RingEnd, data: Buffer, now_ns: int) -> Buffer | None:
        """Handle a frame that arrives on *line*; return a whole frame for the link, or None."""
        index = data[3] if len(data) > EtherCatHeader.SIZE + _SIZE else -1
        copy = RingEnd(index >= _SECOND_BIT)
        sent = self._sent.get(index & ~_SECOND_BIT) if index >= 0 else None
        if sent is None or not _is_copy(data, sent.copies[copy]):
            self.unexpected += 1
            return None
        self._heard_ns[copy] = now_ns
        self._trip.measure(now_ns - sent.sent_ns)
        self._missing[copy] = 0
        if self._silent[copy]:
            self._silent[copy] = False
            self.reached = None  # known again by the next broadcast
        if copy is not line:
            self._note(sent, now_ns, is_whole=True)
            if copy is RingEnd.FIRST:
                return self._finish(sent, data)
            # Not processed.  If the ring was cut behind it, the half of the first copy is all.
            sent.second_is_unprocessed = True
            return self._finish_half(sent) if sent.halves[RingEnd.FIRST] else None
        self._note(sent, now_ns, is_whole=False)
        self._count_slaves(copy, sent.copies[copy], data, now_ns)
        if sent.is_done:
            return None
        sent.halves[copy] = bytes(data)
        other = RingEnd(1 - copy)
        if sent.halves[other] is None:
            self._missing[other] += 1
            is_alone = self._silent[other] or sent.second_is_unprocessed
            is_alone = is_alone or (self.is_opened and copy is RingEnd.FIRST)
            if not is_alone and not self._is_of_all_slaves(sent.copies[copy], data):
                self._waiting[sent.copies[0][3]] = sent
                return None
        return self._finish_half(sent)

    def next_timeout(self) -> int | None:
        """Return the time at which :meth:`handle_timeout` must be called."""
        times = [self._end_of_wait(sent) for sent in self._waiting.values()]
        return min(times, default=None)

    def handle_timeout(self, now_ns: int) -> list[bytes]:
        """Return the frames whose other copy will not come because its line is dead."""
        frames = []
        for index, sent in list(self._waiting.items()):
            if self._end_of_wait(sent) > now_ns:
                continue
            line = sent.missing_line
            if (
                self._missing[line] >= DEAD_COPIES
                and now_ns - self._heard_ns[line] >= self._dead_ns
            ):
                self._silent[line] = True
                if line is RingEnd.FIRST:
                    # The frames of the second line turn back at port 0 of the first slave, so they
                    # pass all slaves in the order of the first line: none is before the cut.
                    self._set_reached(0, now_ns)
                self._end(sent)
                frames.append(_merge(sent.copies[0], *sent.halves))
            else:  # the link sends it again, or the next cycle replaces it
                del self._waiting[index]
        return frames

    def _end_of_wait(self, sent: _SentCopies) -> int:
        line = sent.missing_line
        begun_ns = self._heard_ns[line] if self._missing[line] >= DEAD_COPIES else sent.sent_ns
        return begun_ns + self._dead_ns

    @property
    def _dead_ns(self) -> int:
        return max(DEAD_NS, DEAD_TIMEOUTS * self._trip.timeout_ns)

    def _is_of_all_slaves(self, sent: bytes, data: Buffer) -> bool:
        """Return true for a cyclic frame if the slaves of this half are all that exchange data."""
        is_cyclic = False
        offset = EtherCatHeader.SIZE
        more = _MORE
        while more:
            command, _, adp, ado, word, _ = _HEADER.unpack_from(sent, offset)
            end = offset + _SIZE + (word & _LENGTH)
            if command in _LOGICAL:
                is_cyclic = True
                wkc = int.from_bytes(data[end : end + 2], "little")
                if not self._is_expected(ado << 16 | adp, wkc):
                    return False
            offset = end + 2
            more = word & _MORE
        return is_cyclic

    def end_opening(self, now_ns: int) -> None:
        """Note that the master has joined the ring again; if it is not whole now, it was cut."""
        self.is_opened = False
        if not self.is_whole:
            self._count_cut(now_ns)
            self._on_change(now_ns)

    def forget_past(self) -> None:
        """Forget a cut that was mended; the number of cuts stays."""
        if self.is_whole:
            self._place = self._cut_ns = self._mended_ns = None

    def report(self) -> RingReport:
        """Return a snapshot of the state."""
        return RingReport(
            is_whole=self.is_whole,
            reached=self._place,
            silent=tuple(number for number, each in enumerate(self._silent, 1) if each),
            cuts=self._cuts,
            cut_ns=self._cut_ns,
            mended_ns=self._mended_ns,
        )

    def _copy(self, frame: bytes) -> bytes:
        copy = bytearray(frame)
        offset = EtherCatHeader.SIZE
        more = _MORE
        while more:
            command, index, adp, ado, word, irq = _HEADER.unpack_from(copy, offset)
            if command in _BY_POSITION:
                if self.is_whole or self.reached is None:
                    command = _NOP
                else:
                    adp = adp + self.reached & 0xFFFF
            elif command == _FRMW:
                if self.is_whole or self.second_reference is None:
                    command = _NOP
                else:
                    adp = self.second_reference
            _HEADER.pack_into(copy, offset, command, index | _SECOND_BIT, adp, ado, word, irq)
            offset += OVERHEAD + (word & _LENGTH)
            more = word & _MORE
        return bytes(copy)

    def _finish_half(self, sent: _SentCopies) -> Buffer | None:
        return self._finish(sent, _merge(sent.copies[0], *sent.halves))

    def _finish(self, sent: _SentCopies, frame: Buffer) -> Buffer | None:
        if sent.is_done:
            return None
        self._end(sent)
        return frame

    def _end(self, sent: _SentCopies) -> None:
        sent.is_done = True
        self._waiting.pop(sent.copies[0][3], None)

    def _note(self, sent: _SentCopies, now_ns: int, *, is_whole: bool) -> None:
        """Note whether the ring was whole for a frame, unless a later one has told more."""
        if sent.number < self._judged:
            return
        self._judged = sent.number
        if is_whole is self.is_whole:
            return
        self.is_whole = is_whole
        self.reached = self.second_reference = None
        if self.is_opened:
            return
        if not is_whole:
            self._count_cut(now_ns)
        elif self._cut_ns is not None:
            self._mended_ns = now_ns
        self._on_change(now_ns)

    def _count_cut(self, now_ns: int) -> None:
        self._cuts += 1
        self._cut_ns = now_ns
        self._place = self._mended_ns = None

    def _count_slaves(self, copy: RingEnd, sent: bytes, data: Buffer, now_ns: int) -> None:
        """Read from a broadcast of the first line how many slaves are before the cut."""
        # Each slave on the way increments ADP, whether it answers or not.
        if copy is RingEnd.FIRST and sent[EtherCatHeader.SIZE] in _COUNTED:
            at = EtherCatHeader.SIZE + 2
            before = int.from_bytes(sent[at : at + 2], "little")
            self._set_reached(int.from_bytes(data[at : at + 2], "little") - before & 0xFFFF, now_ns)

    def _set_reached(self, reached: int, now_ns: int) -> None:
        if reached != self.reached:
            self.reached = reached
            if not self.is_opened:
                self._place = reached
            self._on_change(now_ns)


def _is_copy(data: Buffer, sent: bytes) -> bool:
    """Return true if *data* has the datagrams of *sent*, processed or not."""
    # Ethernet pads short frames, so more may follow.
    if len(data) < len(sent) or data[1] >> 4 != sent[1] >> 4:
        return False
    offset = EtherCatHeader.SIZE
    more = _MORE
    while more:
        # Not ADP, which slaves count up, the event bits (IRQ), which they set, or the bit of a
        # circulating frame in the word of the length.
        command, index, _, ado, word, _ = _HEADER.unpack_from(sent, offset)
        there = _HEADER.unpack_from(data, offset)
        same = (command, index, ado, word & _LENGTH)
        if same != (there[0], there[1], there[3], there[4] & _LENGTH):
            return False
        offset += OVERHEAD + (word & _LENGTH)
        more = word & _MORE
    return True


def _merge(sent: bytes, first: bytes | None, second: bytes | None) -> bytes:
    """Return *sent* with the data and working counters of its copies."""
    frame = bytearray(sent)
    offset = EtherCatHeader.SIZE
    more = _MORE
    while more:
        command, _, _, _, word, _ = _HEADER.unpack_from(sent, offset)
        start = offset + _SIZE
        end = start + (word & _LENGTH)
        counts = [
            int.from_bytes(half[end : end + 2], "little") if half is not None else 0
            for half in (first, second)
        ]
        if all(counts) and command in _JOINED:
            # Written data is the same in both halves, and read data came into zeros.
            joined = int.from_bytes(first[start:end], "little")  # type: ignore[index]
            joined |= int.from_bytes(second[start:end], "little")  # type: ignore[index]
            frame[start:end] = joined.to_bytes(end - start, "little")
        elif counts[0]:
            frame[start:end] = first[start:end]  # type: ignore[index]
        elif counts[1]:
            frame[start:end] = second[start:end]  # type: ignore[index]
        frame[end : end + 2] = (sum(counts) & 0xFFFF).to_bytes(2, "little")
        offset = end + 2
        more = word & _MORE
    return bytes(frame)
