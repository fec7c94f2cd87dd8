"""Mailbox messages: the common header, the error reply and the header of VoE.

The same message travels in a slave's mailbox and, behind a frame header of type 5, between
stations and to a mailbox gateway (ETG.8200).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Annotated

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.wire import Bits, Buffer, WireStruct, bit, bits2, bits3, bits6, u16, u32
from eap.errors import MalformedError, TruncatedError


class MailboxType(IntEnum):
    """Protocol of the data of a message (ETG.1000.4, mailbox header)."""

    ERR = 0
    AOE = 1
    EOE = 2
    COE = 3
    FOE = 4
    SOE = 5
    VOE = 15

    __hash__ = int.__hash__  # that of enums is slow

    @property
    def title(self) -> str:
        """The protocol as people write it, ``CoE``."""
        return "error" if self is MailboxType.ERR else self.name.replace("O", "o")


class MailboxHeader(WireStruct, frozen=True):
    """ETG.1000.4: the six bytes in front of every mailbox message.

    *address* is a slave's station address, 0 the master or station itself.  *counter* runs from 1
    to 7 and detects repeats; 0 means no detection.
    """

    length: u16
    address: u16 = 0
    channel: bits6 = 0
    priority: bits2 = 0
    type: Annotated[MailboxType, Bits(4, MailboxType)] = MailboxType.ERR
    counter: bits3 = 0
    # Newer Wireshark shows it as the mark of an error: accepted when received, never sent.
    reserved: bit = 0


class MailboxError(IntEnum):
    """Reason a message is refused (ETG.1000.4, mailbox error reply)."""

    SYNTAX = 1
    UNSUPPORTED_PROTOCOL = 2
    INVALID_CHANNEL = 3
    SERVICE_NOT_SUPPORTED = 4
    INVALID_HEADER = 5
    SIZE_TOO_SHORT = 6
    NO_MORE_MEMORY = 7
    INVALID_SIZE = 8
    SERVICE_IN_WORK = 9

    @classmethod
    def name_of(cls, detail: int) -> str:
        """Return the name of a detail code, or its number for an undocumented one."""
        return cls(detail).name if detail in cls._value2member_map_ else f"0x{detail:04x}"

    @classmethod
    def text_of(cls, detail: int) -> str:
        """Return the name of a detail code and what it means, or its number."""
        meaning = _MEANINGS.get(detail)
        return cls.name_of(detail) + (f", {meaning}" if meaning else "")


_MEANINGS: dict[int, str] = {
    MailboxError.SYNTAX: "it cannot read the mailbox header",
    MailboxError.UNSUPPORTED_PROTOCOL: "it does not speak this protocol, or not in its state",
    MailboxError.INVALID_CHANNEL: "the channel is wrong",
    MailboxError.SERVICE_NOT_SUPPORTED: "it does not offer this service",
    MailboxError.INVALID_HEADER: "it cannot read the header of the protocol",
    MailboxError.SIZE_TOO_SHORT: "the message is too short",
    MailboxError.NO_MORE_MEMORY: "it is out of memory",
    MailboxError.INVALID_SIZE: "the length of the message is wrong",
    MailboxError.SERVICE_IN_WORK: "it is still busy with an earlier request",
}

ERROR_REPLY = 1
"""The only kind of message that the standard knows behind type 0."""


class MailboxErrorReply(WireStruct, frozen=True):
    """ETG.1000.4: the data of a message of type 0; *detail* as :class:`MailboxError`."""

    detail_type: u16 = ERROR_REPLY
    detail: u16 = MailboxError.SYNTAX


def decode_message(data: Buffer, offset: int = 0) -> tuple[MailboxHeader, memoryview]:
    """Return header and data of the message at *offset*; surplus bytes behind it are ignored.

    Raises:
        TruncatedError: fewer bytes follow than the header says.
        MalformedError: the protocol is unknown.
    """
    header = MailboxHeader.decode(data, offset)
    start = offset + MailboxHeader.SIZE
    body = memoryview(data)[start : start + header.length]
    if len(body) < header.length:
        raise TruncatedError(
            f"length {header.length}, but {len(body)} bytes follow",
            layout="MailboxHeader",
            offset=offset,
        )
    return header, body


def decode_frame(data: Buffer) -> tuple[MailboxHeader, memoryview]:
    """Return header and data of the message in a whole frame of type 5.

    Raises:
        TruncatedError: the frame is shorter than its Length, or its message than its length.
        MalformedError: the frame is of another type, or its protocol is unknown.
    """
    if len(data) >= _HEADS.size:  # the usual frame in one step
        word, size, address, channel, kind = _HEADS.unpack_from(data)
        end, protocol = _HEADS.size + size, _TYPES.get(kind & _TYPE_MASK)
        whole = EtherCatHeader.SIZE + (word & _LENGTH_MASK)
        if word >> _TYPE_AT == _MAILBOX and end <= whole <= len(data) and protocol is not None:
            header = MailboxHeader(
                size,
                address,
                channel & 0x3F,
                channel >> 6,
                protocol,
                kind >> _COUNTER_AT & 7,
                kind >> 7,
            )
            return header, memoryview(data)[_HEADS.size : end]
    ethercat = EtherCatHeader.decode(data)
    if ethercat.type != FrameType.MAILBOX:
        raise MalformedError(f"frame type {ethercat.type}, expected 5", layout="EtherCatHeader")
    end = EtherCatHeader.SIZE + ethercat.length
    if end > len(data):
        raise TruncatedError(
            f"length {ethercat.length}, but {len(data) - EtherCatHeader.SIZE} bytes follow",
            layout="EtherCatHeader",
        )
    return decode_message(memoryview(data)[:end], EtherCatHeader.SIZE)


def encode_message(header: MailboxHeader, body: Buffer) -> bytes:
    """Return a whole message; the length is set from *body*."""
    return MailboxHeader(
        len(body),
        header.address,
        header.channel,
        header.priority,
        header.type,
        header.counter,
        header.reserved,
    ).encode() + bytes(body)


def encode_frame(header: MailboxHeader, body: Buffer) -> bytes:
    """Return a whole frame of type 5; the lengths are set from *body*.

    Raises CodecError if *body* is too long for the 11 bits of the frame's Length (2041 bytes).
    """
    message = encode_message(header, body)
    return EtherCatHeader(len(message), type=FrameType.MAILBOX).encode() + message


def encode_plain_frame(kind: MailboxType, address: int, counter: int, body: bytes) -> bytes:
    """Return a whole frame of type 5, in channel 0 and without priority.

    This does in one step what :func:`encode_frame` does, and raises the same.
    """
    size = len(body)
    length = size + MailboxHeader.SIZE
    if length >> _LENGTH_BITS:
        return encode_frame(MailboxHeader(0, address, type=kind, counter=counter), body)
    # Both headers in one pack: a station does this for each AMS packet of type 5.
    word = length | _MAILBOX << _TYPE_AT
    return _HEADS.pack(word, size, address, 0, kind | counter << _COUNTER_AT) + body


def aoe_packet_in(data: Buffer) -> bytes | None:
    """Return the AMS packet in a whole frame of type 5 to address 0, None for any other frame.

    What is wrong with a frame, :func:`decode_frame` says.
    """
    if len(data) < _HEADS.size:
        return None
    word, size, address, _, kind = _HEADS.unpack_from(data)
    end = _HEADS.size + size
    if (
        word >> _TYPE_AT != _MAILBOX
        or kind & _TYPE_MASK != _AOE
        or address
        or end > EtherCatHeader.SIZE + (word & _LENGTH_MASK)
        or end > len(data)
    ):
        return None
    return bytes(data[_HEADS.size : end])


_HEADS = struct.Struct("<HHHBB")
"""Both headers: Length and Type of the frame; length, address, channel and priority, type and
counter of the message."""
_MAILBOX, _AOE = FrameType.MAILBOX.value, MailboxType.AOE.value  # members of enums are slow
_LENGTH_BITS, _TYPE_AT = 11, 12
_LENGTH_MASK = (1 << _LENGTH_BITS) - 1
_TYPE_MASK, _COUNTER_AT = 0x0F, 4
_TYPES = {each.value: each for each in MailboxType}


class VoeHeader(WireStruct, frozen=True):
    """ETG.1000.6, VoE header: vendor and protocol of the data behind it."""

    vendor_id: u32
    vendor_type: u16
