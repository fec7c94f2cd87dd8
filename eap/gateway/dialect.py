"""Codec of the high-nibble dialect: messages of published clients of one vendor's ETG.8200 gateway.

Its messages carry the type in the high nibble of the sixth byte, where the standard has the
counter, and nothing in the low one, which in the standard would be a mailbox error; so no request
of one can be taken for one of the other.  SoE is 4 and FoE is 5 there.  Requests name one thing to
be done, in shorter layouts than the standard's, and files go in one packet.

The layouts of answers are our own choice: that vendor's page shows none.
"""

from __future__ import annotations

from enum import IntEnum
from typing import TypeAlias

import msgspec

from eap.codec.coe import (
    CoeHeader,
    CoeService,
    SdoHeader,
    SdoRequest,
    SdoResponse,
    encode_abort,
    encode_initiate,
    encode_plain,
)
from eap.codec.coe import encode_message as encode_coe
from eap.codec.foe import FoeOpcode, text_of
from eap.codec.mailbox import MailboxHeader, MailboxType, VoeHeader
from eap.codec.soe import Element, SoeHeader, SoeOpcode
from eap.errors import MalformedError

_TYPES = {
    3: MailboxType.COE,
    4: MailboxType.SOE,
    5: MailboxType.FOE,
    15: MailboxType.VOE,
}
_NUMBERS = {kind: number for number, kind in _TYPES.items()}
_FOE_HEADER = 5
_SOE_READ, _SOE_WRITE = 1, 2
_SOE_ERROR = 0x10
"""As in an answer of the standard."""
_ELEMENTS = (
    Element.NAME,
    Element.ATTRIBUTE,
    Element.UNIT,
    Element.MINIMUM,
    Element.MAXIMUM,
    Element.VALUE,
    Element.DEFAULT,
    Element.ATTRIBUTE,
)
"""By its number in a request; the data type, 7, is a part of the attribute."""
_SDO_BODY = CoeHeader.SIZE + 4
_HIGH_BIT = 8


class ReadSdo(msgspec.Struct, frozen=True):
    """Upload an entry."""

    index: int
    subindex: int
    complete: bool


class WriteSdo(msgspec.Struct, frozen=True):
    """Download an entry."""

    index: int
    subindex: int
    data: bytes


class ReadIdn(msgspec.Struct, frozen=True):
    """Read an element of an IDN."""

    idn: int
    drive: int
    element: Element


class WriteIdn(msgspec.Struct, frozen=True):
    """Write an element of an IDN."""

    idn: int
    drive: int
    element: Element
    data: bytes


class ReadFile(msgspec.Struct, frozen=True):
    """Read a whole file."""

    name: str


class ExchangeVoe(msgspec.Struct, frozen=True):
    """Hand a message of a vendor's protocol on."""

    body: bytes


Task: TypeAlias = ReadSdo | WriteSdo | ReadIdn | WriteIdn | ReadFile | ExchangeVoe


class DialectFailure(IntEnum):
    """Reason why a task was not carried out; each protocol has codes of its own for it."""

    GENERAL = 0
    MISSING = 1
    """Object, IDN, file, or the slave itself."""
    NOT_SUPPORTED = 2
    """The protocol, or this use of it."""
    READ_ONLY = 3
    COMMAND = 4
    """An unknown command."""
    SIZE = 5
    NO_RESPONSE = 6
    FILE_NAME = 7


# Other meanings than in the standard: SoE 0x1009 is a missing IDN, FoE 0x8002 a missing file.
_CODES: dict[MailboxType, dict[DialectFailure, int]] = {
    MailboxType.COE: {
        DialectFailure.GENERAL: 0x08000000,
        DialectFailure.MISSING: 0x06020000,
        DialectFailure.NOT_SUPPORTED: 0x06010000,
        DialectFailure.READ_ONLY: 0x06010002,
        DialectFailure.COMMAND: 0x05040001,
    },
    MailboxType.SOE: {
        DialectFailure.GENERAL: 0x8000,
        DialectFailure.MISSING: 0x1009,
        DialectFailure.NOT_SUPPORTED: 0x8001,
        DialectFailure.READ_ONLY: 0x7002,
        DialectFailure.COMMAND: 0x1001,
        DialectFailure.SIZE: 0x3002,
    },
    MailboxType.FOE: {
        DialectFailure.GENERAL: 0x8000,
        DialectFailure.MISSING: 0x8002,
        DialectFailure.NOT_SUPPORTED: 0x8001,
        DialectFailure.COMMAND: 0x8001,
        DialectFailure.FILE_NAME: 0x8003,
    },
    MailboxType.VOE: {
        DialectFailure.GENERAL: 0,
        DialectFailure.NOT_SUPPORTED: 1,
        DialectFailure.COMMAND: 2,
        DialectFailure.SIZE: 2,
        DialectFailure.NO_RESPONSE: 3,
    },
}


def kind_of(header: MailboxHeader) -> MailboxType | None:
    """Return the protocol of a message in the dialect, None for one of the standard."""
    if header.type is not MailboxType.ERR:
        return None
    # The high nibble is what the standard reads as counter and reserved bit.
    return _TYPES.get(header.counter | (_HIGH_BIT if header.reserved else 0))


def encode_header(kind: MailboxType, address: int) -> MailboxHeader:
    """Return the header of an answer; its length is set when it is encoded."""
    number = _NUMBERS[kind]
    high = number & (_HIGH_BIT - 1)
    return MailboxHeader(0, address, counter=high, reserved=number // _HIGH_BIT)


def decode(kind: MailboxType, body: bytes) -> Task:
    """Decode a request into its operation.

    Raises:
        MalformedError: it is none of the dialect; the text says what was expected.
    """
    return _DECODERS[kind](body)


def _decode_coe(body: bytes) -> Task:
    # These clients send uploads of eight bytes, without the last two of the standard's ten.
    if len(body) < _SDO_BODY:
        raise _short("CoE", body, _SDO_BODY)
    command, index, subindex = body[2], int.from_bytes(body[3:5], "little"), body[5]
    if body[1] >> 4 != CoeService.SDO_REQUEST:
        raise MalformedError(f"CoE service {body[1] >> 4}, expected 2", layout="dialect")
    specifier = command >> 5
    if specifier == SdoRequest.UPLOAD:
        return ReadSdo(index, subindex, complete=bool(command & 0x10))
    if specifier != SdoRequest.DOWNLOAD:
        raise MalformedError(f"SDO command 0x{command:02x}", layout="dialect")
    data = body[_SDO_BODY:]
    if command & 0x0F:  # as the standard writes it: expedited, or with its size in front
        least = CoeHeader.SIZE + SdoHeader.SIZE
        if len(body) < least:
            raise _short("CoE", body, least)
        head = SdoHeader.decode(body, CoeHeader.SIZE)
        data = head.data if head.expedited else body[least:]
    if not data:
        raise MalformedError("a download without data", layout="dialect")
    return WriteSdo(index, subindex, data)


def _decode_soe(body: bytes) -> Task:
    if len(body) < SoeHeader.SIZE:
        raise _short("SoE", body, SoeHeader.SIZE)
    # The element is a number here, and the drive is above it; the standard has a mask of elements.
    element = body[1] & 0x07
    drive, idn = body[1] >> 3, int.from_bytes(body[2:4], "little")
    if drive > 7:
        raise MalformedError(f"drive {drive}, expected 0 to 7", layout="dialect")
    if body[0] == _SOE_READ:
        return ReadIdn(idn, drive, _ELEMENTS[element])
    if body[0] == _SOE_WRITE:
        return WriteIdn(idn, drive, _ELEMENTS[element], body[SoeHeader.SIZE :])
    raise MalformedError(f"SoE command {body[0]}, expected 1 or 2", layout="dialect")


def _decode_foe(body: bytes) -> Task:
    if len(body) < _FOE_HEADER:
        raise _short("FoE", body, _FOE_HEADER)
    if body[0] != FoeOpcode.READ:
        raise MalformedError(
            f"FoE opcode {body[0]}: only whole files are read in this dialect", layout="dialect"
        )
    return ReadFile(text_of(body[_FOE_HEADER:]))


def _decode_voe(body: bytes) -> Task:
    if len(body) < VoeHeader.SIZE:
        raise _short("VoE", body, VoeHeader.SIZE)
    return ExchangeVoe(body)


_DECODERS = {
    MailboxType.COE: _decode_coe,
    MailboxType.SOE: _decode_soe,
    MailboxType.FOE: _decode_foe,
    MailboxType.VOE: _decode_voe,
}


def encode_done(request: bytes, task: Task, data: bytes) -> bytes:
    """Return the reply to a task that was carried out; *data* is the data read."""
    match task:
        case ReadSdo(index, subindex, complete):
            body = encode_initiate(
                SdoResponse.UPLOAD, index, subindex, data, complete=complete, max_size=len(data)
            )
            return encode_coe(CoeService.SDO_RESPONSE, body)
        case WriteSdo(index, subindex, _):
            body = encode_plain(SdoResponse.DOWNLOAD, index, subindex)
            return encode_coe(CoeService.SDO_RESPONSE, body)
        case ReadIdn():
            return _soe_head(request, SoeOpcode.READ_RESPONSE) + data
        case WriteIdn():
            return _soe_head(request, SoeOpcode.WRITE_RESPONSE)
        case ReadFile():
            return bytes((FoeOpcode.DATA, 0, 0, 0, 0)) + data
    return data


def encode_failure(
    kind: MailboxType,
    request: bytes,
    failure: DialectFailure,
    *,
    code: int | None = None,
    text: str = "",
) -> bytes:
    """Return the error reply to a task that was not carried out.

    Args:
        kind: The protocol.
        request: Its bytes.
        failure: Why.
        code: What the slave itself says, for protocols whose codes both sides share.
        text: For people, where the protocol has room for it.
    """
    codes = _CODES[kind]
    number = codes.get(failure, codes[DialectFailure.GENERAL]) if code is None else code
    match kind:
        case MailboxType.COE:
            index = int.from_bytes(request[3:5], "little")
            return encode_abort(index, request[5] if len(request) > 5 else 0, number)
        case MailboxType.SOE:
            is_write = request[:1] == bytes((_SOE_WRITE,))
            opcode = SoeOpcode.WRITE_RESPONSE if is_write else SoeOpcode.READ_RESPONSE
            return _soe_head(request, opcode | _SOE_ERROR) + number.to_bytes(2, "little")
        case MailboxType.FOE:
            text_bytes = text.encode() + b"\0" if text else b""
            return bytes((FoeOpcode.ERROR, 0, 0, 0, 0)) + number.to_bytes(4, "little") + text_bytes
    return request[: VoeHeader.SIZE].ljust(VoeHeader.SIZE, b"\0") + number.to_bytes(4, "little")


def _soe_head(request: bytes, opcode: int) -> bytes:
    return bytes((opcode,)) + request[1 : SoeHeader.SIZE].ljust(SoeHeader.SIZE - 1, b"\0")


def _short(protocol: str, body: bytes, least: int) -> MalformedError:
    text = f"{protocol} request of {len(body)} bytes, expected at least {least}"
    return MalformedError(text, layout="dialect")
