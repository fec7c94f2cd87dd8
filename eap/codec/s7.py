"""S7 communication on ISO-on-TCP: TPKT (RFC 1006), COTP class 0 (ISO 8073), and S7 PDUs.

Siemens documents the services but not the bytes; the layout is that of the open implementations
snap7, nodes7 and of the dissector of Wireshark.  Everything is big-endian.  Only what reads and
writes data is here: the set-up of a connection, reading and writing of items.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from eap.codec.wire import Buffer
from eap.errors import MalformedError, TruncatedError

S7_PORT = 102
TPKT_SIZE = 4
MAX_TPKT = 8192
"""Bytes of the largest packet that is taken."""
_DT = bytes((2, 0xF0, 0x80))
"""Header of a COTP data packet, the last one of its PDU."""
_MAGIC = 0x32
HEADER_SIZE, REPLY_HEADER_SIZE = 10, 12
"""Bytes of the header of a request, and of a reply, which has an error."""
ITEM_SIZE = 12
"""Bytes of the address of an item in a request."""
MAX_ITEMS = 20
"""Items in one request, as controllers take them."""


class CotpKind(IntEnum):
    """Kind of a COTP packet."""

    DISCONNECT = 0x80
    CONFIRM = 0xD0
    REQUEST = 0xE0
    DATA = 0xF0


class PduKind(IntEnum):
    """Kind of an S7 PDU (ROSCTR)."""

    JOB = 1
    ACK = 2
    ACK_DATA = 3
    USER_DATA = 7


class S7Function(IntEnum):
    """First byte of the parameters."""

    READ = 0x04
    WRITE = 0x05
    SETUP = 0xF0


class S7Area(IntEnum):
    """Memory of a controller."""

    INPUTS = 0x81
    OUTPUTS = 0x82
    FLAGS = 0x83
    BLOCK = 0x84
    """Data block; the only one with a number."""


class ItemCode(IntEnum):
    """Result of one item."""

    HARDWARE = 0x01
    DENIED = 0x03
    ADDRESS = 0x05
    TYPE = 0x06
    SIZE = 0x07
    MISSING = 0x0A
    DONE = 0xFF

    @classmethod
    def words_of(cls, code: int) -> str:
        """Return the meaning of a code that a controller sent."""
        return _ITEM_WORDS.get(code, f"error {code:#04x}")


_ITEM_WORDS: dict[int, str] = {
    ItemCode.HARDWARE: "hardware fault",
    ItemCode.DENIED: "access denied (PUT/GET is not permitted, or the block is protected)",
    ItemCode.ADDRESS: "the address is outside the block (or the block is optimised)",
    ItemCode.TYPE: "the type is not supported",
    ItemCode.SIZE: "the size does not match",
    ItemCode.MISSING: "there is no such block",
}

NOT_SUPPORTED = 0x8104
"""Error of a reply: the function is not supported."""
TOO_LONG = 0x8500
"""Error of a reply: the PDU is too long."""


class TransportSize(IntEnum):
    """Transport size of an item in a request: the type of its elements."""

    BIT = 0x01
    BYTE = 0x02


_ELEMENT_BITS = {
    0x01: 1, 0x02: 8, 0x03: 8, 0x04: 16, 0x05: 16, 0x06: 32, 0x07: 32, 0x08: 32, 0x09: 16,
    0x0A: 32, 0x0B: 32, 0x0C: 16, 0x0F: 64,
}  # fmt: skip
"""Bits of one element, by its type: BIT, BYTE, CHAR, WORD, INT, DWORD, DINT, REAL, DATE, …"""
_DATA_BIT, _DATA_BYTES = 0x03, 0x04
_IN_BITS = frozenset((0x03, 0x04, 0x05))
"""Types of data whose length is in bits; that of others is in bytes."""


class S7Pdu(NamedTuple):
    """One S7 PDU; *error* is 0 unless it is a reply that has one."""

    kind: int
    reference: int
    parameters: bytes
    data: bytes = b""
    error: int = 0

    def encode(self) -> bytes:
        """Return the PDU."""
        sizes = len(self.parameters), len(self.data)
        head = struct.pack(">BBHHHH", _MAGIC, self.kind, 0, self.reference, *sizes)
        if self.kind in {PduKind.ACK, PduKind.ACK_DATA}:
            head += struct.pack(">H", self.error)
        return head + self.parameters + self.data

    @classmethod
    def decode(cls, payload: bytes) -> S7Pdu:
        """Read a PDU; raise CodecError if it is none."""
        if len(payload) < HEADER_SIZE:
            raise TruncatedError(
                f"needs {HEADER_SIZE} bytes, but {len(payload)} follow", layout=cls.__name__
            )
        magic, kind, _, reference, parameters, data = struct.unpack_from(">BBHHHH", payload)
        if magic != _MAGIC:
            raise MalformedError(f"begins with {magic:#04x}, not 0x32", layout=cls.__name__)
        at, error = HEADER_SIZE, 0
        if kind in {PduKind.ACK, PduKind.ACK_DATA}:
            at = REPLY_HEADER_SIZE
            if len(payload) >= at:
                (error,) = struct.unpack_from(">H", payload, HEADER_SIZE)
        middle, end = at + parameters, at + parameters + data
        if end > len(payload):
            raise TruncatedError(
                f"needs {end} bytes, but {len(payload)} follow", layout=cls.__name__
            )
        return cls(kind, reference, payload[at:middle], payload[middle:end], error)


class S7Item(NamedTuple):
    """Address of an item: *number* elements of type *transport_size* from bit *start* on."""

    area: int
    block: int
    start: int
    transport_size: int
    number: int

    @property
    def bits(self) -> int:
        """Number of bits, 0 for a type that is not known."""
        return self.number * _ELEMENT_BITS.get(self.transport_size, 0)

    @property
    def size(self) -> int:
        """Bytes of its data; a bit has one."""
        return -(-self.bits // 8)

    @property
    def is_bit(self) -> bool:
        """True for single bits."""
        return self.transport_size == TransportSize.BIT

    def encode(self) -> bytes:
        """Return the address."""
        # 0x12: specification of a variable, 0x0A: bytes that follow, 0x10: syntax S7ANY.
        place = self.start.to_bytes(3, "big")
        head = 0x12, 0x0A, 0x10, self.transport_size, self.number, self.block, self.area
        return struct.pack(">BBBBHHB", *head) + place


def data_item(area: int, block: int, first: int, bits: int) -> S7Item:
    """Return the item of *bits* bits from bit *first* on: a single bit, or whole bytes."""
    if bits == 1:
        return S7Item(area, block, first, TransportSize.BIT, 1)
    return S7Item(area, block, first, TransportSize.BYTE, bits // 8)


class ItemData(NamedTuple):
    """Data of an item, or the code of its error."""

    code: int
    data: bytes = b""


def packet_length(buffer: Buffer) -> int | None:
    """Return the length of the packet that *buffer* begins with, None if its header is not there.

    Raises:
        MalformedError: there is no packet, or it is too long.
    """
    if len(buffer) < TPKT_SIZE:
        return None
    # RFC 1006: version 3, a reserved byte, the length with this header.
    version, _, length = struct.unpack_from(">BBH", buffer)
    if version != 3 or not TPKT_SIZE < length <= MAX_TPKT:
        raise MalformedError(f"version {version}, {length} bytes", layout="TPKT")
    return int(length)


def encode_packet(payload: bytes) -> bytes:
    """Return a packet with a COTP packet in it."""
    return struct.pack(">BBH", 3, 0, TPKT_SIZE + len(payload)) + payload


def encode_data(pdu: S7Pdu) -> bytes:
    """Return the packet of an S7 PDU."""
    return encode_packet(_DT + pdu.encode())


class CotpConnect(NamedTuple):
    """Request or confirmation of a connection."""

    kind: int
    source: int
    destination: int = 0
    calling: bytes = b""
    """TSAP of the client."""
    called: bytes = b""
    tpdu_size: int = 1024

    def encode(self) -> bytes:
        """Return the packet."""
        # 0xC0: size of TPDUs as a power of 2; 0xC1 and 0xC2: calling and called TSAP (RFC 905).
        options = b"".join(
            bytes((code, len(data))) + data
            for code, data in (
                (0xC0, bytes((self.tpdu_size.bit_length() - 1,))),
                (0xC1, self.calling),
                (0xC2, self.called),
            )
            if data
        )
        fixed = struct.pack(">BHHB", self.kind, self.destination, self.source, 0)
        return encode_packet(bytes((len(fixed) + len(options),)) + fixed + options)


def decode_cotp(packet: bytes) -> CotpConnect | S7Pdu:
    """Read a packet: one that opens a connection, or data.

    Raises:
        CodecError: it is neither.
    """
    payload = packet[TPKT_SIZE:]
    if len(payload) < 3 or payload[0] + 1 > len(payload) or payload[0] < 2:
        raise TruncatedError(f"{len(payload)} bytes", layout="COTP")
    kind = payload[1] & 0xF0
    if kind == CotpKind.DATA:
        # The last bit of the number: S7 puts each PDU into one TPDU.
        if not payload[2] & 0x80:
            raise MalformedError("a PDU in several packets", layout="COTP")
        return S7Pdu.decode(payload[payload[0] + 1 :])
    if kind in {CotpKind.REQUEST, CotpKind.CONFIRM} and payload[0] >= 6:
        return _decode_connect(kind, payload)
    raise MalformedError(f"kind {payload[1]:#04x}", layout="COTP")


def _decode_connect(kind: int, payload: bytes) -> CotpConnect:
    destination, source = struct.unpack_from(">HH", payload, 2)
    options: dict[int, bytes] = {}
    at, end = 7, payload[0] + 1
    while at + 2 <= end:
        length = payload[at + 1]
        options[payload[at]] = payload[at + 2 : min(at + 2 + length, end)]
        at += 2 + length
    exponent = int.from_bytes(options.get(0xC0, b"")[:1], "big")
    # 128 to 8192 bytes; without the option it is 65531, which no client of S7 relies on.
    size = 1 << min(max(exponent, 7), 13) if exponent else 1024
    return CotpConnect(
        kind, source, destination, options.get(0xC1, b""), options.get(0xC2, b""), size
    )


def encode_setup(pdu_size: int, jobs: int = 1) -> bytes:
    """Return the parameters that propose, or confirm, the size of PDUs and the parallel jobs."""
    return struct.pack(">BBHHH", S7Function.SETUP, 0, jobs, jobs, pdu_size)


def decode_setup(parameters: bytes) -> int:
    """Return the size of PDUs in the parameters of a set-up; raise CodecError if they are none."""
    if len(parameters) < 8 or parameters[0] != S7Function.SETUP:
        raise MalformedError(f"parameters {parameters[:8].hex()}", layout="S7 setup")
    size: int = struct.unpack_from(">H", parameters, 6)[0]
    return size


def encode_items(function: S7Function, items: Sequence[S7Item]) -> bytes:
    """Return the parameters of a request for *items*."""
    return bytes((function, len(items))) + b"".join(item.encode() for item in items)


def decode_items(parameters: bytes) -> list[S7Item]:
    """Read the items of a request; an address of another form has type 0.

    Raises:
        CodecError: they are incomplete.
    """
    found: list[S7Item] = []
    at = 2
    for _ in range(parameters[1] if len(parameters) > 1 else 0):
        if at + 2 > len(parameters) or at + 2 + parameters[at + 1] > len(parameters):
            raise TruncatedError(f"item {len(found) + 1} is cut off", layout="S7 items")
        length = parameters[at + 1]
        if parameters[at] == 0x12 and length == ITEM_SIZE - 2 and parameters[at + 2] == 0x10:
            transport_size, count, block, area = struct.unpack_from(">BHHB", parameters, at + 3)
            start = int.from_bytes(parameters[at + 9 : at + 12], "big")
            found.append(S7Item(area, block, start, transport_size, count))
        else:
            found.append(S7Item(0, 0, 0, 0, 0))
        at += 2 + length
    return found


def encode_item_data(
    items: Sequence[tuple[S7Item, ItemData]], *, is_request: bool = False
) -> bytes:
    """Return the data of items: of a reply to a read, or of a request to write."""
    out = bytearray()
    for item, (code, data) in items:
        # Every item starts at an even byte.
        out += bytes(len(out) % 2)
        if code != ItemCode.DONE:
            out += bytes((code, 0, 0, 0))
            continue
        # A bit takes a whole byte, but its length is that of one bit.
        kind, length = (_DATA_BIT, len(data)) if item.is_bit else (_DATA_BYTES, 8 * len(data))
        out += struct.pack(">BBH", 0 if is_request else code, kind, length) + data
    return bytes(out)


def decode_item_data(data: bytes, count: int) -> list[ItemData]:
    """Read the data of *count* items; raise CodecError if there are fewer."""
    found: list[ItemData] = []
    at = 0
    for number in range(count):
        at += at % 2
        if at + 4 > len(data):
            raise TruncatedError(f"item {number + 1} of {count} is missing", layout="S7 data")
        code, kind, length = struct.unpack_from(">BBH", data, at)
        size = -(-length // 8) if kind in _IN_BITS and kind != _DATA_BIT else length
        at += 4
        # An item with an error has no data, whatever its length says.
        if kind and at + size > len(data):
            raise TruncatedError(f"item {number + 1} of {count} is cut off", layout="S7 data")
        if not kind:
            size = 0
        found.append(ItemData(code, data[at : at + size]))
        at += size
    return found
