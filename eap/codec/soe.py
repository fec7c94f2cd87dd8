"""SoE messages: the servo drive profile over EtherCAT (ETG.1000.6, IEC 61800-7-300).

A drive's data lies in IDNs of up to eight elements each.  What is longer than a mailbox goes in
fragments, which count down in the place of the IDN.
"""

from __future__ import annotations

import re
from enum import IntEnum, IntFlag
from typing import Annotated, NamedTuple, Self

from eap.codec.wire import Bits, Buffer, WireStruct, bit, bits2, bits3, bits4, u8, u16
from eap.errors import MalformedError, TruncatedError

DATA_OVERHEAD = 10
"""Octets of a mailbox that a message takes before its data."""
MAX_DRIVE = 7


class SoeOpcode(IntEnum):
    """ETG.1000.6, SoE header: what a message is."""

    READ_REQUEST = 1
    READ_RESPONSE = 2
    WRITE_REQUEST = 3
    WRITE_RESPONSE = 4
    NOTIFICATION = 5
    EMERGENCY = 6


class Element(IntFlag):
    """The elements of an IDN; a request may name several, which then lie in this order."""

    DATA_STATE = 0x01
    NAME = 0x02
    ATTRIBUTE = 0x04
    UNIT = 0x08
    MINIMUM = 0x10
    MAXIMUM = 0x20
    VALUE = 0x40
    DEFAULT = 0x80


class SoeHeader(WireStruct, frozen=True):
    """ETG.1000.6: the four octets behind the mailbox header.

    *idn* is the number of fragments that follow this one while *incomplete* is set.
    """

    opcode: Annotated[SoeOpcode, Bits(3, SoeOpcode)]
    incomplete: bit
    error: bit
    drive: bits3
    elements: u8
    idn: u16


class SoeAttribute(WireStruct, frozen=True):
    """IEC 61800-7-300, element 3 of an IDN: how its value is to be read and shown.

    *length* is that of one value: 0 to 3 for 1, 2, 4 and 8 octets.
    """

    factor: u16 = 1
    length: bits2 = 2
    is_list: bit = 0
    is_command: bit = 0
    display: bits3 = 1
    reserved: bit = 0
    decimals: bits4 = 0
    protected_preop: bit = 0
    protected_safeop: bit = 0
    protected_op: bit = 0
    reserved_2: bit = 0

    @property
    def size(self) -> int:
        """Octets of one value."""
        return 1 << self.length


class Display(IntEnum):
    """IEC 61800-7-300, attribute: what kind of value it is."""

    BINARY = 0
    UNSIGNED = 1
    SIGNED = 2
    HEXADECIMAL = 3
    TEXT = 4
    IDN = 5
    FLOAT = 6
    PARAMETER = 7


class DataState(IntFlag):
    """IEC 61800-7-300, data state of a procedure command (element 1 of its IDN)."""

    SET = 0x0001
    ENABLED = 0x0002
    EXECUTING = 0x0004
    ERROR = 0x0008
    DONE = SET | ENABLED
    BUSY = SET | ENABLED | EXECUTING
    FAILED = SET | ENABLED | EXECUTING | ERROR


COMMAND_START = DataState.SET | DataState.ENABLED
COMMAND_CLEAR = 0
"""Values that start a procedure command and clear it, written to element 7 of its IDN."""


class ListHead(WireStruct, frozen=True):
    """IEC 61800-7-300: in front of a list and of every text, in octets."""

    length: u16
    max_length: u16


class Idn(NamedTuple):
    """The number of an IDN in its three parts, written ``S-0-0032`` and ``P-0-0100``."""

    is_product: bool
    parameter_set: int
    block: int

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read the written form; raise ValueError with the reason if it is none."""
        match = _IDN.fullmatch(text.strip())
        if not match or int(match[2]) > 7 or int(match[3]) > 0xFFF:
            raise ValueError(f"{text!r} is not an IDN, such as S-0-0032 or P-7-4095")
        return cls(match[1] in "Pp", int(match[2]), int(match[3]))

    @classmethod
    def of(cls, number: int) -> Self:
        """Take the 16 bits of the wire apart."""
        return cls(bool(number & 0x8000), number >> 12 & 7, number & 0xFFF)

    @property
    def number(self) -> int:
        """The 16 bits of the wire."""
        return self.is_product << 15 | self.parameter_set << 12 | self.block

    def __str__(self) -> str:
        return f"{'P' if self.is_product else 'S'}-{self.parameter_set}-{self.block:04}"


_IDN = re.compile(r"([SPsp])-([0-7])-([0-9]{1,4})")


def encode_message(
    opcode: SoeOpcode,
    idn: int,
    body: Buffer = b"",
    *,
    drive: int = 0,
    elements: int = Element.VALUE,
    error: bool = False,
) -> bytes:
    """Return the data of a mailbox message that needs no fragments."""
    return SoeHeader(opcode, 0, error, drive, elements, idn).encode() + body


def decode_message(data: Buffer) -> tuple[SoeHeader, memoryview]:
    """Return header and body of the data of a mailbox message.

    Raises:
        TruncatedError: it is shorter than the header.
        MalformedError: nobody knows the opcode.
    """
    return SoeHeader.decode(data), memoryview(data)[SoeHeader.SIZE :]


def error_code_of(body: Buffer) -> int:
    """Return the error code of a refusal: its last two octets; raise TruncatedError if missing."""
    if len(body) < 2:
        raise TruncatedError(
            f"an error of {len(body)} octets, expected at least 2", layout="SoeHeader"
        )
    return int.from_bytes(body[-2:], "little")


def encode_fragments(header: SoeHeader, body: Buffer, room: int) -> list[bytes]:
    """Return the messages that carry *body*, with at most *room* octets of it in each."""
    view = memoryview(body)
    pieces = [view[at : at + room] for at in range(0, len(view), room)] or [view]
    messages = []
    for left, piece in zip(range(len(pieces) - 1, -1, -1), pieces, strict=True):
        head = SoeHeader(
            header.opcode,
            bool(left),
            header.error,
            header.drive,
            header.elements,
            left or header.idn,
        )
        messages.append(head.encode() + piece)
    return messages


def encode_list(octets: Buffer, max_length: int | None = None) -> bytes:
    """Return a list or text with its head; *max_length* is its own length if left out."""
    limit = len(octets) if max_length is None else max_length
    return ListHead(len(octets), limit).encode() + octets


def decode_list(body: Buffer) -> tuple[ListHead, bytes]:
    """Return the head and the octets of a list or text.

    Raises:
        TruncatedError: it is shorter than its head or than its head says.
        MalformedError: it is longer than its head allows.
    """
    head = ListHead.decode(body)
    octets = bytes(body[ListHead.SIZE : ListHead.SIZE + head.length])
    if len(octets) < head.length:
        raise TruncatedError(
            f"length {head.length}, but {len(octets)} octets follow", layout="ListHead"
        )
    if head.length > head.max_length:
        raise MalformedError(
            f"length {head.length} of at most {head.max_length}", layout="ListHead"
        )
    return head, octets
