"""SDO messages: what follows the CoE header of an SDO request, response or abort (ETG.1000.6).

An SDO goes *expedited* (up to 4 octets, within the header), *normal* (all data in one message) or
*segmented* (the rest in messages with a toggle bit).  Nothing here knows more than one message.
"""

from __future__ import annotations

import struct
from enum import IntEnum

from eap.codec.coe import CoeService, encode_message
from eap.codec.wire import Buffer, WireStruct, bit, bits2, bits3, u8, u16, u32

EXPEDITED_SIZE = 4
"""Octets that fit into the header of an SDO."""
INITIATE_OVERHEAD = 16
"""Octets of a mailbox that the first message of a normal SDO takes before its data."""
SEGMENT_OVERHEAD = 9
"""Octets of a mailbox that a segment takes before its data."""
SEGMENT_MINIMUM = 7
"""Octets of a segment at least; in one with fewer the rest is padding."""


class SdoRequest(IntEnum):
    """Client command specifier: bits 5 to 7 of the first octet of a request."""

    DOWNLOAD_SEGMENT = 0
    DOWNLOAD = 1
    UPLOAD = 2
    UPLOAD_SEGMENT = 3
    ABORT = 4


class SdoResponse(IntEnum):
    """Server command specifier: bits 5 to 7 of the first octet of a response."""

    UPLOAD_SEGMENT = 0
    DOWNLOAD_SEGMENT = 1
    UPLOAD = 2
    DOWNLOAD = 3
    ABORT = 4


class SdoHeader(WireStruct, frozen=True):
    """ETG.1000.6, initiate and abort SDO.

    *value* is the data of an expedited SDO, the size of a normal one or the code of an abort.  In
    an expedited SDO *unused* of its octets do not count, unless *has_size* is 0: then nobody said.
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
"""The octets of a header in front of its value, for what is sent most, in one step."""
_EXPEDITED = 0b11
"""With data in the header, of which the size is said."""


class SdoSegmentHeader(WireStruct, frozen=True):
    """ETG.1000.6, SDO segment: *unused* counts only where fewer than 7 octets of data follow."""

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
    room: int = 0,
) -> bytes:
    """Return the first message of a transfer that carries data, without CoE header.

    One to four octets go expedited; else the size, and as many octets of *data* as *room* allows.
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
    return head.encode() + bytes(data[:room])


def encode_plain(
    specifier: SdoRequest | SdoResponse, index: int, subindex: int, *, complete: bool = False
) -> bytes:
    """Return a message without data: an upload request, or the response to a download."""
    return SdoHeader(0, 0, 0, complete, specifier, index, subindex).encode()


def encode_segment(
    specifier: SdoRequest | SdoResponse, data: Buffer = b"", *, toggle: int, last: bool = False
) -> bytes:
    """Return a segment that carries *data*."""
    unused = max(0, SEGMENT_MINIMUM - len(data))
    head = SdoSegmentHeader(last, unused, toggle, specifier)
    return head.encode() + bytes(data) + bytes(unused)


def encode_segment_answer(specifier: SdoRequest | SdoResponse, *, toggle: int) -> bytes:
    """Return what asks for a segment, or confirms one."""
    return SdoSegmentHeader(toggle=toggle, specifier=specifier).encode() + bytes(SEGMENT_MINIMUM)


def decode_segment(body: Buffer) -> tuple[SdoSegmentHeader, bytes]:
    """Return header and data of a segment; raise TruncatedError if it is empty."""
    head = SdoSegmentHeader.decode(body)
    data = bytes(body[SdoSegmentHeader.SIZE :])
    if len(data) <= SEGMENT_MINIMUM:
        data = data[: SEGMENT_MINIMUM - head.unused]
    return head, data


def encode_abort(index: int, subindex: int, code: int) -> bytes:
    """Return the data of a mailbox message that aborts a transfer, from either side."""
    head = SdoHeader(0, 0, 0, 0, SdoRequest.ABORT, index, subindex, code)
    return encode_message(CoeService.SDO_REQUEST, head.encode())
