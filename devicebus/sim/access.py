"""Which registers an ESC has, and which of them a master may write (ESC data sheet, section II).

A datagram counts as executed when at least one of the octets it names was read or written; an ESC
without FMMU 6 therefore leaves the working counter of a write to it alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from devicebus.wire.register import Register

REGISTERS = int(Register.MEMORY)
"""Octets of the register space."""

_READ = (
    (0x0000, 0x000A), (0x0010, 0x0014), (0x0020, 0x0022), (0x0030, 0x0032), (0x0040, 0x0041),
    (0x0100, 0x0104), (0x0108, 0x010A), (0x0110, 0x0112), (0x0120, 0x0122), (0x0130, 0x0136),
    (0x0140, 0x0142), (0x0150, 0x0154), (0x0200, 0x0202), (0x0204, 0x0208), (0x0210, 0x0212),
    (0x0220, 0x0224), (0x0300, 0x0314), (0x0400, 0x0402), (0x0410, 0x0412), (0x0420, 0x0422),
    (0x0440, 0x0444), (0x0500, 0x0510),
)  # fmt: skip
_WRITE = (
    (0x0010, 0x0012), (0x0020, 0x0022), (0x0030, 0x0032), (0x0040, 0x0041), (0x0100, 0x0104),
    (0x0120, 0x0122), (0x0200, 0x0202), (0x0300, 0x030E), (0x0310, 0x0314), (0x0400, 0x0402),
    (0x0410, 0x0412), (0x0420, 0x0422), (0x0442, 0x0444), (0x0500, 0x0501), (0x0502, 0x0510),
)  # fmt: skip
_READ_DC = (
    (0x0900, 0x0936), (0x0980, 0x0983), (0x0984, 0x0985), (0x098E, 0x09A8),
)  # fmt: skip
_WRITE_DC = (
    (0x0900, 0x0904), (0x0910, 0x0918), (0x0920, 0x092C), (0x0930, 0x0932), (0x0934, 0x0936),
    (0x0980, 0x0982), (0x0990, 0x0998), (0x09A0, 0x09A8),
)  # fmt: skip


class AccessMap(NamedTuple):
    """One octet a register: 1 where it can be read, written."""

    readable: bytes
    writable: bytes


def access_map(fmmus: int, sync_managers: int, *, has_dc: bool) -> AccessMap:
    """Return what an ESC with so many FMMUs and sync managers lets a master read and write."""
    channels = range(Register.SYNC_MANAGER, Register.SYNC_MANAGER + 8 * sync_managers, 8)
    units = range(Register.FMMU, Register.FMMU + 16 * fmmus, 16)
    read = [*_READ, *((at, at + 16) for at in units), *((at, at + 8) for at in channels)]
    write = [
        *_WRITE,
        *((at, at + 13) for at in units),
        *_writable_of_channels(channels),
    ]
    if has_dc:
        read += _READ_DC
        write += _WRITE_DC
    return AccessMap(_mark(read), _mark(write))


def _writable_of_channels(channels: Iterable[int]) -> Iterator[tuple[int, int]]:
    # Status and PDI control belong to the slave.
    for at in channels:
        yield at, at + 5
        yield at + 6, at + 7


def _mark(ranges: Iterable[tuple[int, int]]) -> bytes:
    marks = bytearray(REGISTERS)
    for start, end in ranges:
        marks[start:end] = b"\1" * (end - start)
    return bytes(marks)
