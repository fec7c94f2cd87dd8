"""Reader of pcap and pcapng files: packets with their times, interfaces, directions and comments.

Both byte orders, all resolutions of time, any number of interfaces and sections.  pcapng blocks are
those of the IETF draft "PCAP Next Generation (pcapng) Capture File Format"; blocks of other types
are skipped.  A file that ends in the middle of a block, as a killed recorder leaves it, yields all
that precedes, then raises.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from eap.errors import MalformedError

SECTION, INTERFACE, SIMPLE, STATISTICS, PACKET = 0x0A0D0D0A, 1, 3, 5, 6
"""Types of blocks."""
COMMENT, IF_NAME, IF_DESCRIPTION, IF_RESOLUTION, IF_OFFSET, FLAGS = 1, 2, 3, 9, 14, 2
IF_DROP, OS_DROP = 5, 7
"""Options of statistics: packets lost by the interface and by the operating system."""
BYTE_ORDERS = {b"\x1a\x2b\x3c\x4d": ">", b"\x4d\x3c\x2b\x1a": "<"}
_PCAP = {
    b"\xa1\xb2\xc3\xd4": (">", 1000), b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\x3c\x4d": (">", 1), b"\x4d\x3c\xb2\xa1": ("<", 1),
}  # fmt: skip
"""Byte order and nanoseconds of a unit of pcap files, by their first bytes."""
ETHERNET = 1
"""Link type of Ethernet in both file formats."""
_LARGEST_BLOCK = 1 << 24
_NS = 1_000_000_000
LATEST_NS = 1 << 62
"""A later time, in the year 2116 and after, is damage, and becomes this one."""


class CaptureInterface(NamedTuple):
    """One interface of a file: *units* of time a second, from *offset* seconds on."""

    name: str
    description: str
    link_type: int
    units: int
    offset: int


class CapturePacket(NamedTuple):
    """One packet; *outbound* is None if the file does not say."""

    at_ns: int
    interface: int
    octets: bytes
    outbound: bool | None
    comments: tuple[str, ...]


class CaptureFile:
    """Packets of one file, read once from the start.

    Args:
        file: The file, at its start.
        name: Its name in errors.

    Attributes:
        interfaces: Those that were described so far, of all sections.
        comments: Comments of the sections so far.
        last_comments: Comments of statistics so far.
        whole_until: Offset behind the last whole block.
    """

    def __init__(self, file: BinaryIO, name: str) -> None:
        self.interfaces: list[CaptureInterface] = []
        self.comments: list[bytes] = []
        self.last_comments: list[str] = []
        self.whole_until = 0
        self._lost: dict[tuple[int, int], int] = {}
        self._file = file
        self._name = name
        self._order = "<"
        self._first_interface = 0

    @property
    def lost(self) -> int | None:
        """Packets that the statistics say were lost; None if they say nothing."""
        return sum(self._lost.values()) if self._lost else None

    def packets(self) -> Iterator[CapturePacket]:
        """Yield all packets.

        Raises:
            MalformedError: it is no capture, or it is damaged or cut.
        """
        magic = self._file.read(4)
        if magic in _PCAP:
            yield from self._pcap(*_PCAP[magic])
        elif magic == SECTION.to_bytes(4, "big"):
            self._file.seek(-4, 1)
            yield from self._pcapng()
        else:
            raise self._damaged("it begins with neither's magic number")

    def _pcap(self, order: str, unit_ns: int) -> Iterator[CapturePacket]:
        head = self._file.read(20)
        if len(head) < 20:
            raise self._damaged("its header is cut")
        (link_type,) = struct.unpack_from(f"{order}I", head, 16)
        self.interfaces.append(CaptureInterface("", "", link_type & 0xFFFF, _NS // unit_ns, 0))
        self.whole_until = 24
        unpack = struct.Struct(f"{order}IIII").unpack
        while head := self._file.read(16):
            if len(head) < 16:
                raise self._damaged("a packet is cut")
            seconds, units, size, _ = unpack(head)
            octets = self._read(size)
            self.whole_until += 16 + size
            yield CapturePacket(seconds * _NS + units * unit_ns, 0, octets, None, ())

    def _pcapng(self) -> Iterator[CapturePacket]:
        read = self._file.read
        while head := read(8):
            if len(head) < 8:
                raise self._damaged("a block is cut")
            if head[:4] == SECTION.to_bytes(4, "big"):
                self._begin_section(head)
                continue
            kind, size = struct.unpack(f"{self._order}II", head)
            if size < 12 or size % 4:
                raise self._damaged(f"a block of {size} bytes")
            body = self._read(size - 8)
            if body[-4:] != head[4:]:
                raise self._damaged("the two sizes of a block differ")
            try:
                packet = self._packet(body) if kind == PACKET else self._other_block(kind, body)
            except (struct.error, IndexError):
                raise self._damaged("a block is too short") from None
            self.whole_until += size
            if packet is not None:
                yield packet

    def _other_block(self, kind: int, body: bytes) -> CapturePacket | None:
        if kind == INTERFACE:
            self._add_interface(body)
        elif kind == STATISTICS:
            self._add_statistics(body)
        elif kind == SIMPLE:
            # Without a time; its size is in the first word.
            (length,) = struct.unpack_from(f"{self._order}I", body)
            if self._first_interface < len(self.interfaces):
                return CapturePacket(0, self._first_interface, body[4:-4][:length], None, ())
        return None

    def _begin_section(self, head: bytes) -> None:
        magic = self._read(4)
        order = BYTE_ORDERS.get(magic)
        if order is None:
            raise self._damaged("a section has no byte order")
        (size,) = struct.unpack_from(f"{order}I", head, 4)
        if size < 28 or size % 4:
            raise self._damaged(f"a section header of {size} bytes")
        body = self._read(size - 12)
        self._order = order
        self._first_interface = len(self.interfaces)
        self.comments += (text for code, text in self._options(body[12:-4]) if code == COMMENT)
        self.whole_until += size

    def _add_interface(self, body: bytes) -> None:
        (link_type,) = struct.unpack_from(f"{self._order}H", body)
        name = description = ""
        units, offset = 1_000_000, 0
        for code, content in self._options(body[8:-4]):
            if code == IF_NAME:
                name = content.decode("utf-8", "replace")
            elif code == IF_DESCRIPTION:
                description = content.decode("utf-8", "replace")
            elif code == IF_RESOLUTION and content:
                # Above 63 bits the time stamps could not hold a second.
                exponent = min(content[0] & 0x7F, 63)
                units = 2**exponent if content[0] & 0x80 else 10 ** min(exponent, 19)
            elif code == IF_OFFSET and len(content) == 8:
                (offset,) = struct.unpack(f"{self._order}q", content)
        self.interfaces.append(CaptureInterface(name, description, link_type, units, offset))

    def _packet(self, body: bytes) -> CapturePacket:
        interface, high, low, size, _ = struct.unpack_from(f"{self._order}IIIII", body)
        interface += self._first_interface
        described = self.interfaces[interface]
        if size > len(body) - 24:
            raise self._damaged(f"a packet of {size} bytes in a block of {len(body) + 8}")
        stamp = high << 32 | low
        at_ns = stamp if described.units == _NS else stamp * _NS // described.units
        outbound: bool | None = None
        comments: tuple[str, ...] = ()
        for code, content in self._options(body[20 + size + -size % 4 : -4]):
            if code == FLAGS and len(content) == 4:
                direction = struct.unpack(f"{self._order}I", content)[0] & 3
                outbound = {1: False, 2: True}.get(direction)
            elif code == COMMENT:
                comments += (content.decode("utf-8", "replace"),)
        octets = body[20 : 20 + size]
        at_ns = min(max(at_ns + described.offset * _NS, 0), LATEST_NS)
        return CapturePacket(at_ns, interface, octets, outbound, comments)

    def _add_statistics(self, body: bytes) -> None:
        (interface,) = struct.unpack_from(f"{self._order}I", body)
        for code, content in self._options(body[12:-4]):
            if code in {IF_DROP, OS_DROP} and len(content) == 8:
                (count,) = struct.unpack(f"{self._order}Q", content)
                self._lost[self._first_interface + interface, code] = count
            elif code == COMMENT:
                self.last_comments.append(content.decode("utf-8", "replace"))

    def _options(self, octets: bytes) -> Iterator[tuple[int, bytes]]:
        at = 0
        while at + 4 <= len(octets):
            code, size = struct.unpack_from(f"{self._order}HH", octets, at)
            if not code:
                return
            yield code, octets[at + 4 : at + 4 + size]
            at += 4 + size + -size % 4

    def _read(self, size: int) -> bytes:
        if size > _LARGEST_BLOCK:
            raise self._damaged(f"a block of {size} bytes")
        octets = self._file.read(size)
        if len(octets) < size:
            raise self._damaged("a block is cut")
        return octets

    def _damaged(self, why: str) -> MalformedError:
        return MalformedError(
            f"no whole pcap or pcapng file: {why}", layout=self._name, offset=self.whole_until
        )


def is_capture(path: Path) -> bool:
    """Return whether *path* begins as pcap and pcapng files do; raise OSError."""
    with path.open("rb") as file:
        magic = file.read(4)
    return magic in _PCAP or magic == SECTION.to_bytes(4, "big")
