"""Data types of variables as those of OPC UA, and their values in both directions.

Values of the plant are plain ones, as the control protocol has them.  A struct is an extension
object with the binary encoding of its members, which is made here, so that no class has to be made
for each struct.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from enum import IntEnum
from functools import lru_cache
from hashlib import sha256
from math import isfinite, nan, prod
from typing import Any, NamedTuple, TypeAlias

from eap.codec.arrays import Array
from eap.codec.basetypes import Block, Boolean, DataType, Integer, Plain, Real
from eap.codec.enumerations import Enumeration
from eap.codec.structures import Structure
from eap.codec.times import CalendarDate, DateAndTime, Timed, TimeOfDay

DURATION = 290
"""Data type Duration: milliseconds as a Double."""
SCALAR = -1
"""Value rank of a single value."""

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EPOCH_TICKS = 116_444_736_000_000_000
"""Units of 100 ns from 1601, where DateTime begins, to 1970."""
_MS, _TICK = 1_000_000, 100
_DAY = 86_400_000 * _MS


class BuiltIn(IntEnum):
    """Built-in types by their numbers, which are also those of their data types."""

    BOOLEAN = 1
    SBYTE = 2
    BYTE = 3
    INT16 = 4
    UINT16 = 5
    INT32 = 6
    UINT32 = 7
    INT64 = 8
    UINT64 = 9
    FLOAT = 10
    DOUBLE = 11
    STRING = 12
    DATETIME = 13
    BYTESTRING = 15
    EXTENSION_OBJECT = 22


class UaType(NamedTuple):
    """Data type of a node.

    Attributes:
        built_in: Built-in type of the values.
        data_type: Number in the namespace of OPC UA, or the definition of this plant.
        rank: Value rank: SCALAR, or the number of dimensions.
        dimensions: Elements of each dimension.
    """

    built_in: BuiltIn
    data_type: int | Definition
    rank: int = SCALAR
    dimensions: tuple[int, ...] = ()


class Field(NamedTuple):
    """Member of a structure; an array of several dimensions is a flat one here."""

    name: str
    type: UaType


class Definition(NamedTuple):
    """Data type of this plant: a structure with *fields*, or an enumeration with *names*."""

    node_id: str
    name: str
    fields: tuple[Field, ...] = ()
    names: tuple[tuple[int, str], ...] = ()

    @property
    def encoding_id(self) -> str:
        """Node of the binary encoding of a structure."""
        return f"{self.node_id}/binary"


MISMATCH = AttributeError, KeyError, OverflowError, TypeError, ValueError, struct.error
"""Exceptions of conversions: the value is none of the type."""
Unpacked: TypeAlias = tuple[Any, int]
"""Plain value, and the position behind it."""


class Converter(NamedTuple):
    """Conversions of the values of one type.

    Attributes:
        type: Its data type.
        from_plain: Converts a plain value to that of a Variant; a struct is its encoded members.
        to_plain: Converts the value of a Variant that a client wrote.
        pack: Encodes a plain value as a member of a structure.
        unpack: Decodes a member at a position.

    All raise one of MISMATCH for a value that the type does not have.
    """

    type: UaType
    from_plain: Callable[[Any], Any]
    to_plain: Callable[[Any], Plain]
    pack: Callable[[Any], bytes]
    unpack: Callable[[bytes, int], Unpacked]


_FORMATS = {
    BuiltIn.BOOLEAN: "<?", BuiltIn.SBYTE: "<b", BuiltIn.BYTE: "<B", BuiltIn.INT16: "<h",
    BuiltIn.UINT16: "<H", BuiltIn.INT32: "<i", BuiltIn.UINT32: "<I", BuiltIn.INT64: "<q",
    BuiltIn.UINT64: "<Q", BuiltIn.FLOAT: "<f", BuiltIn.DOUBLE: "<d", BuiltIn.DATETIME: "<q",
}  # fmt: skip
_INTEGERS = (
    (8, BuiltIn.SBYTE, BuiltIn.BYTE),
    (16, BuiltIn.INT16, BuiltIn.UINT16),
    (32, BuiltIn.INT32, BuiltIn.UINT32),
    (64, BuiltIn.INT64, BuiltIn.UINT64),
)
_length = struct.Struct("<i")


@lru_cache(maxsize=4096)
def converter(kind: DataType) -> Converter:
    """Return the conversions of a type."""
    # The first that fits: an enumeration and a time are integers, too.
    made = (make(kind) for type_, make in _MAKERS if isinstance(kind, type_))
    return next(made, None) or _text()


def _integer_type(kind: Integer) -> BuiltIn:
    return next(s if kind.signed else u for bits, s, u in _INTEGERS if kind.bit_length <= bits)


def _packed(
    built_in: BuiltIn, encode: Callable[[Any], Any], decode: Callable[[Any], Plain]
) -> tuple[Callable[[Any], bytes], Callable[[bytes, int], Unpacked]]:
    """Return pack and unpack of a type of fixed length."""
    coder = struct.Struct(_FORMATS[built_in])

    def unpack(data: bytes, at: int) -> Unpacked:
        return decode(coder.unpack_from(data, at)[0]), at + coder.size

    return lambda plain: coder.pack(encode(plain)), unpack


def _checked(built_in: BuiltIn) -> Callable[[Any], Any]:
    """Return a function that returns a number if it is one of the type, and raises if not."""
    coder = struct.Struct(_FORMATS[built_in])

    def number(value: Any) -> Any:
        if (built_in is BuiltIn.BOOLEAN) is not isinstance(value, bool):
            raise ValueError(f"{value!r} is no {built_in.name}")
        coder.pack(value)
        return value

    return number


def _number(built_in: BuiltIn) -> Converter:
    checked = _checked(built_in)
    pack, unpack = _packed(built_in, checked, checked)
    return Converter(UaType(built_in, built_in), checked, checked, pack, unpack)


def _real(kind: Real) -> Converter:
    built_in = BuiltIn.FLOAT if kind.size == 4 else BuiltIn.DOUBLE

    # JSON has neither infinities nor NaN: the control protocol shows them as null.
    checked = _checked(built_in)

    def from_plain(plain: Any) -> Any:
        return nan if plain is None else checked(plain)

    def to_plain(value: Any) -> Plain:
        if not isfinite(checked(value)):
            raise ValueError(f"{value} is not a finite number")
        return float(value)

    pack, unpack = _packed(built_in, from_plain, to_plain)
    return Converter(UaType(built_in, built_in), from_plain, to_plain, pack, unpack)


def _enumeration(kind: Enumeration) -> Converter:
    is_small = kind.bit_length < 32 or (kind.bit_length == 32 and kind.signed)
    built_in = BuiltIn.INT32 if is_small else _integer_type(kind)
    checked = _checked(built_in)

    def from_plain(plain: Any) -> Any:
        return kind.numbers[plain] if isinstance(plain, str) else checked(plain)

    def to_plain(value: Any) -> Plain:
        plain: Plain = kind.names.get(value, value)
        return plain

    definition = Definition(_node_id(kind), kind.name, names=tuple(sorted(kind.names.items())))
    pack, unpack = _packed(built_in, from_plain, to_plain)
    # An enumeration is an Int32: one that has larger numbers is shown as a number.
    data_type: int | Definition = definition if is_small else built_in
    return Converter(UaType(built_in, data_type), from_plain, to_plain, pack, unpack)


def _time(kind: Timed) -> Converter:
    def nanoseconds(plain: Any) -> int:
        return int.from_bytes(kind.encode(plain), "little") * kind.tick_ns

    def text(ns: int) -> Plain:
        number = ns // kind.tick_ns
        is_late = isinstance(kind, TimeOfDay) and ns >= _DAY
        if ns < 0 or number >> kind.bit_length or is_late:
            raise ValueError(f"{ns} ns are no {kind.name}")
        return kind.to_plain(kind.decode(number.to_bytes(kind.size, "little"), 0))

    if isinstance(kind, CalendarDate | DateAndTime):

        def date_of(plain: Any) -> datetime:
            return _EPOCH + timedelta(microseconds=nanoseconds(plain) // 1000)

        def from_date(value: Any) -> Plain:
            given = value if value.tzinfo else value.replace(tzinfo=UTC)
            return text((given - _EPOCH) // timedelta(microseconds=1) * 1000)

        pack, unpack = _packed(
            BuiltIn.DATETIME,
            lambda plain: nanoseconds(plain) // _TICK + _EPOCH_TICKS,
            lambda ticks: text((ticks - _EPOCH_TICKS) * _TICK),
        )
        kind_of = UaType(BuiltIn.DATETIME, BuiltIn.DATETIME)
        return Converter(kind_of, date_of, from_date, pack, unpack)

    def milliseconds(plain: Any) -> float:
        return nanoseconds(plain) / _MS

    def from_milliseconds(value: Any) -> Plain:
        if not isfinite(value):
            raise ValueError(f"{value} ms are no {kind.name}")
        return text(round(value * _MS))

    pack, unpack = _packed(BuiltIn.DOUBLE, milliseconds, from_milliseconds)
    kind_of = UaType(BuiltIn.DOUBLE, DURATION)
    return Converter(kind_of, milliseconds, from_milliseconds, pack, unpack)


def _text() -> Converter:
    def to_plain(value: Any) -> Plain:
        return "" if value is None else str(value)

    def unpack(data: bytes, at: int) -> Unpacked:
        found, end = _sized(data, at)
        return found.decode(), end

    def from_plain(plain: Any) -> str:
        if not isinstance(plain, str):
            raise TypeError(f"{plain!r} is no text")
        return plain

    kind_of = UaType(BuiltIn.STRING, BuiltIn.STRING)
    return Converter(
        kind_of, from_plain, to_plain, lambda plain: _with_length(plain.encode()), unpack
    )


def _bytes(kind: DataType, from_plain: Callable[[Any], bytes]) -> Converter:
    def to_plain(value: Any) -> Plain:
        if len(value) != kind.size:
            raise ValueError(f"{len(value)} bytes are no {kind.name}")
        return kind.to_plain(kind.decode(value, 0))

    def unpack(data: bytes, at: int) -> Unpacked:
        found, end = _sized(data, at)
        return to_plain(found), end

    kind_of = UaType(BuiltIn.BYTESTRING, BuiltIn.BYTESTRING)
    return Converter(
        kind_of, from_plain, to_plain, lambda plain: _with_length(from_plain(plain)), unpack
    )


def _with_length(data: bytes) -> bytes:
    return _length.pack(len(data)) + data


def _sized(data: bytes, at: int) -> tuple[bytes, int]:
    start = at + _length.size
    length = max(_length.unpack_from(data, at)[0], 0)
    if start + length > len(data):
        raise ValueError("the structure ends within a text")
    return data[start : start + length], start + length


def _array(kind: Array) -> Converter:
    element = converter(kind.element)
    sizes = tuple(each.size for each in kind.dimensions)

    def from_plain(plain: Any) -> list[Any]:
        return _mapped(plain, len(sizes), element.from_plain)

    def to_plain(value: Any) -> Plain:
        _check_shape(value, sizes)
        return _mapped(value, len(sizes), element.to_plain)

    def pack(plain: Any) -> bytes:
        flat = _flattened(plain, len(sizes))
        return _length.pack(len(flat)) + b"".join(map(element.pack, flat))

    def unpack(data: bytes, at: int) -> Unpacked:
        count = _length.unpack_from(data, at)[0]
        if count != kind.count:
            raise ValueError(f"{count} elements are no {kind.name}")
        at += _length.size
        flat: list[Any] = []
        for _ in range(count):
            item, at = element.unpack(data, at)
            flat.append(item)
        return _rows(flat, sizes), at

    kind_of = element.type._replace(rank=len(sizes), dimensions=sizes)
    return Converter(kind_of, from_plain, to_plain, pack, unpack)


def _mapped(value: Any, levels: int, convert: Callable[[Any], Any]) -> list[Any]:
    if levels == 1:
        return [convert(each) for each in value]
    return [_mapped(each, levels - 1, convert) for each in value]


def _flattened(value: Any, levels: int) -> list[Any]:
    items = list(value)
    for _ in range(levels - 1):
        items = [each for item in items for each in item]
    return items


def _rows(items: list[Any], sizes: Sequence[int]) -> list[Any]:
    for size in reversed(sizes[1:]):
        items = [items[at : at + size] for at in range(0, len(items), size)]
    return items


def _check_shape(value: Any, sizes: Sequence[int]) -> None:
    if not isinstance(value, list) or len(value) != sizes[0]:
        found = len(value) if isinstance(value, list) else "no"
        raise ValueError(f"{found} elements, expected {sizes[0]}")
    if len(sizes) > 1:
        for each in value:
            _check_shape(each, sizes[1:])


def _structure(kind: Structure) -> Converter:
    members = [(each.name, converter(each.kind)) for each in kind.members]
    fields = tuple(Field(name, _flat_type(each.type)) for name, each in members)

    def pack(plain: Any) -> bytes:
        return b"".join([each.pack(plain[name]) for name, each in members])

    def unpack(data: bytes, at: int) -> Unpacked:
        found = {}
        for name, each in members:
            found[name], at = each.unpack(data, at)
        return found, at

    def to_plain(value: Any) -> Plain:
        found, end = unpack(value, 0)
        if end != len(value):
            raise ValueError(f"{len(value)} bytes are no {kind.name}: it has {end}")
        plain: Plain = found
        return plain

    definition = Definition(_node_id(kind), kind.name, fields)
    kind_of = UaType(BuiltIn.EXTENSION_OBJECT, definition)
    return Converter(kind_of, pack, to_plain, pack, unpack)


def _flat_type(kind: UaType) -> UaType:
    # Clients disagree about arrays of several dimensions within structures.
    return kind if kind.rank <= 1 else kind._replace(rank=1, dimensions=(prod(kind.dimensions),))


def _node_id(kind: DataType) -> str:
    # Clients keep definitions by their node: another definition must be another node.
    return f"type:{kind.name}:{sha256(kind.wire.encode()).hexdigest()[:8]}"


def _structure_or_union(kind: Structure) -> Converter:
    if kind.is_union:
        # A union of OPC UA is one of its members; here all of them are read.
        return _bytes(kind, lambda plain: kind.encode(kind.from_plain(plain)))
    return _structure(kind)


def _block(kind: Block) -> Converter:
    return _bytes(kind, bytes.fromhex)


def _integer(kind: Integer | Boolean) -> Converter:
    return _number(_integer_type(kind) if isinstance(kind, Integer) else BuiltIn.BOOLEAN)


_MAKERS: tuple[tuple[type[DataType], Callable[[Any], Converter]], ...] = (
    (Structure, _structure_or_union),
    (Array, _array),
    (Enumeration, _enumeration),
    (Timed, _time),
    (Block, _block),
    (Boolean, _integer),
    (Integer, _integer),
    (Real, _real),
)


def definitions_of(kind: UaType) -> list[Definition]:
    """Return the definitions that a type needs, those that others refer to first, each once."""
    if not isinstance(definition := kind.data_type, Definition):
        return []
    found = {each: None for field in definition.fields for each in definitions_of(field.type)}
    return [*found, definition]
