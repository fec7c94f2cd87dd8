"""Ring of recorded frames in shared memory: one writer, which waits for no reader.

The memory begins with a header: words, then the names of the ports whose frames are recorded, a
line each, in the order of their numbers.  Behind it lies the ring.  A record is a head, then the
frame from its EtherCAT header on, padded to a multiple of eight bytes; it lies in one piece, so a
lap may end with a record of kind :data:`_REST`, which says that the next one begins the next lap.

Rule 1: positions count bytes since the ring was made; the place of one is its remainder by the
capacity, so a position tells how far a reader is behind.
Rule 2: the writer moves RESERVED over a record, writes it, and moves WRITTEN behind it.  A reader
copies up to WRITTEN, and then compares RESERVED: what the writer may have touched meanwhile is not
used, and the number of the next record tells how many were missed.
Rule 3: the writer records as long as a reader wants it: WANTED_UNTIL_NS, which readers extend.

This module works on any writable buffer; ``eap.net.framering_file`` maps one from a file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

from eap.errors import ImageError
from eap.pd import ordering

MAGIC = b"EAPRING1"
HEADER_SIZE = 65_536
_WORDS_OFFSET, _NAMES_OFFSET = 64, 4096
MAX_FRAME = 2112
"""Largest frame of a record, as drivers receive them."""
RECORDING_TERM_NS = 1_000_000_000
"""Time that the writer goes on for readers that do not extend it."""

_HEAD = struct.Struct("<HHIqQ")
"""Port and direction, length of the frame, number of the record, time, address of the other end."""
_HEAD_SIZE = _HEAD.size
_pack_head = _HEAD.pack_into
_REST = 0xFFFF
_SENT = 0x8000
_ALIGN = 7


class RingWord(IntEnum):
    """Words of the header."""

    WANTED_UNTIL_NS = 0
    """Monotonic time until which a reader wants frames."""
    CAPACITY = 1
    """Bytes of the ring; 0 as long as no reader has made it."""
    RESERVED = 2
    """Position behind the record that is being written, or was last."""
    WRITTEN = 3
    """Position behind the last whole record."""
    LAP = 4
    """Position at which the present lap began: always the first byte of a record."""
    RECORDS = 5
    """Number of records written."""
    NAMES_SIZE = 6
    """Bytes of the list of ports."""
    SIZE = 7


_WANTED, _CAPACITY = int(RingWord.WANTED_UNTIL_NS), int(RingWord.CAPACITY)
_RESERVED, _WRITTEN = int(RingWord.RESERVED), int(RingWord.WRITTEN)
_LAP, _RECORDS = int(RingWord.LAP), int(RingWord.RECORDS)
_NAMES_SIZE = int(RingWord.NAMES_SIZE)


class RingHeader:
    """The header of a ring; *memory* has at least :data:`HEADER_SIZE` bytes.

    Raises:
        ImageError: it is none, or of another release.
    """

    def __init__(self, memory: memoryview) -> None:
        if bytes(memory[: len(MAGIC)]) != MAGIC:
            raise ImageError("not a ring of frames of this release; use the same one on both sides")
        self.memory = memory
        self.words = memory[_WORDS_OFFSET : _WORDS_OFFSET + 8 * RingWord.SIZE].cast("q")

    @classmethod
    def format(cls, memory: memoryview) -> RingHeader:
        """Make the header of a ring without capacity in zeroed *memory*."""
        memory[: len(MAGIC)] = MAGIC
        return cls(memory)

    def is_wanted(self, now_ns: int) -> bool:
        """Return whether a reader wants frames."""
        return bool(self.words[_WANTED] > now_ns)

    def extend(self, now_ns: int) -> None:
        """Have frames recorded for RECORDING_TERM_NS from now on; call it several times in that."""
        # All readers set the same term, so the last to write takes nothing away from the others.
        self.words[_WANTED] = max(self.words[_WANTED], now_ns + RECORDING_TERM_NS)

    @property
    def ports(self) -> list[str]:
        """The ports by their numbers, as ``STATION/PORT``."""
        size = self.words[_NAMES_SIZE]
        octets = bytes(self.memory[_NAMES_OFFSET : _NAMES_OFFSET + size])
        return octets.decode().splitlines()

    @property
    def capacity(self) -> int:
        """Bytes of the ring, 0 if there is none yet."""
        return int(self.words[_CAPACITY])

    @capacity.setter
    def capacity(self, size: int) -> None:
        self.words[_CAPACITY] = size


class SentFrame(NamedTuple):
    """A frame to record: the address of its destination, its bytes, and those of its record."""

    address: int
    frame: memoryview
    step: int

    @classmethod
    def of(cls, address: int, frame: memoryview) -> SentFrame:
        """Return *frame*, from its EtherCAT header on, for any number of records."""
        return cls(address, frame, (_HEAD_SIZE + len(frame) + _ALIGN) & ~_ALIGN)


class FrameRingWriter:
    """Writes records; the engine's side.

    Args:
        header: Of the ring.
        memory: Header and ring.
    """

    def __init__(self, header: RingHeader, memory: memoryview) -> None:
        self._header = header
        self._words = words = header.words
        self._capacity = header.capacity
        self._ring = memory[HEADER_SIZE : HEADER_SIZE + self._capacity]
        self._numbers = {name: number for number, name in enumerate(header.ports)}
        self._records = words[_RECORDS]
        self._at = words[_WRITTEN] % self._capacity
        if words[_RESERVED] != words[_WRITTEN]:
            # A writer was killed in the middle of a record: readers find a new lap instead.
            self._begin_lap()

    def number(self, port: str) -> int | None:
        """Return the number of *port*, a new one if it has none; None if there is no room."""
        number = self._numbers.get(port)
        if number is not None:
            return number
        line = f"{port}\n".encode()
        size = self._words[_NAMES_SIZE]
        place = _NAMES_OFFSET + size
        if place + len(line) > HEADER_SIZE or len(self._numbers) >= _SENT - 1:
            return None
        self._header.memory[place : place + len(line)] = line
        self._words[_NAMES_SIZE] = size + len(line)
        number = self._numbers[port] = len(self._numbers)
        return number

    def add(self, port: int, at_ns: int, address: int, frame: memoryview) -> None:
        """Write one record of a frame that was received.

        Args:
            port: Number of the port.
            at_ns: Time on the monotonic clock.
            address: Of the sender, a word of ``eap.pd.address``.
            frame: From its EtherCAT header on; MAX_FRAME bytes at most.
        """
        # This and add_sent are called for each frame and each cycle: no attribute twice.
        size = len(frame)
        at = self._at
        after = at + ((_HEAD_SIZE + size + _ALIGN) & ~_ALIGN)
        if after > self._capacity:
            self._begin_lap()
            after -= at
            at = 0
        words, ring = self._words, self._ring
        words[_RESERVED] = end = words[_WRITTEN] + after - at
        if ordering.REORDERS:
            ordering.keep_order()
        self._records = number = self._records + 1
        start = at + _HEAD_SIZE
        _pack_head(ring, at, port, size, number & 0xFFFFFFFF, at_ns, address)
        ring[start : start + size] = frame
        self._at = after
        if ordering.REORDERS:
            ordering.keep_order()
        words[_RECORDS] = number
        words[_WRITTEN] = end

    def add_sent(self, port: int, at_ns: int, frames: Sequence[SentFrame]) -> None:
        """Write a record of each of *frames*, which left at one time."""
        total = 0
        for _, _, step in frames:
            total += step
        if self._at + total > self._capacity:
            self._begin_lap()
        words, ring, at = self._words, self._ring, self._at
        words[_RESERVED] = end = words[_WRITTEN] + total
        if ordering.REORDERS:
            ordering.keep_order()
        number, head = self._records, port | _SENT
        for address, frame, step in frames:
            number += 1
            size = len(frame)
            start = at + _HEAD_SIZE
            _pack_head(ring, at, head, size, number & 0xFFFFFFFF, at_ns, address)
            ring[start : start + size] = frame
            at += step
        self._at = at
        self._records = number
        if ordering.REORDERS:
            ordering.keep_order()
        words[_RECORDS] = number
        words[_WRITTEN] = end

    def _begin_lap(self) -> None:
        words = self._words
        lap = words[_WRITTEN] + self._capacity - self._at
        words[_RESERVED] = lap
        ordering.keep_order()
        if self._at + _HEAD.size <= self._capacity:
            _HEAD.pack_into(self._ring, self._at, _REST, 0, 0, 0, 0)
        self._at = 0
        words[_LAP] = lap
        ordering.keep_order()
        words[_WRITTEN] = lap


class RingRecord(NamedTuple):
    """One record: *port* is a number, *at_ns* on the monotonic clock."""

    port: int
    is_sent: bool
    at_ns: int
    address: int
    """Of the other end, a word of ``eap.pd.address``; 0 if it has none."""
    frame: bytes
    """From its EtherCAT header on."""


class FrameRun(NamedTuple):
    """Records that were copied in one piece, and the number of those missed before them."""

    octets: bytes
    lost: int


class FrameRingReader:
    """Reads records; one of any number of readers.

    Args:
        header: Of the ring.
        memory: Header and ring.
    """

    def __init__(self, header: RingHeader, memory: memoryview) -> None:
        self.header = header
        self._words = header.words
        self._capacity = header.capacity
        self._ring = memory[HEADER_SIZE : HEADER_SIZE + self._capacity]
        self._position = self._words[_WRITTEN]
        self._number = self._words[_RECORDS]
        """Of the last record that was read."""

    def runs(self) -> Iterator[FrameRun]:
        """Yield the records since the last call, in at most two pieces and what was missed."""
        for _ in range(2):
            if run := self._take():
                yield run

    def _take(self) -> FrameRun | None:
        words = self._words
        written = words[_WRITTEN]
        ordering.keep_order()
        lap = words[_LAP]
        if written == self._position:
            return None
        if words[_RESERVED] - self._position > self._capacity:
            # Of what is overwritten in part, the beginning is no record any more: only the
            # beginning of the lap certainly is one.
            self._position = lap
        position = self._position
        start = position % self._capacity
        end = min(start + written - position, self._capacity)
        octets = bytes(self._ring[start:end])
        ordering.keep_order()
        if words[_RESERVED] - position > self._capacity:
            return None  # overtaken while it copied; the next call begins at the lap
        self._position = position + end - start
        return self._checked(octets)

    def _checked(self, octets: bytes) -> FrameRun | None:
        """Return whole records, with the number of those missed before them."""
        first: int | None = None
        last, end = self._number, 0
        for end, last in _heads(octets):  # noqa: B007  the last ones are used
            if first is None:
                first = last
        if first is None:
            return None  # the rest of a lap
        lost = (first - self._number - 1) & 0xFFFFFFFF
        self._number = last
        return FrameRun(octets[:end], lost)


def _heads(octets: bytes) -> Iterator[tuple[int, int]]:
    """Yield the end and the number of each record."""
    at, size = 0, len(octets)
    while at + _HEAD.size <= size:
        head, length, number, _, _ = _HEAD.unpack_from(octets, at)
        if head == _REST:
            return
        at += (_HEAD.size + length + _ALIGN) & ~_ALIGN
        yield at, number


def records_in(octets: bytes, ports: Sequence[bool] = ()) -> Iterator[RingRecord]:
    """Yield the records of a :class:`FrameRun`, only those of *ports* that are true if given."""
    at, size = 0, len(octets)
    unpack, head_size = _HEAD.unpack_from, _HEAD.size
    wanted = len(ports)
    while at < size:
        head, length, _, at_ns, address = unpack(octets, at)
        port = head & ~_SENT
        start = at + head_size
        at = (start + length + _ALIGN) & ~_ALIGN
        if not ports or (port < wanted and ports[port]):
            frame = octets[start : start + length]
            yield RingRecord(port, bool(head & _SENT), at_ns, address, frame)
