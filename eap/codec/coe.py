"""CoE messages: the CoE header, SDO services and SDO information (ETG.1000.6).

An SDO goes *expedited* (up to 4 bytes, within the header), *normal* (all data in one message) or
*segmented* (the rest in messages with a toggle bit).  Nothing here knows more than one message.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Annotated, Self

import msgspec

from eap.codec.wire import Bits, Buffer, Scalar, WireStruct, bit, bits2, bits3, u8, u16, u32
from eap.errors import TruncatedError


class CoeService(IntEnum):
    """ETG.1000.6, CoE header: what a message is."""

    EMERGENCY = 1
    SDO_REQUEST = 2
    SDO_RESPONSE = 3
    TX_PDO = 4
    RX_PDO = 5
    TX_PDO_REMOTE_REQUEST = 6
    RX_PDO_REMOTE_REQUEST = 7
    SDO_INFORMATION = 8


_TITLES = {
    CoeService.EMERGENCY: "emergency",
    CoeService.SDO_REQUEST: "SDO request",
    CoeService.SDO_RESPONSE: "SDO response",
    CoeService.TX_PDO: "TxPDO",
    CoeService.RX_PDO: "RxPDO",
    CoeService.TX_PDO_REMOTE_REQUEST: "TxPDO remote request",
    CoeService.RX_PDO_REMOTE_REQUEST: "RxPDO remote request",
    CoeService.SDO_INFORMATION: "SDO information",
}
PDO_SERVICES = frozenset(
    (
        CoeService.TX_PDO,
        CoeService.RX_PDO,
        CoeService.TX_PDO_REMOTE_REQUEST,
        CoeService.RX_PDO_REMOTE_REQUEST,
    )
)
"""Services of PDOs in the mailbox, whose header has the number of one."""


_PDO_NUMBER = 0x01FF
"""Bits of the header."""


def title_of(service: int) -> str:
    """Return the name of a service, which a peer may have invented."""
    return _TITLES[CoeService(service)] if service in _TITLES else f"unknown service {service}"


class CoeHeader(WireStruct, frozen=True):
    """ETG.1000.6: the two bytes behind the mailbox header; *number* is that of a PDO, else 0."""

    number: Annotated[int, Bits(9)] = 0
    reserved: bits3 = 0
    service: Annotated[CoeService, Bits(4, CoeService)] = CoeService.SDO_REQUEST


class Emergency(WireStruct, frozen=True):
    """ETG.1000.6: what a slave reports unasked; *error_code* 0 takes an error back."""

    error_code: u16
    error_register: u8 = 0
    data: Annotated[bytes, Scalar("5s")] = bytes(5)


def decode_message(data: Buffer) -> tuple[CoeHeader, memoryview]:
    """Return header and body of the data of a mailbox message.

    Raises:
        TruncatedError: it is shorter than the header.
        MalformedError: the service is unknown.
    """
    return CoeHeader.decode(data), memoryview(data)[CoeHeader.SIZE :]


def encode_message(service: CoeService, body: Buffer, *, number: int = 0) -> bytes:
    """Return the data of a mailbox message."""
    head = CoeHeader(number, service=service).encode() if number else _PLAIN_HEADERS[service]
    return head + body


_PLAIN_HEADERS = [bytes((0, number << 4)) for number in range(16)]
"""By service, without a number."""


EXPEDITED_SIZE = 4
"""Bytes that fit into the header of an SDO."""
INITIATE_OVERHEAD = 16
"""Bytes of a mailbox that the first message of a normal SDO takes before its data."""
SEGMENT_OVERHEAD = 9
"""Bytes of a mailbox that a segment takes before its data."""
SEGMENT_MINIMUM = 7
"""Bytes of a segment at least; in one with fewer the rest is padding."""


class SdoRequest(IntEnum):
    """Client command specifier: bits 5 to 7 of the first byte of a request."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    ABORT = 4


class SdoResponse(IntEnum):
    """Server command specifier: bits 5 to 7 of the first byte of a response."""

    UPLOAD_SEGMENT = 0
    DOWNLOAD_SEGMENT = 1
    UPLOAD = 2
    DOWNLOAD = 3
    ABORT = 4


class SdoHeader(WireStruct, frozen=True):
    """ETG.1000.6, initiate and abort SDO.

    *value* is the data of an expedited SDO, the size of a normal one or the code of an abort.  In
    an expedited SDO *unused* of its bytes do not count, unless *has_size* is 0.
    """

    has_size: bit
    expedited: bit
    unused: bits2
    complete: bit
    specifier: bits3
    index: u16
    subindex: u8
    value: u32 = 0

    @property
    def data(self) -> bytes:
        """The data of an expedited SDO."""
        size = EXPEDITED_SIZE - (self.unused if self.has_size else 0)
        return self.value.to_bytes(EXPEDITED_SIZE, "little")[:size]


_HEAD = struct.Struct("<BHB")
"""The bytes of a header in front of its value, for what is sent most, in one step."""
_EXPEDITED = 0b11
"""With data in the header, of which the size is said."""


_COMPLETE = 0x10


def decode_upload(request: Buffer) -> tuple[int, int, bool]:
    """Return index, subindex and complete access of an upload request without CoE header.

    This does in one step what :class:`SdoHeader` does, for what is received most.  The request has
    four bytes or more.
    """
    command, index, subindex = _HEAD.unpack_from(request)
    return index, subindex, bool(command & _COMPLETE)


class SdoSegmentHeader(WireStruct, frozen=True):
    """ETG.1000.6, SDO segment: *unused* counts only where fewer than 7 bytes of data follow."""

    last: bit = 0
    unused: bits3 = 0
    toggle: bit = 0
    specifier: bits3 = 0


def encode_initiate(
    specifier: SdoRequest | SdoResponse,
    index: int,
    subindex: int,
    data: Buffer = b"",
    *,
    complete: bool = False,
    max_size: int = 0,
) -> bytes:
    """Return the first message of a transfer that carries data, without CoE header.

    One to four bytes go expedited; else the size, and as many bytes of *data* as *max_size* allows.
    """
    size = len(data)
    if 0 < size <= EXPEDITED_SIZE:
        unused = EXPEDITED_SIZE - size
        if index <= 0xFFFF and subindex <= 0xFF:  # the usual one in one step
            command = _EXPEDITED | unused << 2 | complete << 4 | specifier << 5
            return _HEAD.pack(command, index, subindex) + bytes(data).ljust(EXPEDITED_SIZE, b"\0")
        value = int.from_bytes(data, "little")
        return SdoHeader(1, 1, unused, complete, specifier, index, subindex, value).encode()
    head = SdoHeader(1, 0, 0, complete, specifier, index, subindex, size)
    return head.encode() + bytes(data[:max_size])


def encode_plain(
    specifier: SdoRequest | SdoResponse, index: int, subindex: int, *, complete: bool = False
) -> bytes:
    """Return a message without data: an upload request, or the response to a download."""
    return SdoHeader(0, 0, 0, complete, specifier, index, subindex).encode()


def encode_segment(
    specifier: SdoRequest | SdoResponse, data: Buffer = b"", *, toggle: int, last: bool = False
) -> bytes:
    """Return a segment that carries *data*."""
    # Segments have at least seven bytes of data; *unused* counts the padding.
    unused = max(0, SEGMENT_MINIMUM - len(data))
    head = SdoSegmentHeader(last, unused, toggle, specifier)
    return head.encode() + bytes(data) + bytes(unused)


def encode_segment_answer(specifier: SdoRequest | SdoResponse, *, toggle: int) -> bytes:
    """Return the request for a segment, or its confirmation."""
    return SdoSegmentHeader(toggle=toggle, specifier=specifier).encode() + bytes(SEGMENT_MINIMUM)


def decode_segment(body: Buffer) -> tuple[SdoSegmentHeader, bytes]:
    """Return header and data of a segment; raise TruncatedError if it is empty."""
    head = SdoSegmentHeader.decode(body)
    data = bytes(body[SdoSegmentHeader.SIZE :])
    # In a longer segment *unused* has no meaning (ETG.1000.6, SDO segment).
    if len(data) <= SEGMENT_MINIMUM:
        data = data[: SEGMENT_MINIMUM - head.unused]
    return head, data


def encode_abort(index: int, subindex: int, code: int) -> bytes:
    """Return the data of a mailbox message that aborts a transfer, from either side."""
    # Either side aborts with the service SDO request, never with SDO response.
    head = SdoHeader(0, 0, 0, 0, SdoRequest.ABORT, index, subindex, code)
    return encode_message(CoeService.SDO_REQUEST, head.encode())


class SdoInfoOpcode(IntEnum):
    """ETG.1000.6, SDO information header: kind of the message."""

    LIST_REQUEST = 1
    LIST_RESPONSE = 2
    OBJECT_REQUEST = 3
    OBJECT_RESPONSE = 4
    ENTRY_REQUEST = 5
    ENTRY_RESPONSE = 6
    ERROR = 7


class SdoInfoHeader(WireStruct, frozen=True):
    """ETG.1000.6: the four bytes behind the CoE header of every SDO information message."""

    opcode: Annotated[SdoInfoOpcode, Bits(7, SdoInfoOpcode)]
    incomplete: bit = 0
    reserved: u8 = 0
    fragments_left: u16 = 0


class ListRequest(WireStruct, frozen=True):
    """ETG.1000.6, get OD list: which of the lists."""

    list_type: u16


class ObjectRequest(WireStruct, frozen=True):
    """ETG.1000.6, get object description."""

    index: u16


class EntryRequest(WireStruct, frozen=True):
    """ETG.1000.6, get entry description; *value_info* says what it is to hold."""

    index: u16
    subindex: u8
    value_info: u8


class InfoError(WireStruct, frozen=True):
    """ETG.1000.6, SDO information error."""

    abort_code: u32


class _ObjectHead(WireStruct, frozen=True):
    index: u16
    data_type: u16
    max_subindex: u8
    code: u8


class ObjectDescription(msgspec.Struct, frozen=True):
    """One object, as its server describes it."""

    index: int
    data_type: int
    max_subindex: int
    code: int
    name: str

    @classmethod
    def decode(cls, body: Buffer) -> Self:
        """Read the body of an answer; raise TruncatedError if it is too short."""
        head = _ObjectHead.decode(body)
        name = _text(body[_ObjectHead.SIZE :])
        return cls(head.index, head.data_type, head.max_subindex, head.code, name)


class _EntryDescriptionHead(WireStruct, frozen=True):
    index: u16
    subindex: u8
    value_info: u8
    data_type: u16
    bit_length: u16
    access: u16


class EntryDescription(msgspec.Struct, frozen=True):
    """One entry, as its server describes it; None where it says nothing."""

    index: int
    subindex: int
    data_type: int
    bit_length: int
    access: int
    name: str
    unit: int | None = None
    default: bytes | None = None
    minimum: bytes | None = None
    maximum: bytes | None = None

    @classmethod
    def decode(cls, body: Buffer) -> Self:
        """Read the body of an answer; raise TruncatedError if it is too short."""
        head = _EntryDescriptionHead.decode(body)
        size = (head.bit_length + 7) // 8
        offset = _EntryDescriptionHead.SIZE
        parts: list[bytes | None] = []
        # In the order of the flags; access rights, category and mapping (bits 0 to 2) add no data.
        for flag, length in ((0x08, 4), (0x10, size), (0x20, size), (0x40, size)):
            if not head.value_info & flag:
                parts.append(None)
                continue
            parts.append(bytes(body[offset : offset + length]))
            offset += length
        if offset > len(body):
            raise TruncatedError(
                f"value info 0x{head.value_info:02x} needs {offset} bytes, these are {len(body)}",
                layout="EntryDescription",
            )
        unit = None if parts[0] is None else int.from_bytes(parts[0], "little")
        fixed = (head.index, head.subindex, head.data_type, head.bit_length, head.access)
        return cls(*fixed, _text(body[offset:]), unit, *parts[1:])


def _text(octets: Buffer) -> str:
    # Names end with the message; a NUL that a peer adds is no part of them.
    return bytes(octets).rstrip(b"\0").decode(errors="replace")


def describe_message(data: Buffer) -> str:
    """Return service and PDO number of a CoE message in words; empty if it has no header."""
    if len(data) < CoeHeader.SIZE:
        return ""
    service, number = data[1] >> 4, int.from_bytes(data[:2], "little") & _PDO_NUMBER
    title = title_of(service)
    return f"{title} {number}" if service in PDO_SERVICES else title
