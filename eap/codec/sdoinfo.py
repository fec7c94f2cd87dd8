"""SDO information: how a client learns what a dictionary holds (ETG.1000.6)."""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated, Self

import msgspec

from eap.codec.wire import Bits, Buffer, WireStruct, bit, u8, u16, u32
from eap.errors import TruncatedError


class SdoInfoOpcode(IntEnum):
    """ETG.1000.6, SDO information header: what is asked or answered."""

    LIST_REQUEST = 1
    LIST_RESPONSE = 2
    OBJECT_REQUEST = 3
    OBJECT_RESPONSE = 4
    ENTRY_REQUEST = 5
    ENTRY_RESPONSE = 6
    ERROR = 7


class SdoInfoHeader(WireStruct, frozen=True):
    """ETG.1000.6: the four octets behind the CoE header of every SDO information message."""

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


class _EntryHead(WireStruct, frozen=True):
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
        head = _EntryHead.decode(body)
        size = (head.bit_length + 7) // 8
        offset = _EntryHead.SIZE
        parts: list[bytes | None] = []
        for flag, length in ((0x08, 4), (0x10, size), (0x20, size), (0x40, size)):
            if not head.value_info & flag:
                parts.append(None)
                continue
            parts.append(bytes(body[offset : offset + length]))
            offset += length
        if offset > len(body):
            raise TruncatedError(
                f"value info 0x{head.value_info:02x} needs {offset} octets, these are {len(body)}",
                layout="EntryDescription",
            )
        unit = None if parts[0] is None else int.from_bytes(parts[0], "little")
        fixed = (head.index, head.subindex, head.data_type, head.bit_length, head.access)
        return cls(*fixed, _text(body[offset:]), unit, *parts[1:])


def _text(octets: Buffer) -> str:
    return bytes(octets).rstrip(b"\0").decode(errors="replace")
