"""Base data types of process variables (ETG.1020): names, values, and layout in a PD.

Names are those of ESI files and IEC 61131-3; the shorter and the CANopen names are read as well.

Everything is little-endian.  A type does not know the offset of its variable; the caller of
``read`` and ``write`` passes it.  :func:`parse` finds a type by its name.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from operator import index
from typing import Any, NamedTuple, TypeAlias

import msgspec

from eap.codec.wire import Buffer
from eap.errors import TruncatedError
from eap.suggest import suggest

Value: TypeAlias = bool | int | float | str | bytes | tuple[int, ...] | tuple[float, ...]
"""Value that ``read`` returns; ``write`` takes the same, and any sequence for an array."""
Plain: TypeAlias = bool | int | float | str | list[int] | list[float]
"""A value as YAML and JSON carry it: a raw block is a string of hexadecimal digits."""


_SHOWN = 60
"""Characters of a refused value in a message."""


class DataType(msgspec.Struct, frozen=True):
    """One type, complete with its length; made by ``datatypes.parse``."""

    text: str
    """Canonical name, which ``datatypes.parse`` reads again."""
    code: int
    """Index of the base type in the object dictionary (ETG.1020)."""
    bit_length: int
    size: int
    """Bytes in the process image."""
    is_bits: bool = False
    """True if it is packed bit by bit on the wire; in the image it has a byte of its own."""
    count: int = 1
    """Elements of an array, else 1."""

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

    def from_plain(self, plain: object) -> Value:
        """Read a value as a plant file or JSON holds it; raise ValueError if it is none."""
        return self.decode(self.encode(plain), 0)

    def to_plain(self, value: Value) -> Plain:
        """Return *value* as JSON can carry it."""
        if isinstance(value, bytes):
            return value.hex()
        return list(value) if isinstance(value, tuple) else value

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
        return ValueError(f"{shown} is not a value of {self.text}: expected {expected}")


class Integer(DataType, frozen=True):
    """A whole number of 1 to 8 bytes, or of 1 to 8 bits in a byte of its own."""

    signed: bool = False

    @property
    def scalar_range(self) -> tuple[int, int]:
        """Smallest and largest number."""
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
            number = int(text, 10 if text.strip().lstrip("+-").isdecimal() else 0)
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
    """One bit; any byte but zero reads as true."""

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


class String(DataType, frozen=True):
    """Text in a fixed number of bytes: UTF-8, padded with zeros, which end it on reading.

    Bytes that are no UTF-8 read as U+FFFD: a peer's text never fails to be shown.
    """

    def encode(self, value: Any) -> bytes:
        """Return the padded bytes of a text that fits and has no NUL; take bytes as they are."""
        if isinstance(value, bytes) and len(value) == self.size:
            return value
        if not isinstance(value, str):
            raise self._refuse(value, "a text")
        try:
            octets = value.encode()
        except UnicodeEncodeError:
            raise self._refuse(value, "a text without lone surrogates") from None
        if 0 in octets:
            raise self._refuse(value, "a text without NUL, which would end it")
        if len(octets) > self.size:
            raise self._refuse(value, f"at most {self.size} bytes, this text has {len(octets)}")
        return octets.ljust(self.size, b"\0")

    def parse_text(self, text: str) -> Value:
        """Take the text as it is."""
        self.encode(text)
        return text

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read the text up to the first NUL."""
        octets, _, _ = bytes(buffer[offset : offset + self.size]).partition(b"\0")
        return octets.decode(errors="replace")


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


class Array(DataType, frozen=True, kw_only=True):
    """A fixed number of equal numbers; its value is a tuple."""

    element: DataType

    def encode(self, value: Any) -> bytes:
        """Return the bytes of a sequence of exactly as many numbers; errors name the element."""
        if not isinstance(value, Sequence) or isinstance(value, str | bytes | bytearray):
            raise self._refuse(value, f"{self.count} values")
        if len(value) != self.count:
            raise self._refuse(value, f"{self.count} values, these are {len(value)}")
        octets = bytearray()
        for position, item in enumerate(value):
            try:
                octets += self.element.encode(item)
            except ValueError as exc:
                raise ValueError(f"element {position} of {self.text}: {exc}") from None
        return bytes(octets)

    def parse_text(self, text: str) -> Value:
        """Read the elements between commas; brackets around them are allowed."""
        items = text.strip().removeprefix("[").removesuffix("]").split(",")
        if len(items) != self.count:
            raise self._refuse(text, f"{self.count} values between commas, these are {len(items)}")
        numbers: list[Any] = [self.element.parse_text(item) for item in items]
        return tuple(numbers)

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read all elements."""
        end, step = offset + self.size, self.element.size
        numbers: list[Any] = [self.element.decode(buffer, at) for at in range(offset, end, step)]
        return tuple(numbers)


# A PD's length is 16 bits wide.
MAX_SIZE = 0xFFFF
"""Bytes of the largest variable."""


def _integer(name: str, code: int, bits: int, *, signed: bool = False) -> DataType:
    return Integer(name, code, bits, (bits + 7) // 8, signed=signed)


_NUMBERS: dict[str, DataType] = {
    kind.text: kind
    for kind in (
        Boolean("BOOL", 0x01, 1, 1, is_bits=True),
        _integer("SINT", 0x02, 8, signed=True),
        _integer("INT", 0x03, 16, signed=True),
        _integer("DINT", 0x04, 32, signed=True),
        _integer("USINT", 0x05, 8),
        _integer("UINT", 0x06, 16),
        _integer("UDINT", 0x07, 32),
        Real("REAL", 0x08, 32, 4),
        _integer("INT24", 0x10, 24, signed=True),
        Real("LREAL", 0x11, 64, 8),
        _integer("INT40", 0x12, 40, signed=True),
        _integer("INT48", 0x13, 48, signed=True),
        _integer("INT56", 0x14, 56, signed=True),
        _integer("LINT", 0x15, 64, signed=True),
        _integer("UINT24", 0x16, 24),
        _integer("UINT40", 0x18, 40),
        _integer("UINT48", 0x19, 48),
        _integer("UINT56", 0x1A, 56),
        _integer("ULINT", 0x1B, 64),
        _integer("BYTE", 0x1E, 8),
        _integer("WORD", 0x1F, 16),
        _integer("DWORD", 0x20, 32),
        *(Integer(f"BIT{n}", 0x2F + n, n, 1, is_bits=True) for n in range(1, 9)),
    )
}

_BY_WIDTH = {
    "INT": {8: "SINT", 16: "INT", 32: "DINT", 64: "LINT"},
    "UINT": {8: "USINT", 16: "UINT", 32: "UDINT", 64: "ULINT"},
}
_ALIASES = {
    "BOOLEAN": "BOOL",
    "BIT": "BIT1",
    "REAL32": "REAL",
    "REAL64": "LREAL",
    "VISIBLE_STRING": "STRING",
    "OCTET_STRING": "BLOCK",
    **{
        f"{prefix}{width}": _BY_WIDTH[family].get(width, f"{family}{width}")
        for family, prefixes in (
            ("INT", ("I", "INT", "INTEGER")),
            ("UINT", ("U", "UINT", "UNSIGNED")),
        )
        for prefix in prefixes
        for width in range(8, 65, 8)
    },
}

_OF_OTHER_LANGUAGES = {"FLOAT": "REAL", "DOUBLE": "LREAL"}
"""Names that no standard of the field has; the right name is suggested."""

_SIZED: dict[str, Callable[[int], DataType]] = {
    "STRING": lambda size: String(f"STRING({size})", 0x09, size * 8, size),
    "BLOCK": lambda size: Block(f"BLOCK({size})", 0x0A, size * 8, size),
}
_FORM = re.compile(r"([A-Z_][A-Z_0-9]*)\s*(?:\(\s*(\d+)\s*\))?\s*(?:\[\s*(\d+)\s*\])?", re.ASCII)
_IEC_ARRAY = re.compile(r"ARRAY\s*\[\s*(\d+)\s*\.\.\s*(\d+)\s*\]\s*OF\s+(\S.*)", re.ASCII)


@lru_cache(maxsize=4096)
def parse(text: str) -> DataType:
    """Return the type that *text* names: ``UINT``, ``REAL[4]``, ``STRING(16)``, ``BLOCK(600)``.

    Upper and lower case are the same, as in IEC 61131-3, and so are the IEC, CANopen and short
    names (``UINT``, ``UNSIGNED16``, ``U16``).  ``ARRAY [0..3] OF REAL`` is read as ``REAL[4]``.

    Raises:
        ValueError: there is no such type; the message says which one comes near.
    """
    form = text.strip().upper()
    if bounds := _IEC_ARRAY.fullmatch(form):
        form = f"{bounds[3]}[{max(0, int(bounds[2]) - int(bounds[1]) + 1)}]"
    match = _FORM.fullmatch(form)
    if not match:
        raise ValueError(f"{text!r} is not a data type (such as UINT, REAL[4] or STRING(16))")
    name = _ALIASES.get(match[1], match[1])
    kind = _scalar(text, name, match[2])
    return kind if match[3] is None else _array(text, kind, int(match[3]))


def _scalar(text: str, name: str, length: str | None) -> DataType:
    if name in _NUMBERS:
        if length is not None:
            raise ValueError(f"{text!r}: {name} has a fixed length, arrays are {name}[{length}]")
        return _NUMBERS[name]
    if name not in _SIZED:
        known = [*_NUMBERS, *_SIZED, *_ALIASES]
        meant = _OF_OTHER_LANGUAGES.get(name)
        hint = (
            f", did you mean {meant}?"
            if meant
            else suggest(name, known) or " (such as UINT, REAL[4] or STRING(16))"
        )
        raise ValueError(f"{text!r} is not a data type{hint}")
    if length is None:
        raise ValueError(f"{text!r} lacks its length in bytes, such as {name}(16)")
    _check_size(text, int(length))
    return _SIZED[name](int(length))


def _array(text: str, element: DataType, count: int) -> DataType:
    if element.is_bits:
        raise ValueError(f"{text!r}: arrays of bits are not supported, use variables or BYTE")
    if element.scalar_range is None:
        raise ValueError(f"{text!r}: only numbers form arrays, use one variable for each")
    _check_size(text, element.size * count)
    return Array(
        f"{element.text}[{count}]",
        element.code,
        element.bit_length * count,
        element.size * count,
        count=count,
        element=element,
    )


def _check_size(text: str, size: int) -> None:
    if not 0 < size <= MAX_SIZE:
        raise ValueError(f"{text!r} has {size} bytes, expected 1 to {MAX_SIZE}")


class PdoLayout(NamedTuple):
    """Start of each variable, in bits from the start of the data, and the size in bytes."""

    bit_offsets: tuple[int, ...]
    size: int


def layout(types: Iterable[DataType]) -> PdoLayout:
    """Place one variable of each of *types*, in this order.

    This is the one rule that publisher and subscriber share: bits (BOOL, BIT1 to BIT8) pack behind
    each other from bit 0 up, everything else starts on the next whole byte, and the PD ends on one.
    Nothing is aligned to more than a byte (mappings of ETG.1000.6 know bit lengths only; the
    skipped bits are padding entries of one).
    """
    offsets: list[int] = []
    end = 0
    for kind in types:
        if not kind.is_bits:
            end = _whole_octet(end)
        offsets.append(end)
        end += kind.bit_length
    return PdoLayout(tuple(offsets), _whole_octet(end) // 8)


def _whole_octet(bits: int) -> int:
    return (bits + 7) // 8 * 8
