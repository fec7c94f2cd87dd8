"""FMMUs: mapping of logical addresses to the memory of a slave (ETG.1000.4).

FMMUs on whole bytes, which are almost all, are copied as bytes; the others are shifted and masked.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from devicebus.wire.register import FMMU_READ, FMMU_WRITE, Fmmu, Register


class EscMemory(Protocol):
    """Memory behind FMMUs: a slave controller."""

    def read(self, address: int, length: int, now_ns: int) -> bytes | None:
        """Read as a master does; None if not readable."""

    def write(self, address: int, data: bytes, now_ns: int) -> bool:
        """Write as a master does; return false if no byte was written."""

    def peek(self, address: int, length: int) -> bytes:
        """Read without the effects of a master's read."""


class FmmuWindow(NamedTuple):
    """Active FMMU; *first* and *last* are logical addresses of bytes."""

    first: int
    last: int
    physical: int
    first_bit: int
    bits: int
    physical_bit: int
    can_read: bool
    can_write: bool

    @property
    def is_whole(self) -> bool:
        """True if it maps whole bytes to whole bytes."""
        return not self.first_bit and not self.physical_bit and not self.bits % 8


def active_windows(memory: bytearray, count: int) -> tuple[FmmuWindow, ...]:
    """Read the registers of *count* FMMUs and return the active ones."""
    units = (Fmmu.decode(memory, Register.FMMU + 16 * number) for number in range(count))
    windows = (_window(unit) for unit in units if unit.activate & 1 and unit.length)
    return tuple(window for window in windows if window.bits > 0)


def _window(unit: Fmmu) -> FmmuWindow:
    first_bit = unit.logical_start_bit & 7
    bits = 8 * (unit.length - 1) + (unit.logical_end_bit & 7) - first_bit + 1
    return FmmuWindow(
        unit.logical_start,
        unit.logical_start + unit.length - 1,
        unit.physical_start,
        first_bit,
        bits,
        unit.physical_start_bit & 7,
        bool(unit.type & FMMU_READ),
        bool(unit.type & FMMU_WRITE),
    )


class FmmuSlice(NamedTuple):
    """Overlap of an FMMU window with a datagram."""

    first: int
    """Offset in the data, up to *end*."""
    end: int
    physical: int
    """Address in the memory, for *size* bytes."""
    size: int
    mask: int
    """Mask of its bits; 0 for whole bytes on both sides."""
    shift: int
    """Bit offset in the data."""
    physical_shift: int
    """Bit offset in the memory."""


def find_slices(windows: Iterable[FmmuWindow], address: int, size: int) -> tuple[FmmuSlice, ...]:
    """Return the overlaps of *windows* with ``address`` to ``address + size``."""
    slices = []
    for window in windows:
        # All positions in bits: an FMMU may begin and end within bytes on both sides.
        begin = 8 * (window.first - address) + window.first_bit
        start = max(begin, 0)
        bits = min(begin + window.bits, 8 * size) - start
        if bits <= 0:
            continue
        first, shift = divmod(start, 8)
        offset, physical_shift = divmod(window.physical_bit + start - begin, 8)
        slices.append(
            FmmuSlice(
                first,
                first + (shift + bits + 7) // 8,
                window.physical + offset,
                (physical_shift + bits + 7) // 8,
                0 if window.is_whole else (1 << bits) - 1,
                shift,
                physical_shift,
            )
        )
    return tuple(slices)


def read_slices(
    memory: EscMemory, slices: Iterable[FmmuSlice], now_ns: int
) -> list[tuple[FmmuSlice, bytes]]:
    """Read the readable slices, for insertion after the write: LRW writes the received data."""
    data_read = []
    for part in slices:
        octets = memory.read(part.physical, part.size, now_ns)
        if octets is not None:
            data_read.append((part, octets))
    return data_read


def insert_slices(
    frame: bytearray, start: int, data_read: Iterable[tuple[FmmuSlice, bytes]]
) -> None:
    """Insert the result of :func:`read_slices` into the data at *start* of *frame*."""
    for part, octets in data_read:
        first, end = start + part.first, start + part.end
        if not part.mask:
            frame[first:end] = octets
            continue
        value = int.from_bytes(octets, "little") >> part.physical_shift & part.mask
        old = int.from_bytes(frame[first:end], "little") & ~(part.mask << part.shift)
        frame[first:end] = (old | value << part.shift).to_bytes(end - first, "little")


def write_slices(
    memory: EscMemory, slices: Iterable[FmmuSlice], frame: bytearray, start: int, now_ns: int
) -> bool:
    """Write from the data at *start* of *frame*; return false if no byte was written."""
    written = False
    for part in slices:
        octets = bytes(frame[start + part.first : start + part.end])
        if part.mask:
            value = int.from_bytes(octets, "little") >> part.shift & part.mask
            # Bits outside the mask keep their value; a read in place of peek would have effects.
            old = int.from_bytes(memory.peek(part.physical, part.size), "little")
            old &= ~(part.mask << part.physical_shift)
            octets = (old | value << part.physical_shift).to_bytes(part.size, "little")
        written |= memory.write(part.physical, octets, now_ns)
    return written
