"""Decoded frames as records, from hexadecimal digits or from a pcap or pcapng file.

Frames are found below Ethernet, VLAN tags, IPv4, UDP and TCP streams.  A packet without a frame, or
one that is cut before its headers end, yields nothing; a frame that is cut yields its rest.
Malformed bytes raise nothing: the record has the fields before the fault, and ``error`` names it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from ipaddress import IPv4Address
from pathlib import Path
from typing import BinaryIO, NamedTuple

from msgspec import UNSET, Struct, UnsetType

from devicebus.wire.datagram import iter_datagrams
from eap.codec import ams, mailbox
from eap.codec.coe import describe_message
from eap.codec.ethercat import EAP_PORT, ETHERTYPE, EtherCatHeader, FrameType
from eap.codec.mailbox import MailboxError, MailboxErrorReply, MailboxHeader, MailboxType
from eap.codec.pd import PD_FRAME_START, PdFrameHeader, PdHeader, follow_pds, iter_pds
from eap.codec.wire import Buffer
from eap.errors import CodecError, MalformedError
from eap.ids import MacAddr
from eap.pd.rhythm import CycleOrder, CycleWatch


class DecodedPd(Struct, frozen=True):
    """PD of a frame of type 4; *quality* in units of 100 us."""

    id: int
    version: int
    length: int
    quality: int
    data: str


class DecodedDatagram(Struct, frozen=True, kw_only=True):
    """Datagram of a frame of type 1: with ADP and ADO, or with a logical address."""

    command: str
    index: int
    adp: int | UnsetType = UNSET
    ado: int | UnsetType = UNSET
    address: int | UnsetType = UNSET
    length: int
    circulating: bool
    irq: int
    data: str
    wkc: int


class DecodedAms(Struct, frozen=True, kw_only=True):
    """AMS packet of a frame of type 2, or of a mailbox message."""

    target: str
    target_port: int
    source: str
    source_port: int
    command: int
    service: str
    state_flags: int
    length: int
    error_code: int
    invoke_id: int
    data: str


class DecodedMailbox(Struct, kw_only=True):
    """Mailbox message of a frame of type 5.

    *service* names a message of CoE, with the number of its PDO; *detail* and *reason* are those of
    an error reply.
    """

    length: int
    address: int
    channel: int
    priority: int
    type: int
    protocol: str
    counter: int
    data: str = ""
    service: str | UnsetType = UNSET
    ams: DecodedAms | UnsetType = UNSET
    detail: int | UnsetType = UNSET
    reason: str | UnsetType = UNSET


class DecodedFrame(Struct, kw_only=True):
    """``eapctl decode``: one frame, and for a capture the packet that it was in.

    Each type has fields of its own: ``publisher``, ``cycle`` and ``pds`` type 4, ``datagrams``
    type 1, ``ams`` type 2, ``mailbox`` type 5, raw ``data`` all others.  Bytes are strings of
    hexadecimal digits.  *error* is None if all is well.

    *needed_length* is there if the PDs are whole, but not where *length* says; *cycle_order* is
    ``swapped`` if earlier frames of the publisher show that it swaps the bytes of its counter.
    """

    type: int | None = None
    length: int | None = None
    publisher: str | UnsetType | None = UNSET
    cycle: int | UnsetType | None = UNSET
    cycle_order: str | UnsetType = UNSET
    needed_length: int | UnsetType = UNSET
    pds: list[DecodedPd] | UnsetType = UNSET
    datagrams: list[DecodedDatagram] | UnsetType = UNSET
    ams: DecodedAms | UnsetType | None = UNSET
    mailbox: DecodedMailbox | UnsetType | None = UNSET
    data: str | UnsetType = UNSET
    error: str | None = None
    packet: int | UnsetType = UNSET
    time: float | UnsetType = UNSET
    transport: str | UnsetType = UNSET
    source: str | UnsetType = UNSET
    destination: str | UnsetType = UNSET
    vlan_id: int | UnsetType = UNSET


def decode_frame(data: Buffer) -> DecodedFrame:
    """Return the fields of one frame, which starts at the EtherCAT header; padding is ignored."""
    found = DecodedFrame()
    try:
        header = EtherCatHeader.decode(data)
    except CodecError as exc:
        found.error = str(exc)
        return found
    found.type, found.length = header.type, header.length
    end = EtherCatHeader.SIZE + header.length
    if header.type == FrameType.PROCESS_DATA and _read_by_pds(data, found):
        return found
    try:
        _READERS.get(header.type, _read_raw)(memoryview(data)[:end], found)
    except CodecError as exc:
        found.error = str(exc)
    if end > len(data):
        there = len(data) - EtherCatHeader.SIZE
        # Set last: that bytes are missing explains any error that decoding met at the end.
        found.error = (
            f"EtherCatHeader at offset 0: length {header.length}, but {there} bytes follow"
        )
    return found


def _read_by_pds(data: Buffer, found: DecodedFrame) -> bool:
    """Read a frame whose Length is wrong by the lengths of its PDs; return False for all others."""
    try:
        frame = follow_pds(data)
    except CodecError:
        return False
    if not frame.has_wrong_length:
        return False
    found.publisher, found.cycle = str(frame.header.publisher), frame.header.cycle
    found.pds = [_decoded_pd(pd, content) for pd, content in frame.pds]
    found.needed_length = frame.needed
    found.error = (
        f"EtherCatHeader at offset 0: wrong length {frame.length}: its PDs take {frame.needed} "
        "bytes; ports with length: lenient take the frame"
    )
    return True


def _decoded_pd(pd: PdHeader, data: memoryview) -> DecodedPd:
    return DecodedPd(pd.pd_id, pd.version, pd.length, pd.quality, data.hex())


def _read_process_data(frame: memoryview, found: DecodedFrame) -> None:
    found.publisher = found.cycle = None
    found.pds = pds = []
    header = PdFrameHeader.decode(frame, PD_FRAME_START)
    found.publisher, found.cycle = str(header.publisher), header.cycle
    for pd, data in iter_pds(frame):
        pds.append(_decoded_pd(pd, data))


def _read_datagrams(frame: memoryview, found: DecodedFrame) -> None:
    found.datagrams = datagrams = []
    for header, data, wkc in iter_datagrams(frame):
        is_logical = header.command.is_logical
        datagrams.append(
            DecodedDatagram(
                command=header.command.name,
                index=header.index,
                adp=UNSET if is_logical else header.adp,
                ado=UNSET if is_logical else header.ado,
                address=header.logical_address if is_logical else UNSET,
                length=header.length,
                circulating=bool(header.circulating),
                irq=header.irq,
                data=bytes(data).hex(),
                wkc=wkc,
            )
        )


def _read_ams(frame: memoryview, found: DecodedFrame) -> None:
    found.ams = None
    found.ams = _decoded_ams(frame[EtherCatHeader.SIZE :])


def _decoded_ams(packet: memoryview) -> DecodedAms:
    header, data = ams.decode_packet(packet)
    return DecodedAms(
        target=str(header.target),
        target_port=header.target_port,
        source=str(header.source),
        source_port=header.source_port,
        command=header.command,
        service=ams.AmsCommand.name_of(header.command),
        state_flags=header.state_flags,
        length=header.length,
        error_code=header.error_code,
        invoke_id=header.invoke_id,
        data=data.hex(),
    )


def _read_mailbox(frame: memoryview, found: DecodedFrame) -> None:
    found.mailbox = None
    header = MailboxHeader.decode(frame, EtherCatHeader.SIZE)
    found.mailbox = message = DecodedMailbox(
        length=header.length,
        address=header.address,
        channel=header.channel,
        priority=header.priority,
        type=int(header.type),
        protocol=header.type.title,
        counter=header.counter,
    )
    _, data = mailbox.decode_frame(frame)
    message.data = data.hex()
    if header.type is MailboxType.AOE:
        message.ams = _decoded_ams(data)
    elif header.type is MailboxType.COE:
        message.service = describe_message(data) or UNSET
    elif header.type is MailboxType.ERR:
        reply = MailboxErrorReply.decode(data)
        if reply.detail_type == mailbox.ERROR_REPLY and len(data) == MailboxErrorReply.SIZE:
            message.detail = reply.detail
            message.reason = MailboxError.name_of(reply.detail)


def _read_raw(frame: memoryview, found: DecodedFrame) -> None:
    found.data = frame[EtherCatHeader.SIZE :].hex()


_READERS: dict[int, Callable[[memoryview, DecodedFrame], None]] = {
    FrameType.DATAGRAM: _read_datagrams,
    FrameType.AMS: _read_ams,
    FrameType.PROCESS_DATA: _read_process_data,
    FrameType.MAILBOX: _read_mailbox,
}


_ETHERNET = 1
"""Link type of Ethernet in both file formats."""
_VLAN_TYPES = (0x8100, 0x88A8)
_IPV4 = 0x0800
_TCP, _UDP = 6, 17
_SYN = 0x02
_SEQUENCES = 1 << 32
_MOST_PUBLISHERS = 4096
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
        f"{IPv4Address(octets[at : at + 4])}:{port}"
        for at, port in zip((12, 16), ports, strict=True)
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


class CycleOrders:
    """Order of the bytes of the cycle counters of all publishers in a capture."""

    def __init__(self) -> None:
        self._watches: dict[str, CycleWatch] = {}

    def enter(self, frame: DecodedFrame) -> None:
        """Note the counter of *frame*, and mark the frame if its publisher swaps the bytes."""
        if not frame.publisher or not isinstance(frame.cycle, int):
            return
        if frame.publisher not in self._watches and len(self._watches) >= _MOST_PUBLISHERS:
            self._watches.clear()
        watch = self._watches.setdefault(frame.publisher, CycleWatch())
        watch.enter(frame.cycle)
        if watch.order is CycleOrder.SWAPPED:
            frame.cycle_order = CycleOrder.SWAPPED.value


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


def _iter_packets(file: BinaryIO, name: str) -> Iterator[tuple[int, bytes]]:
    import dpkt

    link_type = _ETHERNET
    try:
        reader = dpkt.pcap.UniversalReader(file)
        link_type = reader.datalink()
        if link_type == _ETHERNET:
            for seconds, octets in reader:
                yield round(seconds * 1_000_000_000), octets
    except (dpkt.Error, ValueError, ArithmeticError) as exc:
        raise MalformedError(
            f"no whole pcap or pcapng file ({exc})", layout=name, offset=file.tell()
        ) from None
    if link_type != _ETHERNET:
        raise MalformedError(
            f"link type {link_type}, expected {_ETHERNET}, Ethernet (capture on one interface)",
            layout=name,
        )
