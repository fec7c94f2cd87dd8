"""FMMUs: which bits of the logical memory are which bits of a slave (ETG.1000.4).

Units on whole octets, which is almost all of them, are copied as octets; the others bit by bit.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple, Protocol

from devicebus.wire.register import FMMU_READ, FMMU_WRITE, Fmmu, Register


class Memory(Protocol):
    """What FMMUs map to: a slave controller, or whatever stands for one."""

    def read(self, address: int, length: int, now_ns: int) -> bytes | None:
        """Read as a master does; None where it must not."""

    def write(self, address: int, data: bytes, now_ns: int) -> bool:
        """Write as a master does; return whether anything was written."""

    def peek(self, address: int, length: int) -> bytes:
        """Read with no effect."""


class Window(NamedTuple):
    """One active FMMU; *first* and *last* are octets of the logical memory."""

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
        """Whether it maps whole octets to whole octets."""
        return not self.first_bit and not self.physical_bit and not self.bits % 8


def active_windows(memory: bytearray, count: int) -> tuple[Window, ...]:
    """Read the registers of *count* FMMUs and return the active ones."""
    units = (Fmmu.decode(memory, Register.FMMU + 16 * number) for number in range(count))
    windows = (_window(unit) for unit in units if unit.activate & 1 and unit.length)
    return tuple(window for window in windows if window.bits > 0)


def _window(unit: Fmmu) -> Window:
    first_bit = unit.logical_start_bit & 7
    bits = 8 * (unit.length - 1) + (unit.logical_end_bit & 7) - first_bit + 1
    return Window(
        unit.logical_start,
        unit.logical_start + unit.length - 1,
        unit.physical_start,
        first_bit,
        bits,
        unit.physical_start_bit & 7,
        bool(unit.type & FMMU_READ),
        bool(unit.type & FMMU_WRITE),
    )


def read_windows(
    memory: Memory, windows: Iterable[Window], address: int, size: int, now_ns: int
) -> list[tuple[int, int, int]]:
    """Read what *windows* map of ``address`` to ``address + size``.

    Returns:
        For each part that could be read: its first bit in the data, its bits, their value.
    """
    parts = []
    for window in windows:
        if not window.can_read:
            continue
        shared = _shared_bits(window, address, size)
        if shared is None:
            continue
        start, bits = shared
        physical, shift = _physical(window, address, start)
        octets = memory.read(physical, (shift + bits + 7) // 8, now_ns)
        if octets is not None:
            value = int.from_bytes(octets, "little") >> shift & (1 << bits) - 1
            parts.append((start, bits, value))
    return parts


def insert_parts(data: bytearray, parts: Iterable[tuple[int, int, int]]) -> None:
    """Put the values that :func:`read_windows` found into *data*."""
    for start, bits, value in parts:
        first, shift = divmod(start, 8)
        end = first + (shift + bits + 7) // 8
        if not shift and not bits % 8:
            data[first:end] = value.to_bytes(end - first, "little")
            continue
        old = int.from_bytes(data[first:end], "little")
        mask = (1 << bits) - 1 << shift
        data[first:end] = (old & ~mask | value << shift).to_bytes(end - first, "little")


def write_windows(
    memory: Memory, windows: Iterable[Window], address: int, data: bytes, now_ns: int
) -> bool:
    """Write what *windows* map of *data*; return whether anything was written."""
    written = False
    for window in windows:
        if not window.can_write:
            continue
        shared = _shared_bits(window, address, len(data))
        if shared is None:
            continue
        start, bits = shared
        physical, shift = _physical(window, address, start)
        first, frame_shift = divmod(start, 8)
        if window.is_whole:
            written |= memory.write(physical, data[first : first + bits // 8], now_ns)
            continue
        end = first + (frame_shift + bits + 7) // 8
        value = int.from_bytes(data[first:end], "little") >> frame_shift & (1 << bits) - 1
        size = (shift + bits + 7) // 8
        mask = (1 << bits) - 1 << shift
        old = int.from_bytes(memory.peek(physical, size), "little")
        octets = (old & ~mask | value << shift).to_bytes(size, "little")
        written |= memory.write(physical, octets, now_ns)
    return written


def _shared_bits(window: Window, address: int, size: int) -> tuple[int, int] | None:
    begin = 8 * (window.first - address) + window.first_bit
    start = max(begin, 0)
    end = min(begin + window.bits, 8 * size)
    return (start, end - start) if start < end else None


def _physical(window: Window, address: int, start: int) -> tuple[int, int]:
    begin = 8 * (window.first - address) + window.first_bit
    offset, shift = divmod(window.physical_bit + start - begin, 8)
    return window.physical + offset, shift
