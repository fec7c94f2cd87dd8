"""Values of variables as S7 controllers and Modbus devices hold them: big-endian, by their rules.

A :class:`FieldType` belongs to the type of a variable (:mod:`eap.codec.datatypes`), whose values it
takes and returns.  Its bytes are those of the other side: :func:`s7_type` has the layout of data
blocks without optimised access, :func:`modbus_type` that of 16-bit registers.  A single bit is bit
0 of one byte.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from datetime import date
from math import isfinite
from typing import Any, NamedTuple

import msgspec

from eap.codec import datatypes
from eap.codec.arrays import Array
from eap.codec.basetypes import (
    Block,
    Boolean,
    DataType,
    Integer,
    Real,
    String,
    Text,
    Value,
    WideChar,
    WideString,
)
from eap.codec.structures import Structure
from eap.codec.times import CalendarDate, DateAndTime, Duration, Timed, TimeOfDay
from eap.suggest import nearest_in_any_case

_MS, _S = 1_000_000, 1_000_000_000
_DAY = 86_400 * _S
_EPOCH = date(1970, 1, 1).toordinal()


class FieldType(msgspec.Struct, frozen=True, kw_only=True):
    """One value on the other side.

    Attributes:
        kind: Type of the variable.
        text: Name of the type on the other side.
        bits: Number of bits there.
        align: Bits of which its position is a multiple.
    """

    kind: DataType
    text: str
    bits: int
    align: int = 16

    @property
    def size(self) -> int:
        """Bytes that it takes; 1 for a bit."""
        return -(-self.bits // 8)

    # Both are abstract; a msgspec.Struct has a metaclass that ABC refuses.

    def encode(self, value: Value) -> bytes:
        """Return the bytes of a value of the variable; raise ValueError if it does not fit."""
        raise NotImplementedError

    def decode(self, data: bytes) -> Value:
        """Return the value in ``size`` bytes; raise ValueError if the variable cannot hold it."""
        raise NotImplementedError


class FieldBit(FieldType, frozen=True):
    """One bit."""

    def encode(self, value: Value) -> bytes:
        """Return a byte with the bit."""
        return b"\1" if value else b"\0"

    def decode(self, data: bytes) -> Value:
        """Return whether bit 0 is set."""
        return bool(data[0] & 1)


class FieldNumber(FieldType, frozen=True):
    """A number, big-endian unless *order* says otherwise."""

    code: str
    """Of :mod:`struct`."""
    order: tuple[int, ...] = ()
    """Positions of the big-endian bytes; empty leaves them as they are."""

    def encode(self, value: Value) -> bytes:
        """Return the bytes of a number, rounded where the other side has whole numbers."""
        number: float = value
        if self.code not in "fd":
            if not isfinite(number):
                raise ValueError(f"{number} is not a value of {self.text}")
            number = round(number) if isinstance(number, float) else int(number)
        try:
            data = struct.pack(f">{self.code}", number)
        except (struct.error, OverflowError):
            raise ValueError(f"{number} is not a value of {self.text}: out of range") from None
        return _in_order(data, self.order)

    def decode(self, data: bytes) -> Value:
        """Return the number as the variable holds it."""
        (number,) = struct.unpack(f">{self.code}", _out_of_order(data, self.order))
        if isinstance(self.kind, Boolean):
            return bool(number)
        if isinstance(self.kind, Integer) and isinstance(number, float):
            if not isfinite(number):
                raise ValueError(f"{number} is not a value of {self.kind.name}")
            number = round(number)
        # Checked, and with its name if it has one.
        return self.kind.decode(self.kind.encode(number), 0)


class FieldTime(FieldType, frozen=True):
    """A time as another encoding of its nanoseconds."""

    to_bytes: Callable[[int], bytes]
    to_ns: Callable[[bytes], int]

    def encode(self, value: Value) -> bytes:
        """Return the bytes of a time."""
        tick_ns = _timed(self.kind).tick_ns
        ns = int.from_bytes(self.kind.encode(value), "little") * tick_ns
        try:
            return self.to_bytes(ns)
        except (OverflowError, struct.error):
            raise ValueError(f"{value} is not a value of {self.text}: out of range") from None

    def decode(self, data: bytes) -> Value:
        """Return the time, cut to the resolution of the variable."""
        ticks = self.to_ns(data) // _timed(self.kind).tick_ns
        try:
            octets = ticks.to_bytes(self.kind.size, "little")
        except OverflowError:
            raise ValueError(f"{data.hex()} ({self.text}) is no {self.kind.name}") from None
        return self.kind.decode(octets, 0)


def _timed(kind: DataType) -> Timed:
    if not isinstance(kind, Timed):
        raise TypeError(kind.text)
    return kind


class FieldText(FieldType, frozen=True):
    """A text: behind *head* bytes of maximal and actual length, or padded with zeros if 0."""

    encoding: str
    head: int = 0
    swap: bool = False
    """True if the two bytes of each register are exchanged."""

    def encode(self, value: Value) -> bytes:
        """Return the bytes of a text that fits."""
        unit = 2 if self.encoding.startswith("utf-16") else 1
        room = self.size - self.head
        try:
            octets = str(value).encode(self.encoding)
        except UnicodeEncodeError as exc:
            shown = f"{value!r}"[:60]
            raise ValueError(f"{shown} is no {self.text}: {exc.reason}") from None
        if len(octets) > room:
            raise ValueError(f"{value!r} is too long for {self.text}"[:120])
        code = {0: "", 2: ">BB", 4: ">HH"}[self.head]
        lengths = struct.pack(code, room // unit, len(octets) // unit) if code else b""
        data = (lengths + octets).ljust(self.size, b"\0")
        return _swapped(data) if self.swap else data

    def decode(self, data: bytes) -> Value:
        """Return the text."""
        if self.swap:
            data = _swapped(data)
        octets = data[self.head :]
        if self.head:
            unit = self.head // 2
            # A data block that was never written says more than it can hold.
            length = int.from_bytes(data[unit : self.head], "big")
            octets = octets[: length * unit]
        text = octets.decode(self.encoding, errors="replace").partition("\0")[0]
        return self.kind.decode(self.kind.encode(text), 0)


class FieldRaw(FieldType, frozen=True):
    """Bytes as they are."""

    def encode(self, value: Value) -> bytes:
        """Return the bytes, padded to a whole register."""
        return self.kind.encode(value).ljust(self.size, b"\0")

    def decode(self, data: bytes) -> Value:
        """Return the bytes."""
        return self.kind.decode(data[: self.kind.size], 0)


class FieldArray(FieldType, frozen=True):
    """Equal elements behind each other, *stride* bits apart."""

    element: FieldType
    stride: int

    def encode(self, value: Value) -> bytes:
        """Return the bytes of all elements."""
        octets, step = self.kind.encode(value), self.element.kind.size
        memory = bytearray(self.size)
        for number in range(self.kind.count):
            element = self.element.kind.decode(octets, number * step)
            put_bits(memory, number * self.stride, self.element.bits, self.element.encode(element))
        return bytes(memory)

    def decode(self, data: bytes) -> Value:
        """Return all elements."""
        octets = b"".join(
            self.element.kind.encode(
                self.element.decode(get_bits(data, number * self.stride, self.element.bits))
            )
            for number in range(self.kind.count)
        )
        return self.kind.decode(octets, 0)


class FieldMember(NamedTuple):
    """A member of a struct on the other side; *offset* in bits."""

    name: str
    type: FieldType
    offset: int


class FieldStruct(FieldType, frozen=True):
    """Members behind each other, each at its alignment."""

    members: tuple[FieldMember, ...]

    def encode(self, value: Value) -> bytes:
        """Return the bytes of all members."""
        memory = bytearray(self.size)
        for name, kind, offset in self.members:
            put_bits(memory, offset, kind.bits, kind.encode(value[name]))
        return bytes(memory)

    def decode(self, data: bytes) -> Value:
        """Return all members."""
        return {
            name: kind.decode(get_bits(data, offset, kind.bits))
            for name, kind, offset in self.members
        }


def get_bits(memory: bytes | bytearray, offset: int, bits: int) -> bytes:
    """Return a value of *bits* bits at bit *offset*; a single bit as bit 0 of a byte."""
    at, bit = divmod(offset, 8)
    if bits == 1:
        return bytes((memory[at] >> bit & 1,))
    return bytes(memory[at : at + bits // 8])


def put_bits(memory: bytearray, offset: int, bits: int, data: bytes) -> None:
    """Store a value as :func:`get_bits` returns it."""
    at, bit = divmod(offset, 8)
    if bits == 1:
        memory[at] = memory[at] & ~(1 << bit) | (data[0] & 1) << bit
    else:
        memory[at : at + bits // 8] = data


def aligned(offset: int, align: int) -> int:
    """Return the next multiple of *align* from *offset* on."""
    return offset + -offset % align


def _in_order(data: bytes, order: tuple[int, ...]) -> bytes:
    return bytes(data[each] for each in order) if order else data


def _out_of_order(data: bytes, order: tuple[int, ...]) -> bytes:
    if not order:
        return data
    plain = bytearray(len(data))
    for position, each in enumerate(order):
        plain[each] = data[position]
    return bytes(plain)


def _swapped(data: bytes) -> bytes:
    swapped = bytearray(data)
    swapped[0::2], swapped[1::2] = data[1::2], data[0::2]
    return bytes(swapped)


# --- S7

_S7_NUMBERS = {
    "BYTE": "B", "USINT": "B", "SINT": "b", "WORD": "H", "UINT": "H", "INT": "h",
    "DWORD": "I", "UDINT": "I", "DINT": "i", "LWORD": "Q", "ULINT": "Q", "LINT": "q",
    "REAL": "f", "LREAL": "d",
}  # fmt: skip
_OWN_NUMBERS = {
    (False, 1): "USINT", (False, 2): "UINT", (False, 4): "UDINT", (False, 8): "ULINT",
    (True, 1): "SINT", (True, 2): "INT", (True, 4): "DINT", (True, 8): "LINT",
}  # fmt: skip
_DATE_1990 = date(1990, 1, 1).toordinal() - _EPOCH
_S5_BASES_MS = (10, 100, 1_000, 10_000)


def _counted(code: str, tick_ns: int) -> tuple[Any, Any]:
    """Return the conversions of a count of ticks."""

    def to_bytes(ns: int) -> bytes:
        return struct.pack(code, ns // tick_ns)

    def to_ns(data: bytes) -> int:
        return int(struct.unpack(code, data)[0] * tick_ns)

    return to_bytes, to_ns


def _date_bytes(ns: int) -> bytes:
    # The zeros of a variable that has no date yet are those of S7.
    return struct.pack(">H", ns // _DAY - _DATE_1990 if ns else 0)


def _date_ns(data: bytes) -> int:
    return (int.from_bytes(data, "big") + _DATE_1990) * _DAY


def _dtl_bytes(ns: int) -> bytes:
    day = date.fromordinal(_EPOCH + ns // _DAY)
    seconds, nanoseconds = divmod(ns % _DAY, _S)
    # Day of the week: 1 is Sunday.
    clock = seconds // 3600, seconds // 60 % 60, seconds % 60
    fields = day.year, day.month, day.day, day.isoweekday() % 7 + 1, *clock, nanoseconds
    return struct.pack(">HBBBBBBI", *fields)


def _dtl_ns(data: bytes) -> int:
    year, month, day, _, hour, minute, second, nanoseconds = struct.unpack(">HBBBBBBI", data)
    return _ns_of(year, month, day, hour, minute, second) + int(nanoseconds)


def _bcd(number: int) -> int:
    return number // 10 << 4 | number % 10


def _from_bcd(octet: int) -> int:
    high, low = octet >> 4, octet & 0xF
    if high > 9 or low > 9:
        raise ValueError(f"{octet:#04x} is no BCD number")
    return 10 * high + low


def _dt_bytes(ns: int) -> bytes:
    day = date.fromordinal(_EPOCH + (ns // _DAY if ns else _DATE_1990))
    if not 1990 <= day.year < 2090:
        raise OverflowError
    seconds, rest = divmod(ns % _DAY, _S)
    ms = rest // _MS
    clock = seconds // 3600, seconds // 60 % 60, seconds % 60, ms // 10
    parts = [_bcd(each) for each in (day.year % 100, day.month, day.day, *clock)]
    return bytes((*parts, ms % 10 << 4 | day.isoweekday() % 7 + 1))


def _dt_ns(data: bytes) -> int:
    year, month, day, hour, minute, second, centi = (_from_bcd(each) for each in data[:7])
    ms = 10 * centi + (data[7] >> 4)
    # The two digits of a year are those of 1990 to 2089.
    year += 1900 if year >= 90 else 2000
    return _ns_of(year, month, day, hour, minute, second) + ms * _MS


def _ns_of(year: int, month: int, day: int, hour: int, minute: int, second: int) -> int:
    days = date(year, month, day).toordinal() - _EPOCH
    if hour > 23 or minute > 59 or second > 59:
        raise ValueError(f"{hour}:{minute}:{second} is no time of day")
    return days * _DAY + ((hour * 60 + minute) * 60 + second) * _S


def _s5_bytes(ns: int) -> bytes:
    ms = ns // _MS
    # The finest base that holds the time loses least of it.
    for number, base in enumerate(_S5_BASES_MS):
        if ms // base <= 999:
            count = ms // base
            return bytes((number << 4 | count // 100, _bcd(count % 100)))
    raise OverflowError


def _s5_ns(data: bytes) -> int:
    count = 100 * _from_bcd(data[0] & 0x0F) + _from_bcd(data[1])
    return count * _S5_BASES_MS[data[0] >> 4 & 3] * _MS


class _S7Time(NamedTuple):
    """Encoding of one type of times: the variables that it is for, size, conversions."""

    family: type[Timed]
    size: int
    codec: tuple[Callable[[int], bytes], Callable[[bytes], int]]


_S7_TIMES = {
    "TIME": _S7Time(Duration, 4, _counted(">i", _MS)),
    "LTIME": _S7Time(Duration, 8, _counted(">q", 1)),
    "S5TIME": _S7Time(Duration, 2, (_s5_bytes, _s5_ns)),
    "TOD": _S7Time(TimeOfDay, 4, _counted(">I", _MS)),
    "LTOD": _S7Time(TimeOfDay, 8, _counted(">Q", 1)),
    "DATE": _S7Time(CalendarDate, 2, (_date_bytes, _date_ns)),
    "DTL": _S7Time(DateAndTime, 12, (_dtl_bytes, _dtl_ns)),
    "DATE_AND_TIME": _S7Time(DateAndTime, 8, (_dt_bytes, _dt_ns)),
    "LDT": _S7Time(DateAndTime, 8, _counted(">q", 1)),
}
_S7_ALIASES = {
    "DT": "DATE_AND_TIME", "TIME_OF_DAY": "TOD", "LTIME_OF_DAY": "LTOD", "BOOLEAN": "BOOL",
}  # fmt: skip
_OWN_TIMES = {
    "TIME": "TIME", "LTIME": "LTIME", "TOD": "TOD", "LTOD": "LTOD", "DATE": "DATE",
    "LDATE": "DATE", "DT": "DTL", "LDT": "LDT",
}  # fmt: skip
_MAX_STRING, _MAX_WSTRING = 254, 16_382


def s7_type(kind: DataType, text: str = "") -> FieldType:
    """Return the type that a variable of type *kind* has in an S7 controller.

    Args:
        kind: Type of the variable.
        text: Name of another S7 type for its values, such as ``INT``, ``STRING[20]`` or ``DTL``.

    Raises:
        ValueError: there is no such S7 type, or it does not have these values.
    """
    plain = _plain(kind)
    if text:
        return _s7_named(plain, text)
    for family, make in _S7_FAMILIES:
        if isinstance(plain, family):
            return make(plain)
    return _s7_number(plain, plain.text if plain.text in _S7_NUMBERS else _number_name(plain))


def _s7_array(kind: Array) -> FieldType:
    element = s7_type(kind.element)
    stride = 1 if element.bits == 1 else aligned(element.bits, element.align)
    return _array(kind, element, stride, f"ARRAY OF {element.text}")


def _s7_block(kind: Block) -> FieldType:
    bits = 16 * -(-kind.size // 2)
    return FieldRaw(kind=kind, text=f"ARRAY OF BYTE ({kind.size})", bits=bits)


def _s7_bool(kind: Boolean) -> FieldType:
    return FieldBit(kind=kind, text="BOOL", bits=1, align=1)


_S7_FAMILIES: tuple[tuple[type[DataType], Callable[[Any], FieldType]], ...] = (
    (Array, _s7_array),
    (Structure, lambda kind: _struct(kind, s7_type)),
    (Boolean, _s7_bool),
    (Timed, lambda kind: _s7_time(kind, _OWN_TIMES[kind.text])),
    (String, lambda kind: _s7_string(kind, "STRING", kind.size)),
    (WideString, lambda kind: _s7_string(kind, "WSTRING", kind.size // 2 - 1)),
    (WideChar, lambda kind: FieldText(kind=kind, text="WCHAR", bits=16, encoding="utf-16-be")),
    (Block, _s7_block),
)


def _s7_named(kind: DataType, text: str) -> FieldType:
    # STRING[20] is the form of S7, STRING(20) that of plant files.
    upper = text.strip().upper().replace("(", "[").replace(")", "]")
    name, _, length = upper.partition("[")
    name = _S7_ALIASES.get(name.strip(), name.strip())
    if name in {"STRING", "WSTRING"} and isinstance(kind, Text):
        digits = length.removesuffix("]").strip()
        if not digits.isdecimal() or len(digits) > 5:
            raise ValueError(f"{text!r} lacks its length: expected for example {name}[20]")
        return _s7_string(kind, name, int(digits))
    if name == "CHAR" and isinstance(kind, Text) and not length:
        return FieldText(kind=kind, text=name, bits=8, align=8, encoding="latin-1")
    if name == "BOOL" and isinstance(kind, Boolean):
        return FieldBit(kind=kind, text=name, bits=1, align=1)
    if name in _S7_NUMBERS and not length:
        return _s7_number(kind, name)
    if name in _S7_TIMES and isinstance(kind, _S7_TIMES[name].family):
        return _s7_time(kind, name)
    known = ("BOOL", "CHAR", "STRING", "WSTRING", *_S7_NUMBERS, *_S7_TIMES)
    if name not in known:
        near = nearest_in_any_case(name, known)
        raise ValueError(f"{text!r} is no S7 type" + (f", did you mean {near}?" if near else ""))
    raise ValueError(f"a variable of {kind.name} does not hold {name}")


def _s7_time(kind: DataType, name: str) -> FieldType:
    _, size, (to_bytes, to_ns) = _S7_TIMES[name]
    return FieldTime(kind=kind, text=name, bits=8 * size, to_bytes=to_bytes, to_ns=to_ns)


def _s7_string(kind: DataType, name: str, length: int) -> FieldType:
    most = _MAX_STRING if name == "STRING" else _MAX_WSTRING
    if not 1 <= length <= most:
        raise ValueError(f"{name}[{length}]: an S7 {name} has 1 to {most} characters")
    head, unit, encoding = (2, 1, "latin-1") if name == "STRING" else (4, 2, "utf-16-be")
    bits = 8 * (head + unit * length)
    return FieldText(kind=kind, text=f"{name}[{length}]", bits=bits, encoding=encoding, head=head)


def _s7_number(kind: DataType, name: str) -> FieldType:
    _check_number(kind, name)
    code = _S7_NUMBERS[name]
    bits = 8 * struct.calcsize(code)
    return FieldNumber(kind=kind, text=name, bits=bits, align=min(bits, 16), code=code)


# --- Modbus


def modbus_type(
    kind: DataType, text: str = "", *, words_swapped: bool = False, bytes_swapped: bool = False
) -> FieldType:
    """Return the type that a variable of type *kind* has in 16-bit registers.

    Args:
        kind: Type of the variable.
        text: Name of another number type, such as ``INT`` or ``UDINT``.
        words_swapped: True if the register with the lowest bits comes first.
        bytes_swapped: True if the low byte of a register comes first.

    Raises:
        ValueError: there is no such type, or it does not have these values.
    """
    plain = _plain(kind)
    orders = _Orders(words_swapped, bytes_swapped)
    if not text:
        return _registers(plain, orders)
    name = text.strip().upper()
    if name not in _S7_NUMBERS:
        near = nearest_in_any_case(name, _S7_NUMBERS)
        hint = f", did you mean {near}?" if near else ""
        raise ValueError(f"{text!r} is no type of registers{hint}")
    return _register_number(plain, name, orders)


class _Orders(NamedTuple):
    """Differences to big-endian registers."""

    words_swapped: bool
    bytes_swapped: bool

    def order(self, size: int) -> tuple[int, ...]:
        """Return the positions of the big-endian bytes of a number, nothing if they stay."""
        registers = [(at, at + 1) for at in range(0, size, 2)]
        if self.words_swapped:
            registers.reverse()
        if self.bytes_swapped:
            registers = [(low, high) for high, low in registers]
        order = tuple(each for register in registers for each in register)
        return () if order == tuple(range(size)) else order


def _registers(kind: DataType, orders: _Orders) -> FieldType:
    plain = _plain(kind)
    for family, make in _REGISTER_FAMILIES:
        if isinstance(plain, family):
            return make(plain, orders)
    name = plain.text if plain.text in _S7_NUMBERS else _number_name(plain)
    return _register_number(plain, name, orders)


def _register_array(kind: Array, orders: _Orders) -> FieldType:
    element = _registers(kind.element, orders)
    return _array(kind, element, element.bits, f"{element.text}[{kind.count}]")


def _register_text(kind: DataType, orders: _Orders) -> FieldType:
    encoding = "utf-8" if isinstance(kind, String) else "utf-16-be"
    bits, swap = 16 * -(-kind.size // 2), orders.bytes_swapped
    return FieldText(kind=kind, text=kind.name, bits=bits, encoding=encoding, swap=swap)


def _register_block(kind: Block, _: _Orders) -> FieldType:
    return FieldRaw(kind=kind, text=kind.name, bits=16 * -(-kind.size // 2))


def _register_time(kind: Timed, orders: _Orders) -> FieldType:
    to_bytes, to_ns = _counted(">I" if kind.size == 4 else ">Q", kind.tick_ns)
    order = orders.order(kind.size)
    return FieldTime(
        kind=kind,
        text=kind.name,
        bits=8 * kind.size,
        to_bytes=lambda ns: _in_order(to_bytes(ns), order),
        to_ns=lambda data: to_ns(_out_of_order(data, order)),
    )


_REGISTER_FAMILIES: tuple[tuple[Any, Callable[[Any, _Orders], FieldType]], ...] = (
    (Array, _register_array),
    (Structure, lambda kind, orders: _struct(kind, lambda each: _registers(each, orders))),
    (Text | WideChar, _register_text),
    (Block, _register_block),
    (Boolean, lambda kind, orders: _register_number(kind, "UINT", orders)),
    (Timed, _register_time),
)


def coil_type(kind: DataType) -> FieldType:
    """Return the type of a single bit: a coil, a discrete input or a bit of a register.

    Raises:
        ValueError: *kind* is no BOOL.
    """
    plain = _plain(kind)
    is_bit = isinstance(plain, Boolean)
    if not is_bit:
        raise ValueError(f"a variable of {kind.name} is no single bit: expected BOOL")
    return FieldBit(kind=plain, text="BOOL", bits=1, align=1)


def _register_number(kind: DataType, name: str, orders: _Orders) -> FieldType:
    _check_number(kind, name)
    code = _S7_NUMBERS[name]
    # A number of one byte has a register, too.
    code = {"B": "H", "b": "h"}.get(code, code)
    size = struct.calcsize(code)
    order = orders.order(size)
    return FieldNumber(kind=kind, text=name, bits=8 * size, code=code, order=order)


# --- both


def _plain(kind: DataType) -> DataType:
    """Return the type behind its other names."""
    while kind.alias_of is not None:
        kind = kind.alias_of
    return kind


def _number_name(kind: DataType) -> str:
    """Return the number type with the values of *kind*: of enumerations, subranges, bit fields."""
    name: str | None = None
    if isinstance(kind, Real):
        name = "REAL" if kind.size == 4 else "LREAL"
    elif isinstance(kind, Integer):
        name = _OWN_NUMBERS.get((kind.signed, kind.size))
    if name is None:
        raise ValueError(f"{kind.name} has no counterpart: expected a type of 1, 2, 4 or 8 bytes")
    return name


def _check_number(kind: DataType, name: str) -> None:
    is_number = isinstance(kind, Integer | Real | Boolean) and not isinstance(kind, Timed)
    if not is_number:
        raise ValueError(f"a variable of {kind.name} does not hold {name}")


def _array(kind: Array, element: FieldType, stride: int, text: str) -> FieldArray:
    bits = aligned(stride * kind.count, 16)
    return FieldArray(kind=kind, text=text, bits=bits, element=element, stride=stride)


def _struct(kind: Structure, convert: Callable[[DataType], FieldType]) -> FieldStruct:
    starts = [each.bit_offset for each in kind.members]
    # Which of the members the other side means is not in the bytes.
    if len(starts) > 1 and not any(starts):
        raise ValueError(f"{kind.name} is a union: expected a struct, or one of its members")
    members, end = [], 0
    for member in kind.members:
        # A bit of a struct is a BOOL of its own on the other side.
        is_bit = member.kind.is_bits and member.kind.bit_length == 1
        plain = datatypes.parse("BOOL8") if is_bit else member.kind
        field = convert(plain)
        start = aligned(end, field.align)
        members.append(FieldMember(member.name, field, start))
        end = start + field.bits
    return FieldStruct(kind=kind, text="STRUCT", bits=aligned(end, 16), members=tuple(members))
