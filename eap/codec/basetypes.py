"""Base data types of process variables (ETG.1020): numbers, bits, texts and raw bytes.

Everything is little-endian.  A type does not know the offset of its variable; the caller of
``read`` and ``write`` passes it.  ``datatypes.parse`` finds a type by its name.
"""

from __future__ import annotations

import struct
from operator import index
from typing import Any, ClassVar, Self, TypeAlias

import msgspec

from eap.codec.literals import Literal
from eap.codec.wire import Buffer
from eap.errors import TruncatedError

Value: TypeAlias = Any
"""Value that ``read`` returns: bool, int, float, str, bytes, one of :mod:`eap.codec.times`, and a
tuple or dict of them; ``write`` takes the same, and any sequence for an array."""
Plain: TypeAlias = bool | int | float | str | list[Any] | dict[str, Any]
"""A value as YAML and JSON carry it: bytes are hexadecimal digits, times and enums texts."""


# A PD's length is 16 bits wide.
MAX_SIZE = 0xFFFF
"""Bytes of the largest variable."""

_SHOWN = 60
"""Characters of a refused value in a message."""


class DataType(msgspec.Struct, frozen=True, eq=False):
    """One type, complete with its length; made by ``datatypes.parse``."""

    text: str
    """Canonical and complete text, which ``datatypes.parse`` reads again."""
    code: int
    """Index of the base type in the object dictionary (ETG.1020)."""
    bit_length: int
    size: int
    """Bytes in the process image."""
    is_bits: bool = False
    """True if it is packed bit by bit on the wire; in the image it has a byte of its own."""
    count: int = 1
    """Elements of an array, else 1."""
    name: str = ""
    """Text for people: of a type with a definition only its name."""
    alias_of: DataType | None = None
    """Type that *name* is another name of."""

    def __post_init__(self) -> None:
        if not self.name:
            msgspec.structs.force_setattr(self, "name", self.text)

    # The text is complete, so that no other field has to be compared.

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, DataType) and self.text == other.text)

    def __hash__(self) -> int:
        return hash(self.text)

    @property
    def alignment(self) -> int:
        """Bytes of which a member's offset is a multiple in a struct without packing."""
        return 1

    @property
    def wire(self) -> str:
        """Text that is the same for all types whose values are alike, byte by byte."""
        return self.alias_of.wire if self.alias_of else self.text

    def compose(self, seen: dict[str, DataType]) -> str:
        """Return the text within another type's, in which the definitions *seen* precede it."""
        if self.alias_of is None:
            return self.text
        if seen.get(self.name) == self:
            return self.name
        text = f"{self.name}<{self.alias_of.compose(seen)}>"
        seen[self.name] = self
        return text

    def named(self, name: str) -> Self:
        """Return the same type under another name, an alias."""
        text = f"{name}<{self.compose({})}>"
        return msgspec.structs.replace(self, text=text, name=name, alias_of=self)

    @property
    def is_text(self) -> bool:
        """True if it is text, of which only as many bytes count as are not NUL at the end."""
        return self.code == 0x09

    def read(self, buffer: Buffer, offset: int) -> Value:
        """Return the value at *offset*; raise TruncatedError if the buffer ends before it."""
        if offset < 0 or offset + self.size > len(buffer):
            raise self._no_room(buffer, offset)
        return self.decode(buffer, offset)

    def write(self, buffer: bytearray | memoryview, offset: int, value: Any) -> None:
        """Put *value* at *offset*, or raise ValueError with the reason and write nothing."""
        octets = self.encode(value)
        if offset < 0 or offset + self.size > len(buffer):
            raise self._no_room(buffer, offset)
        buffer[offset : offset + self.size] = octets

    # The next two and parse_text are abstract; a msgspec.Struct has a metaclass that ABC refuses.

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Return the value at *offset* of a buffer that is known to be long enough."""
        raise NotImplementedError

    def encode(self, value: Any) -> bytes:
        """Return the bytes of *value*; raise ValueError naming type and range if it is none."""
        raise NotImplementedError

    @property
    def zero(self) -> Value:
        """The value of all bytes zero."""
        return self.decode(bytes(self.size), 0)

    @property
    def scalar_range(self) -> tuple[int, int] | tuple[float, float] | None:
        """Smallest and largest value of a single number (ints or floats), None for all others."""
        return None

    def parse_text(self, text: str) -> Value:
        """Read a value as typed on a command line; raise ValueError if it is none."""
        raise NotImplementedError

    def from_literal(self, literal: Literal) -> Value:
        """Read a part of what ``read_literal`` returned; raise ValueError if it is no value."""
        if isinstance(literal, str):
            return self.parse_text(literal)
        raise self._refuse(literal, "a single value")

    def from_plain(self, plain: object) -> Value:
        """Read a value as a plant file or JSON holds it; raise ValueError if it is none."""
        return self.decode(self.encode(plain), 0)

    def to_plain(self, value: Value) -> Plain:
        """Return *value* as JSON can carry it."""
        plain: Plain = value.hex() if isinstance(value, bytes) else value
        return plain

    def _no_room(self, buffer: Buffer, offset: int) -> TruncatedError:
        return TruncatedError(
            f"needs {self.size} bytes of a buffer of {len(buffer)}",
            layout=self.text,
            offset=offset,
        )

    def _refuse(self, value: object, expected: str) -> ValueError:
        shown = repr(value)
        if len(shown) > _SHOWN:
            shown = f"{shown[:_SHOWN]}…"
        return ValueError(f"{shown} is not a value of {self.name}: expected {expected}")


def check_size(text: str, size: int) -> None:
    """Raise ValueError, which begins with *text*, if no variable can have *size* bytes."""
    if not 0 < size <= MAX_SIZE:
        raise ValueError(f"{text!r} has {size} bytes: expected 1 to {MAX_SIZE}")


def whole_number(text: str) -> int:
    """Read decimal, or hexadecimal, octal and binary behind 0x, 0o and 0b; raise ValueError."""
    # Base 0 refuses the leading zeros of 007, which users and CSV files write.
    return int(text, 10 if text.strip().lstrip("+-").isdecimal() else 0)


class Integer(DataType, frozen=True):
    """A whole number of 1 to 8 bytes, or of 1 to 8 bits in a byte of its own."""

    signed: bool = False
    bounds: tuple[int, int] | None = None
    """Smallest and largest number of a subrange."""
    range_of: str = ""
    """Text of the type that a subrange is a part of."""

    @property
    def alignment(self) -> int:
        """Its size; 1 for widths that processors do not have."""
        return self.size if self.size in {2, 4, 8} else 1

    @property
    def wire(self) -> str:
        """Text without the bounds of a subrange."""
        return self.range_of or super().wire

    @property
    def scalar_range(self) -> tuple[int, int]:
        """Smallest and largest number."""
        if self.bounds:
            return self.bounds
        if self.signed:
            half = 1 << self.bit_length - 1
            return -half, half - 1
        return 0, (1 << self.bit_length) - 1

    def encode(self, value: Any) -> bytes:
        """Return the bytes of any whole number in range."""
        low, high = self.scalar_range
        try:
            number = index(value)
        except TypeError:
            raise self._refuse(value, f"a whole number from {low} to {high}") from None
        if not low <= number <= high:
            raise self._refuse(value, f"a whole number from {low} to {high}")
        return number.to_bytes(self.size, "little", signed=self.signed)

    def parse_text(self, text: str) -> Value:
        """Read decimal, or hexadecimal, octal and binary behind 0x, 0o and 0b."""
        try:
            number = whole_number(text)
        except ValueError:
            low, high = self.scalar_range
            raise self._refuse(text, f"a whole number from {low} to {high}") from None
        self.encode(number)
        return number

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read all bytes as one number; a bit field ignores the bits beyond it."""
        number = int.from_bytes(buffer[offset : offset + self.size], "little", signed=self.signed)
        return number & (1 << self.bit_length) - 1 if self.is_bits else number


_TRUTH = {"true": True, "1": True, "on": True, "false": False, "0": False, "off": False}


class Boolean(DataType, frozen=True):
    """One bit, or one byte in arrays and structs; any byte but zero reads as true."""

    def compose(self, seen: dict[str, DataType]) -> str:
        """Return BOOL: within another type it is always a byte."""
        return super().compose(seen) if self.alias_of else "BOOL"

    @property
    def scalar_range(self) -> tuple[int, int]:
        """0 and 1."""
        return 0, 1

    def encode(self, value: Any) -> bytes:
        """Return the byte of True, False, 1 or 0."""
        if not isinstance(value, int) or value not in (0, 1):
            raise self._refuse(value, "true or false")
        return bytes((value,))

    def parse_text(self, text: str) -> Value:
        """Read true or false, on or off, 1 or 0."""
        truth = _TRUTH.get(text.strip().lower())
        if truth is None:
            raise self._refuse(text, "true or false")
        return truth

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read any byte but zero as true."""
        return buffer[offset] != 0


_FLOAT = {4: struct.Struct("<f"), 8: struct.Struct("<d")}
_LARGEST = {
    size: _FLOAT[size].unpack(bits)[0]
    for size, bits in ((4, bytes.fromhex("ffff7f7f")), (8, bytes.fromhex("ffffffffffffef7f")))
}


class Real(DataType, frozen=True):
    """An IEEE 754 number of 4 or 8 bytes; infinities and NaN are values."""

    @property
    def alignment(self) -> int:
        """Its size."""
        return self.size

    @property
    def scalar_range(self) -> tuple[float, float]:
        """Smallest and largest finite number."""
        return -_LARGEST[self.size], _LARGEST[self.size]

    def encode(self, value: Any) -> bytes:
        """Return the bytes of any number that is not too large."""
        try:
            return _FLOAT[self.size].pack(value)
        except (struct.error, OverflowError):
            low, high = self.scalar_range
            raise self._refuse(value, f"a number from {low} to {high}") from None

    def parse_text(self, text: str) -> Value:
        """Read a decimal number, also with an exponent, ``inf`` or ``nan``."""
        try:
            number = float(text)
        except ValueError:
            raise self._refuse(text, "a number such as -1.5e3") from None
        self.encode(number)
        return number

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read the number, infinities and NaN included."""
        number: float = _FLOAT[self.size].unpack_from(buffer, offset)[0]
        return number


class Text(DataType, frozen=True):
    """Base of texts in a fixed number of bytes: padded with zeros, which end them on reading.

    Bytes that are no text read as U+FFFD: a peer's text never fails to be shown.
    """

    encoding: ClassVar[str]
    unit: ClassVar[int]
    """Bytes of one unit of the encoding."""
    units: ClassVar[str]
    """Name of the units in messages."""
    nul_size: ClassVar[int] = 0
    """Bytes of a NUL that is behind the longest text too."""

    @property
    def alignment(self) -> int:
        """That of a unit."""
        return self.unit

    def encode(self, value: Any) -> bytes:
        """Return the padded bytes of a text that fits and has no NUL; take bytes as they are."""
        if isinstance(value, bytes) and len(value) == self.size:
            return value
        if not isinstance(value, str):
            raise self._refuse(value, "a text")
        try:
            octets = value.encode(self.encoding)
        except UnicodeEncodeError:
            raise self._refuse(value, "a text without lone surrogates") from None
        if "\0" in value:
            raise self._refuse(value, "a text without NUL, which would end it")
        room = self.size - self.nul_size
        if len(octets) > room:
            most, given = room // self.unit, len(octets) // self.unit
            raise self._refuse(value, f"at most {most} {self.units}, this text has {given}")
        return octets.ljust(self.size, b"\0")

    def parse_text(self, text: str) -> Value:
        """Take the text as it is."""
        self.encode(text)
        return text

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read the text up to the first NUL, or up to the place of the last one."""
        octets = bytes(buffer[offset : offset + self.size - self.nul_size])
        return octets.decode(self.encoding, errors="replace").partition("\0")[0]


class String(Text, frozen=True):
    """Text in UTF-8; all bytes may be text."""

    encoding = "utf-8"
    unit = 1
    units = "bytes"


class WideString(Text, frozen=True):
    """Text in UTF-16: a fixed number of units, then the NUL that IEC 61131-3 controllers add."""

    encoding = "utf-16-le"
    unit = 2
    units = "units of UTF-16"
    nul_size = 2


class WideChar(DataType, frozen=True):
    """One unit of UTF-16; NUL is the empty text."""

    @property
    def alignment(self) -> int:
        """Its size."""
        return self.size

    def encode(self, value: Any) -> bytes:
        """Return the bytes of a text of one unit, or of none."""
        if not isinstance(value, str) or value == "\0" or "\ud800" <= value < "\ue000":
            raise self._refuse(value, "one character below U+10000")
        octets = value.encode("utf-16-le", errors="surrogatepass")
        if len(octets) > self.size:
            raise self._refuse(value, "one character below U+10000")
        return octets.ljust(self.size, b"\0")

    def parse_text(self, text: str) -> Value:
        """Take the character as it is."""
        self.encode(text)
        return text

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read the character."""
        octets = bytes(buffer[offset : offset + self.size])
        return octets.decode("utf-16-le", errors="replace").rstrip("\0")


class Block(DataType, frozen=True):
    """Raw bytes of a fixed number."""

    def encode(self, value: Any) -> bytes:
        """Return the bytes, which must be exactly as many as the block has."""
        if not isinstance(value, bytes | bytearray | memoryview):
            raise self._refuse(value, f"{self.size} bytes")
        if len(value) != self.size:
            raise self._refuse(bytes(value), f"{self.size} bytes, these are {len(value)}")
        return bytes(value)

    def parse_text(self, text: str) -> Value:
        """Read hexadecimal digits, spaces between bytes allowed."""
        try:
            octets = bytes.fromhex(text)
        except ValueError:
            raise self._refuse(text, f"{self.size} bytes in hexadecimal") from None
        return self.encode(octets)

    def from_plain(self, plain: object) -> Value:
        """Read hexadecimal digits."""
        if not isinstance(plain, str):
            raise self._refuse(plain, f"{self.size} bytes in hexadecimal")
        return self.parse_text(plain)

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Return a copy of the bytes."""
        return bytes(buffer[offset : offset + self.size])
