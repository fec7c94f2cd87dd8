"""FMMUs: which bits of the logical memory are which bits of a slave (ETG.1000.4).

Units on whole bytes, which is almost all of them, are copied as bytes; the others bit by bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from devicebus.wire.register import FMMU_READ, FMMU_WRITE, Fmmu, Register


class EscMemory(Protocol):
    """What FMMUs map to: a slave controller, or whatever stands for one."""

    def read(self, address: int, length: int, now_ns: int) -> bytes | None:
        """Read as a master does; None where it must not."""

    def write(self, address: int, data: bytes, now_ns: int) -> bool:
        """Write as a master does; return whether anything was written."""

    def peek(self, address: int, length: int) -> bytes:
        """Read with no effect."""


class FmmuWindow(NamedTuple):
    """One active FMMU; *first* and *last* are bytes of the logical memory."""

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
        """Whether it maps whole bytes to whole bytes."""
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
    """What a window shares with a datagram."""

    first: int
    """Its bytes in the data, up to *end*."""
    end: int
    physical: int
    """Its bytes in the memory, *size* of them."""
    size: int
    mask: int
    """As many ones as it has bits; 0 for whole bytes on both sides."""
    shift: int
    """Bits in front of it in the data."""
    physical_shift: int
    """Bits in front of it in the memory."""


def find_slices(windows: Iterable[FmmuWindow], address: int, size: int) -> tuple[FmmuSlice, ...]:
    """Return what *windows* map of ``address`` to ``address + size``."""
    pieces = []
    for window in windows:
        begin = 8 * (window.first - address) + window.first_bit
        start = max(begin, 0)
        bits = min(begin + window.bits, 8 * size) - start
        if bits <= 0:
            continue
        first, shift = divmod(start, 8)
        offset, physical_shift = divmod(window.physical_bit + start - begin, 8)
        pieces.append(
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
    return tuple(pieces)


def read_slices(
    memory: EscMemory, pieces: Iterable[FmmuSlice], now_ns: int
) -> list[tuple[FmmuSlice, bytes]]:
    """Read what can be read, to be inserted later: a datagram's own data is written first."""
    found = []
    for piece in pieces:
        octets = memory.read(piece.physical, piece.size, now_ns)
        if octets is not None:
            found.append((piece, octets))
    return found


def insert_slices(frame: bytearray, start: int, found: Iterable[tuple[FmmuSlice, bytes]]) -> None:
    """Put what :func:`read_slices` found into the data at *start* of *frame*."""
    for piece, octets in found:
        first, end = start + piece.first, start + piece.end
        if not piece.mask:
            frame[first:end] = octets
            continue
        value = int.from_bytes(octets, "little") >> piece.physical_shift & piece.mask
        old = int.from_bytes(frame[first:end], "little") & ~(piece.mask << piece.shift)
        frame[first:end] = (old | value << piece.shift).to_bytes(end - first, "little")


def write_slices(
    memory: EscMemory, pieces: Iterable[FmmuSlice], frame: bytearray, start: int, now_ns: int
) -> bool:
    """Write from the data at *start* of *frame*; return whether anything was written."""
    written = False
    for piece in pieces:
        octets = bytes(frame[start + piece.first : start + piece.end])
        if piece.mask:
            value = int.from_bytes(octets, "little") >> piece.shift & piece.mask
            old = int.from_bytes(memory.peek(piece.physical, piece.size), "little")
            old &= ~(piece.mask << piece.physical_shift)
            octets = (old | value << piece.physical_shift).to_bytes(piece.size, "little")
        written |= memory.write(piece.physical, octets, now_ns)
    return written
