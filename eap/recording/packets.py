"""EtherCAT frames in captured packets, and in pcap and pcapng files.

Frames are found below Ethernet, VLAN tags, IPv4, UDP and TCP streams.  A packet without a frame, or
one that is cut before its headers end, yields nothing; a frame that is cut yields its rest.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from socket import inet_ntoa
from typing import BinaryIO, NamedTuple

from eap.codec.ethercat import EAP_PORT, ETHERTYPE, EtherCatHeader
from eap.errors import MalformedError
from eap.ids import MacAddr
from eap.recording.capture_file import ETHERNET, CaptureFile

_VLAN_TYPES = (0x8100, 0x88A8)
_IPV4 = 0x0800
_TCP, _UDP = 6, 17
_SYN = 0x02
_SEQUENCES = 1 << 32
_MOST_WAITING = 64
"""Segments of a TCP stream kept for a missing one before it counts as lost."""


class TcpSegment(NamedTuple):
    """Position of a packet's payload in its TCP stream."""

    sequence: int
    is_first: bool


class Packet(NamedTuple):
    """One packet that may carry EtherCAT frames; TCP cuts them anywhere, the others never."""

    transport: str
    source: str
    destination: str
    vlan_id: int | None
    payload: bytes
    segment: TcpSegment | None = None


def unwrap(octets: bytes) -> Packet | None:
    """Return the payload of an Ethernet frame under EtherType 0x88A4 or port 34980, or None."""
    if len(octets) < 14:
        return None
    ethertype = int.from_bytes(octets[12:14], "big")
    start, vlan_id = 14, None
    # A frame may have several tags (802.1ad); the innermost VLAN is the one that is reported.
    while ethertype in _VLAN_TYPES and len(octets) >= start + 4:
        tag, ethertype = struct.unpack_from(">HH", octets, start)
        start, vlan_id = start + 4, tag & 0xFFF
    if ethertype == ETHERTYPE:
        source, destination = str(MacAddr(octets[6:12])), str(MacAddr(octets[:6]))
        return Packet("ethernet", source, destination, vlan_id, octets[start:])
    if ethertype == _IPV4:
        return _unwrap_ipv4(octets[start:], vlan_id)
    return None


def _unwrap_ipv4(octets: bytes, vlan_id: int | None) -> Packet | None:
    if len(octets) < 20 or octets[0] >> 4 != 4:
        return None
    total, fragment, protocol = struct.unpack_from(">2xH2xHxB", octets)
    header = 4 * (octets[0] & 15)
    # The total length is 0 where the sender's network card segments the packets.
    body = octets[header : total or None]
    least = {_UDP: 8, _TCP: 20}.get(protocol)
    # A later fragment has no port numbers, so its frame cannot be recognised.
    if fragment & 0x1FFF or least is None or len(body) < least:
        return None
    ports = struct.unpack_from(">HH", body)
    if EAP_PORT not in ports:
        return None
    source, destination = (
        f"{inet_ntoa(octets[at : at + 4])}:{port}" for at, port in zip((12, 16), ports, strict=True)
    )
    if protocol == _UDP:
        return Packet("udp", source, destination, vlan_id, body[8:])
    sequence, offset, flags = struct.unpack_from(">4xI4xBB", body)
    segment = TcpSegment(sequence, bool(flags & _SYN))
    return Packet("tcp", source, destination, vlan_id, body[4 * (offset >> 4) :], segment)


def cut_frames(stream: bytearray) -> Iterator[bytes]:
    """Remove every whole frame from the front of *stream*; the header's Length delimits them."""
    while len(stream) >= EtherCatHeader.SIZE:
        size = EtherCatHeader.SIZE + EtherCatHeader.decode(stream).length
        if len(stream) < size:
            return
        yield bytes(stream[:size])
        del stream[:size]


class Stream:
    """One direction of a TCP connection, put together from segments in any order."""

    def __init__(self) -> None:
        self._next: int | None = None
        self._waiting: dict[int, bytes] = {}
        self._incomplete = bytearray()

    def receive(self, segment: TcpSegment, payload: bytes) -> Iterator[bytes]:
        """Yield the frames that *payload* completes."""
        sequence = segment.sequence
        if segment.is_first:
            yield from self.flush()
            # SYN occupies a sequence number of its own: the data begins behind it.
            sequence = (sequence + 1) % _SEQUENCES
            self._next = sequence
        # A retransmission may be longer than the segment that it repeats.
        if payload and len(payload) > len(self._waiting.get(sequence, b"")):
            self._waiting[sequence] = payload
        # A capture may start in the middle of a connection: its first segment is the start.
        if self._next is None:
            self._next = sequence
        yield from self._reassemble()
        if len(self._waiting) > _MOST_WAITING:
            yield from self._skip_gap()

    def flush(self) -> Iterator[bytes]:
        """Yield the remaining frames, incomplete ones included."""
        while self._waiting:
            yield from self._skip_gap()
        yield from self._discard_incomplete()

    def _reassemble(self) -> Iterator[bytes]:
        for sequence in sorted(self._waiting, key=self._distance):
            ahead = self._distance(sequence)
            if ahead > 0:
                break
            fresh = self._waiting.pop(sequence)[
                -ahead:
            ]  # a retransmission repeats the bytes before
            self._incomplete += fresh
            self._next = (sequence - ahead + len(fresh)) % _SEQUENCES
        yield from cut_frames(self._incomplete)

    def _skip_gap(self) -> Iterator[bytes]:
        yield from self._discard_incomplete()
        self._next = min(self._waiting, key=self._distance)
        yield from self._reassemble()

    def _discard_incomplete(self) -> Iterator[bytes]:
        if self._incomplete:
            yield bytes(self._incomplete)
            self._incomplete.clear()

    def _distance(self, sequence: int) -> int:
        """Return the distance of *sequence* from the next expected one; sequence numbers wrap."""
        distance = (sequence - (self._next or 0)) % _SEQUENCES
        # Half of the number space ahead counts as behind.
        return distance - _SEQUENCES if distance >= _SEQUENCES // 2 else distance


class CapturedFrame(NamedTuple):
    """One frame; the packet is the one that completed it, counted from 1 as Wireshark does."""

    number: int
    at_ns: int
    """Capture time since 1970; some files hold no more than microseconds."""
    packet: Packet
    data: bytes
    """The frame from its EtherCAT header on, padding included."""


def iter_capture(path: Path) -> Iterator[CapturedFrame]:
    """Yield the frames in *path*: under our EtherType, UDP port or TCP port, in either direction.

    Frames that a TCP stream left unfinished come last.

    Raises:
        OSError: the file cannot be read.
        MalformedError: it is no capture of Ethernet, or it is damaged.
    """
    streams: dict[tuple[str, str], Stream] = {}
    last: dict[tuple[str, str], tuple[int, int, Packet]] = {}
    with path.open("rb") as file:
        for number, (at_ns, octets) in enumerate(_iter_packets(file, str(path)), 1):
            packet = unwrap(octets)
            if packet is None:
                continue
            if packet.segment is None:
                yield CapturedFrame(number, at_ns, packet, packet.payload)
                continue
            ends = (packet.source, packet.destination)
            last[ends] = (number, at_ns, packet)
            stream = streams.setdefault(ends, Stream())
            for data in stream.receive(packet.segment, packet.payload):
                yield CapturedFrame(number, at_ns, packet, data)
    for ends, stream in streams.items():
        for data in stream.flush():
            yield CapturedFrame(*last[ends], data)


def capture_drops(path: Path) -> int | None:
    """Return the packets that a pcapng file says its capture lost; None if it does not tell.

    Counted in Interface Statistics Blocks (pcapng, isb_ifdrop and isb_osdrop), which programs
    write at the end.
    """
    with path.open("rb") as file:
        capture = CaptureFile(file, str(path))
        with suppress(MalformedError):
            for _ in capture.packets():
                pass
        return capture.lost


def _iter_packets(file: BinaryIO, name: str) -> Iterator[tuple[int, bytes]]:
    capture = CaptureFile(file, name)
    for packet in capture.packets():
        if capture.interfaces[packet.interface].link_type != ETHERNET:
            raise _other_link_type(capture, name)
        yield packet.at_ns, packet.octets
    if capture.interfaces and all(each.link_type != ETHERNET for each in capture.interfaces):
        raise _other_link_type(capture, name)


def _other_link_type(capture: CaptureFile, name: str) -> MalformedError:
    found = next(each.link_type for each in capture.interfaces if each.link_type != ETHERNET)
    return MalformedError(
        f"link type {found}, expected {ETHERNET}, Ethernet (capture on one interface)", layout=name
    )
