"""pcapng files of frames: one interface a port, nanoseconds, directions, the plant file inside.

Blocks are those of the IETF draft "PCAP Next Generation (pcapng) Capture File Format".  Every
interface has link type Ethernet: frames below UDP get headers again, made of the addresses, because
the sockets of a station see only what is behind them.  Frames of TCP ports and ``loop://`` have no
such headers; they are written as Ethernet frames with EtherType 0x88A4 and addresses made of the
NetIDs.  Programs that know pcapng skip options and blocks that they do not know.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterable
from ipaddress import IPv4Address
from pathlib import Path
from typing import NamedTuple

import msgspec

from eap.codec.ethercat import ETHERTYPE
from eap.ids import MacAddr
from eap.recording.header import FORMAT, EventKind, RecordingEvent, RecordingHeader
from eap.recording.published import encode_published
from eap.recording.repair import lock
from eap.release import RELEASE

SECTION, INTERFACE, STATISTICS, PACKET = 0x0A0D0D0A, 1, 5, 6
"""Types of blocks."""
BYTE_ORDER = 0x1A2B3C4D
ETHERNET = 1
"""Link type."""
COMMENT, END = 1, 0
"""Options of every block."""
IF_NAME, IF_DESCRIPTION, IF_RESOLUTION = 2, 3, 9
IF_DROP = 5
"""Option of statistics: frames that were lost."""
FLAGS, DROPPED = 2, 4
"""Options of a packet: direction, and frames lost since the one before."""
INBOUND, OUTBOUND = 1, 2
PUBLISHED_COMMENT, FILE_COMMENT = "eap-published ", "eap-file "
"""Begin of comments of the section: the PDs as JSON, and a file of the plant, in numbered parts."""
EVENT_COMMENT = "eap-event "
HEADER_COMMENT = "eap-recording "

_MOST_OPTION = 60_000
"""Bytes of a comment: an option has at most 65,535, and its begin counts."""
_FLUSH_NS = 500_000_000
_FLUSH_BYTES = 1 << 20
_IPV4 = struct.Struct(">BBHHHBBHII")
_UDP = struct.Struct(">HHHH")


class Wrapping(NamedTuple):
    """Headers in front of the frames from one sender to one destination.

    *ip_sum* is the sum of the IP header's words without its length; None for frames without IP.
    """

    ethernet: bytes
    source: int = 0
    destination: int = 0
    source_port: int = 0
    destination_port: int = 0
    ip_sum: int | None = None

    def wrap(self, frame: bytes | memoryview) -> bytes:
        """Return *frame*, which begins at the EtherCAT header, with its headers."""
        if self.ip_sum is None:
            return self.ethernet + frame
        total = 28 + len(frame)
        checksum = self.ip_sum + total
        checksum = (checksum & 0xFFFF) + (checksum >> 16)
        checksum = ~((checksum & 0xFFFF) + (checksum >> 16)) & 0xFFFF
        return b"".join((
            self.ethernet,
            _IPV4.pack(0x45, 0, total, 0, 0x4000, 64, 17, checksum, self.source, self.destination),
            # A UDP checksum of 0 says that there is none.
            _UDP.pack(self.source_port, self.destination_port, 8 + len(frame), 0),
            frame,
        ))  # fmt: skip


def ethernet_wrapping(source: MacAddr, destination: MacAddr, vlan: int = 0) -> Wrapping:
    """Return the header of frames below EtherType 0x88A4; *vlan* is the tag's word, 0 for none."""
    tag = struct.pack(">HH", 0x8100, vlan) if vlan else b""
    return Wrapping(bytes(destination) + bytes(source) + tag + ETHERTYPE.to_bytes(2, "big"))


def udp_wrapping(source: tuple[str, int], destination: tuple[str, int]) -> Wrapping:
    """Return the headers of frames below UDP; both have an IPv4 address and a port."""
    ips = [int(IPv4Address(host)) for host, _ in (source, destination)]
    words = struct.unpack(">10H", _IPV4.pack(0x45, 0, 0, 0, 0x4000, 64, 17, 0, *ips))
    # Locally administered, with the IPv4 address: the real addresses are not known.
    macs = [b"\x02\x00" + each.to_bytes(4, "big") for each in ips]
    return Wrapping(
        macs[1] + macs[0] + b"\x08\x00", ips[0], ips[1], source[1], destination[1], sum(words)
    )


def _pad(octets: bytes) -> bytes:
    return octets + bytes(-len(octets) % 4)


def option(code: int, content: bytes) -> bytes:
    """Return one option, padded."""
    return struct.pack("<HH", code, len(content)) + _pad(content)


def block(kind: int, body: bytes) -> bytes:
    """Return one block; *body* is padded already."""
    size = struct.pack("<I", 12 + len(body))
    return struct.pack("<I", kind) + size + body + size


def _comment(text: str) -> bytes:
    return option(COMMENT, text.encode("utf-8", "replace")[:_MOST_OPTION])


def _comments_in_parts(begin: str, text: str) -> Iterable[bytes]:
    """Yield *text* in comments ``BEGIN PART/PARTS`` and a line end, then the part."""
    octets = text.encode("utf-8", "surrogateescape")
    step = _MOST_OPTION - 1000
    count = max(1, -(-len(octets) // step))
    for number in range(count):
        part = octets[number * step : (number + 1) * step]
        yield option(COMMENT, f"{begin} {number + 1}/{count}\n".encode() + part)


def section_header(header: RecordingHeader) -> bytes:
    """Return the first block of a file, with the origin of the recording in comments."""
    facts = {
        "format": FORMAT,
        "plant": header.plant,
        "host": header.host,
        "release": RELEASE,
        "started_ns": str(header.started_ns),
        **header.options,
    }
    options = [
        option(4, f"eap-appliance {RELEASE}".encode()),
        _comment(HEADER_COMMENT + msgspec.json.encode(facts).decode()),
        *_comments_in_parts(
            PUBLISHED_COMMENT + "json", encode_published(header.published).decode()
        ),
    ]
    for each in header.files:
        # A file in any encoding comes out with the bytes that it had.
        text = each.content.decode("utf-8", "surrogateescape")
        options += _comments_in_parts(FILE_COMMENT + each.name, text)
    body = struct.pack("<IHHq", BYTE_ORDER, 1, 0, -1) + b"".join(options) + option(END, b"")
    return block(SECTION, body)


def interface_block(name: str, description: str) -> bytes:
    """Return the description of an interface with time stamps in nanoseconds."""
    body = (
        struct.pack("<HHI", ETHERNET, 0, 0)
        + option(IF_NAME, name.encode())
        + option(IF_DESCRIPTION, description.encode())
        + option(IF_RESOLUTION, bytes([9]))
        + option(END, b"")
    )
    return block(INTERFACE, body)


_PACKET_HEAD = struct.Struct("<IIIIIII")
_FLAG_OPTIONS = {
    flags: option(FLAGS, flags.to_bytes(4, "little")) + option(END, b"")
    for flags in (INBOUND, OUTBOUND)
} | {0: b""}
_PADDING = (b"", b"\0\0\0", b"\0\0", b"\0")
"""Behind a packet, by its size modulo 4."""


class FramesWriter:
    """One file that is being written; not for several threads.

    Args:
        path: A file that does not exist yet.
        header: Origin of the recording.

    Attributes:
        lost: Frames that were reported as lost.
        frames: Frames so far.

    Raises:
        OSError: the file cannot be made or written, also from all other methods.
    """

    def __init__(self, path: Path, header: RecordingHeader) -> None:
        self.lost = 0
        self.frames = 0
        # Unbuffered: the blocks below are joined and written in one call.
        self._file = path.open("xb", buffering=0)
        lock(self._file)
        self._blocks = [section_header(header)]
        self._bytes = len(self._blocks[0])
        self._written = 0
        self._lost_at: list[int] = []
        self._dropped: dict[int, int] = {}
        """Frames lost since the last one, by interface."""
        self._events: list[bytes] = []
        self._flush_at_ns = 0
        self.flush()

    def add_interface(self, name: str, description: str) -> int:
        """Return the number of a port, such as ``island-01/eap0`` and its ``udp://127.0.1.1``."""
        self._add(interface_block(name, description))
        self._lost_at.append(0)
        return len(self._lost_at) - 1

    def write(
        self,
        interface: int,
        time_ns: int,
        packet: bytes,
        *,
        outbound: bool | None,
        comment: str = "",
    ) -> None:
        """Add one packet from its Ethernet header on (:class:`Wrapping`), at Unix time.

        *outbound* None is a packet of unknown direction.
        """
        size = len(packet)
        flags = 0 if outbound is None else OUTBOUND if outbound else INBOUND
        if comment or self._events or self._dropped.get(interface):
            options = self._options(interface, flags, comment)
        else:
            options = _FLAG_OPTIONS[flags]
        total = 32 + size + -size % 4 + len(options)
        self._blocks += (
            _PACKET_HEAD.pack(
                PACKET, total, interface, time_ns >> 32, time_ns & 0xFFFFFFFF, size, size
            ),
            packet,
            _PADDING[size % 4],
            options,
            total.to_bytes(4, "little"),
        )
        self._bytes += total
        self.frames += 1
        if self._bytes >= _FLUSH_BYTES or time_ns >= self._flush_at_ns:
            self.flush()
            self._flush_at_ns = time_ns + _FLUSH_NS

    def add_event(self, event: RecordingEvent, interface: int | None = None) -> None:
        """Add what happened; it becomes a comment of the next packet, or of the statistics."""
        if event.kind is EventKind.LOST:
            self.lost += event.count
            if interface is not None:
                self._lost_at[interface] += event.count
                # pcapng has the number at the next packet of its interface.
                self._dropped[interface] = self._dropped.get(interface, 0) + event.count
        self._events.append(_comment(EVENT_COMMENT + msgspec.json.encode(event).decode()))

    def flush(self) -> None:
        """Write what is in memory to the file."""
        if self._blocks:
            octets = memoryview(b"".join(self._blocks))
            self._blocks.clear()
            self._bytes = 0
            # A disk that is nearly full takes a part.
            while octets:
                count = os.write(self._file.fileno(), octets)
                octets = octets[count:]
                self._written += count

    def sync(self) -> None:
        """Have the disk keep what was flushed; it may take long, and another thread may call it."""
        os.fdatasync(self._file.fileno())

    @property
    def size(self) -> int:
        """Bytes of the file so far, without what is in memory."""
        return self._written

    def close(self, time_ns: int) -> None:
        """Add statistics of all interfaces, at Unix time, and close the file."""
        try:
            for interface, lost in enumerate(self._lost_at):
                # Events behind the last packet have no other place.
                comments = b"".join(self._events) if not interface else b""
                body = (
                    struct.pack("<III", interface, time_ns >> 32, time_ns & 0xFFFFFFFF)
                    + comments
                    + option(IF_DROP, lost.to_bytes(8, "little"))
                    + option(END, b"")
                )
                self._add(block(STATISTICS, body))
            self.flush()
            self.sync()
        finally:
            self._file.close()

    def abandon(self) -> None:
        """Close the file as a killed recorder leaves it; for a disk that is full."""
        self._file.close()

    def _add(self, octets: bytes) -> None:
        self._blocks.append(octets)
        self._bytes += len(octets)

    def _options(self, interface: int, flags: int, comment: str) -> bytes:
        found = self._events
        if comment:
            found.append(_comment(comment))
        found.append(option(FLAGS, flags.to_bytes(4, "little")))
        if dropped := self._dropped.pop(interface, 0):
            found.append(option(DROPPED, dropped.to_bytes(8, "little")))
        self._events = []
        return b"".join((*found, option(END, b"")))
