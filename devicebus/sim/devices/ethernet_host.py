"""Host behind the EoE of a simulated slave: ARP, ping, and a web page (RFC 826, 792, 9293, 9112).

TCP is as small as one page needs: no timers, so a lost segment is repeated when the client repeats
its own; no window, since a page is shorter than that of any client.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from enum import IntEnum
from html import escape
from typing import NamedTuple
from zlib import crc32

from eap.codec.eoe import IpSettings
from eap.ids import MacAddr

_MAC_PREFIX = bytes.fromhex("020e5a")
"""Locally administered."""
_BROADCAST = b"\xff" * 6
_IP, _ARP = 0x0800, 0x0806
_ETHERNET = 14
_ARP_REQUEST = bytes.fromhex("0001 0800 06 04 0001")
_ARP_REPLY = bytes.fromhex("0001 0800 06 04 0002")
_ARP_SIZE = 28
_ECHO_REQUEST, _ECHO_REPLY = 8, 0
_IP_HEADER = 20
_FRAGMENT = 0x3FFF
_TTL = 64


class IpProtocol(IntEnum):
    """Protocols in an IP packet (IANA protocol numbers)."""

    ICMP = 1
    TCP = 6


def mac_of(name: str) -> bytes:
    """Return the MAC address of a slave to which its master has given none."""
    return _MAC_PREFIX + crc32(name.encode()).to_bytes(4)[1:]


class _Addresses(NamedTuple):
    mac: bytes
    ip: bytes


class _Packet(NamedTuple):
    """An IP packet for this host."""

    sender_mac: bytes
    source: bytes
    protocol: int
    data: bytes


class EthernetHost:
    """Host behind EoE.

    Args:
        name: Of the slave.
        settings: Returns its IP settings; without an address it does not answer.
    """

    def __init__(self, name: str, settings: Callable[[], IpSettings]) -> None:
        self._name = name
        self._settings = settings
        self._tcp = TcpServer(self._page)

    def receive_frame(self, frame: bytes) -> list[bytes]:
        """Return the answers to an Ethernet frame (without check sequence)."""
        own = self._own()
        if own is None or len(frame) < _ETHERNET or frame[:6] not in {own.mac, _BROADCAST}:
            return []
        (kind,) = struct.unpack_from(">H", frame, 12)
        if kind == _ARP:
            return _answer_arp(frame, own)
        packet = _parse_ip(frame, own) if kind == _IP else None
        if packet is None:
            return []
        match packet.protocol:
            case IpProtocol.ICMP:
                replies = _answer_ping(packet.data)
            case IpProtocol.TCP:
                replies = self._tcp.receive_segment(packet.source, own.ip, packet.data)
            case _:
                replies = []
        return [_encode_ip(packet, own, reply) for reply in replies]

    def announce(self) -> list[bytes]:
        """Return what a host sends when it gets an address: ARP for its own (RFC 5227) and gateway.

        Switches learn the address by it.
        """
        own, gateway = self._own(), self._settings().gateway
        if own is None:
            return []
        wanted = [own.ip] if gateway is None or not int(gateway) else [own.ip, gateway.packed]
        head = _BROADCAST + own.mac + _ARP.to_bytes(2, "big") + _ARP_REQUEST + own.mac + own.ip
        return [head + bytes(6) + each for each in wanted]

    def _own(self) -> _Addresses | None:
        settings = self._settings()
        if settings.ip is None or not int(settings.ip):
            return None
        mac = MacAddr(mac_of(self._name)) if settings.mac is None else settings.mac
        return _Addresses(bytes(mac), settings.ip.packed)

    def _page(self, request: bytes) -> bytes:
        """Return the response to an HTTP request."""
        words = request.split(b"\r\n", 1)[0].split(b" ")
        status, title = "200 OK", self._name
        if len(words) != 3 or words[0] not in {b"GET", b"HEAD"}:
            status = title = "501 Not Implemented"
        elif words[1] != b"/":
            status = title = "404 Not Found"
        settings = self._settings()
        rows = "".join(
            f"<tr><td>{label}</td><td>{escape(str(value))}</td></tr>\n"
            for label, value in (
                ("IP address", settings.ip),
                ("mask", settings.mask),
                ("gateway", settings.gateway),
                ("name", settings.name),
            )
            if value is not None
        )
        body = (
            f"<!doctype html>\n<title>{escape(title)}</title>\n<h1>{escape(title)}</h1>\n"
            f"<p>Simulated slave, reached by EoE.</p>\n<table>\n{rows}</table>\n"
        ).encode()
        head = (
            f"HTTP/1.1 {status}\r\nContent-Type: text/html; charset=utf-8\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        ).encode()
        return head if words[0] == b"HEAD" else head + body


def _answer_arp(frame: bytes, own: _Addresses) -> list[bytes]:
    body = frame[_ETHERNET : _ETHERNET + _ARP_SIZE]
    if len(body) < _ARP_SIZE or body[:8] != _ARP_REQUEST or body[24:28] != own.ip:
        return []
    asker = body[8:18]
    if asker[:6] == own.mac:
        return []
    reply = _ARP_REPLY + own.mac + own.ip + asker
    return [asker[:6] + own.mac + _ARP.to_bytes(2, "big") + reply]


def _parse_ip(frame: bytes, own: _Addresses) -> _Packet | None:
    packet = frame[_ETHERNET:]
    if len(packet) < _IP_HEADER or packet[0] >> 4 != 4:
        return None
    header_size = 4 * (packet[0] & 0x0F)
    total, fragment = struct.unpack_from(">2xH2xH", packet)
    data = packet[header_size:total]
    is_whole = header_size >= _IP_HEADER and len(data) == total - header_size >= 8
    if not is_whole or fragment & _FRAGMENT or packet[16:20] != own.ip:
        return None
    return _Packet(frame[6:12], packet[12:16], packet[9], data)


def _encode_ip(request: _Packet, own: _Addresses, data: bytes) -> bytes:
    """Return the frame that takes *data* back to the sender of a packet."""
    total = _IP_HEADER + len(data)
    header = bytearray(
        struct.pack(">BBHHHBBH", 0x45, 0, total, 0, 0x4000, _TTL, request.protocol, 0)
    )
    header += own.ip + request.source
    header[10:12] = _checksum(header)
    return request.sender_mac + own.mac + _IP.to_bytes(2, "big") + bytes(header) + data


def _answer_ping(message: bytes) -> list[bytes]:
    if message[0] != _ECHO_REQUEST:
        return []
    reply = bytearray(message)
    reply[0] = _ECHO_REPLY
    reply[2:4] = bytes(2)
    reply[2:4] = _checksum(reply)
    return [bytes(reply)]


def _checksum(octets: bytes | bytearray) -> bytes:
    """Return the Internet check sum (RFC 1071)."""
    padded = bytes(octets) + bytes(len(octets) % 2)
    total: int = sum(struct.unpack(f">{len(padded) // 2}H", padded))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return (~total & 0xFFFF).to_bytes(2, "big")


_PORT = 80
_FIN, _SYN, _RST, _PSH, _ACK = 0x01, 0x02, 0x04, 0x08, 0x10
_HEADER = struct.Struct(">HHIIBBHHH")
_SEGMENT = 536
"""Bytes of a segment that every host takes."""
_WINDOW = 4096
MAX_REQUEST = 4096
"""Bytes of the longest request."""
MAX_CONNECTIONS = 16
"""Connections at a time; a new one replaces the oldest."""
_END_OF_HEAD = b"\r\n\r\n"


class _Segment(NamedTuple):
    source: int
    target: int
    sequence: int
    acknowledged: int
    flags: int
    data: bytes


class _TcpConnection:
    __slots__ = ("answer", "expected", "has_ended", "request", "start")

    def __init__(self, expected: int, start: int) -> None:
        self.expected = expected
        """Next sequence number of the client."""
        self.start = start
        """Sequence number of the first byte of the answer."""
        self.request = b""
        self.answer: bytes | None = None
        self.has_ended = False


class TcpServer:
    """TCP port 80; each connection has one request and one response.

    Args:
        respond: Returns the response to a request, which ends with an empty line.
    """

    def __init__(self, respond: Callable[[bytes], bytes]) -> None:
        self._respond = respond
        self._connections: dict[tuple[bytes, int], _TcpConnection] = {}
        self._count = 0

    def receive_segment(self, source: bytes, own: bytes, octets: bytes) -> list[bytes]:
        """Return the segments that answer one, each with its header."""
        segment = _parse_segment(octets)
        if segment is None or segment.flags & _RST:
            if segment is not None:
                self._connections.pop((source, segment.source), None)
            return []
        key = source, segment.source
        connection = self._connections.get(key)
        if segment.target != _PORT or (connection is None and not segment.flags & _SYN):
            parts = [(segment.acknowledged, _RST | _ACK, b"")]
            expected = segment.sequence + len(segment.data) + bool(segment.flags & (_SYN | _FIN))
        elif connection is None or segment.flags & _SYN:
            connection = self._open(key, segment)
            parts = [(connection.start - 1, _SYN | _ACK, b"")]
            expected = connection.expected
        else:
            parts = self._continue(key, connection, segment)
            expected = connection.expected
        return [
            _encode_segment(own, source, segment.source, part, expected & 0xFFFF_FFFF)
            for part in parts
        ]

    def _open(self, key: tuple[bytes, int], segment: _Segment) -> _TcpConnection:
        self._count += 1
        start = crc32(self._count.to_bytes(4) + key[0])
        self._connections.pop(key, None)
        connection = self._connections[key] = _TcpConnection(segment.sequence + 1, start + 1)
        if len(self._connections) > MAX_CONNECTIONS:
            del self._connections[next(iter(self._connections))]
        return connection

    def _continue(
        self, key: tuple[bytes, int], connection: _TcpConnection, segment: _Segment
    ) -> list[tuple[int, int, bytes]]:
        """Return sequence number, flags and data of the answers to a segment."""
        is_next = (segment.sequence - connection.expected) & 0xFFFF_FFFF == 0
        if is_next:
            connection.expected += len(segment.data)
            connection.request += segment.data
            if segment.flags & _FIN:
                connection.expected += 1
                connection.has_ended = True
        if connection.answer is None and len(connection.request) > MAX_REQUEST:
            del self._connections[key]
            return [(connection.start, _RST | _ACK, b"")]
        if connection.answer is None and _END_OF_HEAD in connection.request:
            connection.answer = self._respond(connection.request)
        elif connection.answer is None and connection.has_ended:
            connection.answer = b""
        answer = connection.answer
        if answer is None:
            return [(connection.start, _ACK, b"")] if segment.data else []
        done = (segment.acknowledged - connection.start) & 0xFFFF_FFFF
        if done == len(answer) + 1:  # the client has all of it and the end
            if connection.has_ended:
                del self._connections[key]
                return [(connection.start + done, _ACK, b"")] if segment.flags & _FIN else []
            return []
        # All is sent at once, and again if the client repeats its request.
        if not segment.data and not segment.flags & _FIN:
            return []
        parts = [
            (connection.start + at, _PSH | _ACK, answer[at : at + _SEGMENT])
            for at in range(0, len(answer), _SEGMENT)
        ]
        return [*parts, (connection.start + len(answer), _FIN | _ACK, b"")]


def _parse_segment(octets: bytes) -> _Segment | None:
    if len(octets) < _HEADER.size:
        return None
    source, target, sequence, acknowledged, offset, flags, *_ = _HEADER.unpack_from(octets)
    size = 4 * (offset >> 4)
    if not _HEADER.size <= size <= len(octets):
        return None
    return _Segment(source, target, sequence, acknowledged, flags, octets[size:])


def _encode_segment(
    own: bytes, peer: bytes, port: int, part: tuple[int, int, bytes], expected: int
) -> bytes:
    sequence, flags, data = part
    head = _HEADER.pack(
        _PORT, port, sequence & 0xFFFF_FFFF, expected, _HEADER.size << 2, flags, _WINDOW, 0, 0
    )
    pseudo = own + peer + struct.pack(">BBH", 0, IpProtocol.TCP, len(head) + len(data))
    check = _checksum(pseudo + head + data)
    return head[:16] + check + head[18:] + data
