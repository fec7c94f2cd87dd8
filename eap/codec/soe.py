"""SoE messages, error codes and values: the servo drive profile (ETG.1000.6, IEC 61800-7-300).

A drive's data lies in IDNs of up to eight elements each.  What is longer than a mailbox goes in
fragments, which count down in the place of the IDN.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from enum import IntEnum, IntFlag
from typing import Annotated, NamedTuple, Self, TypeAlias

from eap.codec.wire import Bits, Buffer, WireStruct, bit, bits2, bits3, bits4, u8, u16
from eap.errors import MalformedError, TruncatedError

DATA_OVERHEAD = 10
"""Bytes of a mailbox that a message takes before its data."""
MAX_DRIVE = 7
AT, MDT = 16, 24
"""Telegrams of drive 0: numbers of their PDOs, and of the IDNs with the lists of their entries."""
CONTROL_WORD, STATUS_WORD = 134, 135
"""Master control word in each MDT, drive status word in each AT; their lists do not have them."""


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
    """ETG.1000.6: the four bytes behind the mailbox header.

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

    *length* is that of one value: 0 to 3 for 1, 2, 4 and 8 bytes.
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
        """Bytes of one value."""
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
    """IEC 61800-7-300: in front of a list and of every text, in bytes."""

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
        MalformedError: the opcode is unknown.
    """
    return SoeHeader.decode(data), memoryview(data)[SoeHeader.SIZE :]


def error_code_of(body: Buffer) -> int:
    """Return the error code of a refusal: its last two bytes; raise TruncatedError if missing."""
    if len(body) < 2:
        raise TruncatedError(
            f"an error of {len(body)} bytes, expected at least 2", layout="SoeHeader"
        )
    return int.from_bytes(body[-2:], "little")


def encode_fragments(header: SoeHeader, body: Buffer, max_size: int) -> list[bytes]:
    """Return the messages that carry *body*, with at most *max_size* bytes of it in each."""
    view = memoryview(body)
    pieces = [view[at : at + max_size] for at in range(0, len(view), max_size)] or [view]
    messages = []
    # An empty value is one message, too: the answer must come.
    for left, piece in zip(range(len(pieces) - 1, -1, -1), pieces, strict=True):
        head = SoeHeader(
            header.opcode,
            bool(left),
            header.error,
            header.drive,
            header.elements,
            # The IDN is in the last fragment only; the others count down in its place.
            left or header.idn,
        )
        messages.append(head.encode() + piece)
    return messages


def encode_list(octets: Buffer, max_length: int | None = None) -> bytes:
    """Return a list or text with its head; *max_length* is its own length if left out."""
    limit = len(octets) if max_length is None else max_length
    return ListHead(len(octets), limit).encode() + octets


def decode_list(body: Buffer) -> tuple[ListHead, bytes]:
    """Return the head and the bytes of a list or text.

    Raises:
        TruncatedError: it is shorter than its head or than its head says.
        MalformedError: it is longer than its head allows.
    """
    head = ListHead.decode(body)
    octets = bytes(body[ListHead.SIZE : ListHead.SIZE + head.length])
    if len(octets) < head.length:
        raise TruncatedError(
            f"length {head.length}, but {len(octets)} bytes follow", layout="ListHead"
        )
    # A list of which the current length is beyond its own maximum is damaged, whatever follows.
    if head.length > head.max_length:
        raise MalformedError(
            f"length {head.length} of at most {head.max_length}", layout="ListHead"
        )
    return head, octets


class SoeErrorCode(IntEnum):
    """The codes of the standard; a peer may send others, which stay plain integers."""

    NO_IDN = 0x1001
    ELEMENT_1_ACCESS = 0x1009
    NO_NAME = 0x2001
    NAME_TOO_SHORT = 0x2002
    NAME_TOO_LONG = 0x2003
    NAME_READ_ONLY = 0x2004
    NAME_PROTECTED = 0x2005
    ATTRIBUTE_TOO_SHORT = 0x3002
    ATTRIBUTE_TOO_LONG = 0x3003
    ATTRIBUTE_READ_ONLY = 0x3004
    ATTRIBUTE_PROTECTED = 0x3005
    NO_UNIT = 0x4001
    UNIT_TOO_SHORT = 0x4002
    UNIT_TOO_LONG = 0x4003
    UNIT_READ_ONLY = 0x4004
    UNIT_PROTECTED = 0x4005
    NO_MINIMUM = 0x5001
    MINIMUM_TOO_SHORT = 0x5002
    MINIMUM_TOO_LONG = 0x5003
    MINIMUM_READ_ONLY = 0x5004
    MINIMUM_PROTECTED = 0x5005
    NO_MAXIMUM = 0x6001
    MAXIMUM_TOO_SHORT = 0x6002
    MAXIMUM_TOO_LONG = 0x6003
    MAXIMUM_READ_ONLY = 0x6004
    MAXIMUM_PROTECTED = 0x6005
    VALUE_TOO_SHORT = 0x7002
    VALUE_TOO_LONG = 0x7003
    VALUE_READ_ONLY = 0x7004
    VALUE_PROTECTED = 0x7005
    BELOW_MINIMUM = 0x7006
    ABOVE_MAXIMUM = 0x7007
    INVALID_VALUE = 0x7008
    PASSWORD = 0x7009
    CYCLIC = 0x700A
    INDIRECT = 0x700B
    OTHER_SETTINGS = 0x700C
    COMMAND_ACTIVE = 0x7010
    COMMAND_NOT_INTERRUPTIBLE = 0x7011
    COMMAND_NOT_NOW = 0x7012
    COMMAND_PARAMETERS = 0x7013
    NO_DATA_STATE = 0x7014
    NO_DEFAULT = 0x8001
    DEFAULT_TOO_LONG = 0x8002
    DEFAULT_READ_ONLY = 0x8004
    # SOEM prints the text of 0x800A for all three; the numbers are those of IgH.
    INVALID_DRIVE = 0x800A
    GENERAL = 0x800B
    NO_ELEMENT = 0x800C


_TEXTS = {
    SoeErrorCode.NO_IDN: "no such IDN",
    SoeErrorCode.ELEMENT_1_ACCESS: "invalid access to element 1",
    SoeErrorCode.NO_NAME: "no name",
    SoeErrorCode.NO_UNIT: "no unit",
    SoeErrorCode.NO_MINIMUM: "no minimum",
    SoeErrorCode.NO_MAXIMUM: "no maximum",
    SoeErrorCode.BELOW_MINIMUM: "value is below the minimum",
    SoeErrorCode.ABOVE_MAXIMUM: "value is above the maximum",
    SoeErrorCode.INVALID_VALUE: "invalid value",
    SoeErrorCode.PASSWORD: "value is protected by a password",
    SoeErrorCode.CYCLIC: "value is write protected: it is configured cyclically",
    SoeErrorCode.INDIRECT: "invalid indirect addressing",
    SoeErrorCode.OTHER_SETTINGS: "value is write protected by other settings",
    SoeErrorCode.COMMAND_ACTIVE: "procedure command is already active",
    SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE: "procedure command cannot be interrupted",
    SoeErrorCode.COMMAND_NOT_NOW: "procedure command cannot be executed now",
    SoeErrorCode.COMMAND_PARAMETERS: "procedure command cannot be executed: invalid parameters",
    SoeErrorCode.NO_DATA_STATE: "no data state",
    SoeErrorCode.NO_DEFAULT: "no default",
    SoeErrorCode.DEFAULT_TOO_LONG: "default is too long",
    SoeErrorCode.DEFAULT_READ_ONLY: "default is read only",
    SoeErrorCode.INVALID_DRIVE: "invalid drive number",
    SoeErrorCode.GENERAL: "general error",
    SoeErrorCode.NO_ELEMENT: "no element addressed",
}
for _number, _element in (
    (0x2000, "name"),
    (0x3000, "attribute"),
    (0x4000, "unit"),
    (0x5000, "minimum"),
    (0x6000, "maximum"),
    (0x7000, "value"),
):
    for _low, _reason in (
        (2, "is too short"),
        (3, "is too long"),
        (4, "is read only"),
        (5, "is write protected now"),
    ):
        _TEXTS[SoeErrorCode(_number | _low)] = f"{_element} {_reason}"


def name_of(code: int) -> str:
    """Return the meaning of *code*, which may be of the vendor."""
    try:
        return _TEXTS[SoeErrorCode(code)]
    except ValueError:
        return "error code of the vendor"


SoeScalar: TypeAlias = int | float
SoeValue: TypeAlias = int | float | str | list[int] | list[float]

_UNSIGNED = "BHIQ"
_SIGNED = "bhiq"
_FLOAT = {2: "f", 3: "d"}


def decode_value(attribute: SoeAttribute, body: Buffer) -> SoeValue:
    """Return a value as element 7 carries it; bytes behind it are ignored.

    Raises:
        TruncatedError: the bytes end before the value does.
        MalformedError: a list is no whole number of values, or longer than it may be.
    """
    if not attribute.is_list:
        return decode_scalar(attribute, body)
    _, octets = decode_list(body)
    if attribute.display == Display.TEXT:
        # Replaced, not refused: one odd byte must not hide the rest of the text.
        return octets.rstrip(b"\0").decode(errors="replace")
    if len(octets) % attribute.size:
        raise MalformedError(
            f"{len(octets)} bytes for values of {attribute.size}", layout="SoeAttribute"
        )
    steps = range(0, len(octets), attribute.size)
    values: list[int] | list[float] = [decode_scalar(attribute, octets[at:]) for at in steps]
    return values


def decode_scalar(attribute: SoeAttribute, body: Buffer) -> SoeScalar:
    """Return the one number that *body* begins with; raise TruncatedError if it is too short."""
    if len(body) < attribute.size:
        raise TruncatedError(
            f"{len(body)} bytes for a value of {attribute.size}", layout="SoeAttribute"
        )
    number: SoeScalar = struct.unpack_from(_code(attribute), body)[0]
    return number


def encode_value(
    attribute: SoeAttribute,
    value: SoeScalar | str | Sequence[SoeScalar],
    *,
    max_length: int | None = None,
) -> bytes:
    """Return the bytes of a value as element 7 carries it.

    *max_length* is what the head of a list says it may grow to, in bytes.  A single number is a
    list of one where a list is due.

    Raises:
        ValueError: it is no value of this kind; the message says what is.
    """
    if not attribute.is_list:
        return encode_scalar(attribute, value)
    if isinstance(value, str):
        return encode_list(value.encode(), max_length)
    values = value if isinstance(value, Sequence) else (value,)
    return encode_list(b"".join(encode_scalar(attribute, item) for item in values), max_length)


def encode_scalar(attribute: SoeAttribute, value: object) -> bytes:
    """Return the bytes of one number; raise ValueError if it is none that fits."""
    code = _code(attribute)
    try:
        return struct.pack(code, value)
    except (struct.error, OverflowError):
        size = attribute.size
        raise ValueError(
            f"{value!r} is no value of {size} bytes: expected {_expected(code, 8 * size)}"
        ) from None


def _expected(code: str, bits: int) -> str:
    if code[-1] in _FLOAT.values():
        return "a number"
    low, high = (0, 2**bits) if code[-1].isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1))
    return f"a whole number from {low} to {high - 1}"


def _code(attribute: SoeAttribute) -> str:
    # A display of FLOAT with 1 or 2 bytes cannot be a float: it is read as a number.
    if attribute.display == Display.FLOAT and attribute.length in _FLOAT:
        return f"<{_FLOAT[attribute.length]}"
    codes = _SIGNED if attribute.display == Display.SIGNED else _UNSIGNED
    return f"<{codes[attribute.length]}"
