"""Values of one station in one cycle as a protobuf message, and the schema of these messages.

Every number has a protobuf type of fixed size (``fixed32`` also for 8 and 16 bits), so that the
place of each value in a message is known beforehand: a message is one ``struct.pack``, and reading
it is one ``struct.unpack``.  Texts vary in length; variables with texts follow behind all others.

A :class:`StationMessages` is made of variables with their places in a sample of the process image.
The encoding is that of protocolbuffers' "Encoding" page; other programs read the messages by the
``FileDescriptorSet`` that :meth:`StationMessages.descriptor` returns.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from enum import IntEnum
from itertools import chain
from typing import Any, NamedTuple, TypeAlias

from msgspec import Struct

from eap.codec import datatypes
from eap.codec.arrays import Array
from eap.codec.basetypes import Block, Boolean, DataType, Integer, Real, Text, WideChar
from eap.codec.protobuf import FIXED32, FIXED64, LENGTH, VARINT, encode_field, encode_tag, varint
from eap.codec.structures import Structure
from eap.errors import MalformedError

PACKAGE = "eap"
CYCLE_FIELD = "cycle_number"
_RESERVED = range(19_000, 20_000)
"""Field numbers that protobuf keeps for itself."""


class ProtobufType(IntEnum):
    """Types of fields: ``google.protobuf.FieldDescriptorProto.Type``."""

    DOUBLE = 1
    FLOAT = 2
    FIXED64 = 6
    FIXED32 = 7
    BOOL = 8
    STRING = 9
    MESSAGE = 11
    BYTES = 12
    SFIXED32 = 15
    SFIXED64 = 16


_WIRE = {
    ProtobufType.DOUBLE: (FIXED64, 8, "d"),
    ProtobufType.FLOAT: (FIXED32, 4, "f"),
    ProtobufType.FIXED64: (FIXED64, 8, "Q"),
    ProtobufType.FIXED32: (FIXED32, 4, "I"),
    ProtobufType.BOOL: (VARINT, 1, "?"),
    ProtobufType.SFIXED32: (FIXED32, 4, "i"),
    ProtobufType.SFIXED64: (FIXED64, 8, "q"),
}
"""Wire type, bytes, and code of ``struct``, of the types of numbers."""


class RecordedVariable(Struct, frozen=True):
    """One variable of a recording; *type* is the complete text of its data type."""

    name: str
    type: str
    unit: str = ""


class Leaf(NamedTuple):
    """One value without parts: *path* is its name from the variable on, such as ``axis.load[2]``.

    *bit_offset* counts from the start of a sample.
    """

    path: str
    kind: DataType
    bit_offset: int


class _PartGroup(NamedTuple):
    """A value of variable length, or of several parts: tag, then its length, then its parts."""

    tag: bytes
    parts: list[_Part]


_Part: TypeAlias = "bytes | Leaf | _PartGroup"


_PROTOBUF_TYPES: tuple[tuple[type[DataType], ProtobufType], ...] = (
    (Boolean, ProtobufType.BOOL),
    (Block, ProtobufType.BYTES),
    (Text, ProtobufType.STRING),
    (WideChar, ProtobufType.STRING),
    (Structure, ProtobufType.MESSAGE),
)


def field_type(kind: DataType) -> ProtobufType:
    """Return the protobuf type of a value without parts."""
    if isinstance(kind, Real):
        return ProtobufType.FLOAT if kind.size == 4 else ProtobufType.DOUBLE
    for python_type, field in _PROTOBUF_TYPES:
        if isinstance(kind, python_type):
            return field
    is_signed = isinstance(kind, Integer) and kind.signed
    if kind.size <= 4:
        return ProtobufType.SFIXED32 if is_signed else ProtobufType.FIXED32
    return ProtobufType.SFIXED64 if is_signed else ProtobufType.FIXED64


def field_names(names: Iterable[str], taken: Iterable[str] = ()) -> list[str]:
    """Return an identifier for each of *names*, all different: ``axis.load`` is ``axis_load``."""
    used = set(taken)
    found = []
    for name in names:
        base = re.sub(r"\W", "_", name, flags=re.ASCII)
        base = f"_{base}" if not base or base[0].isdigit() else base
        field, number = base, 1
        # a.b and a_b have the same identifier.
        while field in used:
            number += 1
            field = f"{base}_{number}"
        used.add(field)
        found.append(field)
    return found


def _field_numbers(first: int) -> Iterator[int]:
    number = first
    while True:
        # protoc refuses a schema that uses them.
        if number == _RESERVED.start:
            number = _RESERVED.stop
        yield number
        number += 1


def _element_of(kind: DataType) -> tuple[DataType, list[str]]:
    """Return the innermost element of an array, and the indexes of each of them as text."""
    indexes = [""]
    while isinstance(kind, Array):
        own = [""]
        for low, count in kind.dimensions:
            own = [
                f"{before},{at}" if before else str(at)
                for before in own
                for at in range(low, low + count)
            ]
        indexes = [f"{outer}[{index}]" for outer in indexes for index in own]
        kind = kind.element
    return kind, indexes


def _parts(number: int, path: str, kind: DataType, bit_offset: int) -> Iterator[_Part]:
    """Yield the parts of one field."""
    element, indexes = _element_of(kind)
    wire = _WIRE.get(field_type(element))
    leaves = (
        Leaf(path + index, element, bit_offset + 8 * element.size * position)
        for position, index in enumerate(indexes)
    )
    if wire is None:
        for leaf in leaves:
            yield _PartGroup(encode_tag(number, LENGTH), list(_content(leaf)))
    elif isinstance(kind, Array):
        yield _PartGroup(encode_tag(number, LENGTH), list(leaves))
    else:
        yield encode_tag(number, wire[0])
        yield from leaves


def _content(leaf: Leaf) -> Iterator[_Part]:
    if not isinstance(leaf.kind, Structure):
        yield leaf
        return
    for number, member in enumerate(leaf.kind.members, start=1):
        path = f"{leaf.path}.{member.name}"
        yield from _parts(number, path, member.kind, leaf.bit_offset + member.bit_offset)


def _fixed_size(part: _Part) -> int | None:
    """Return the bytes that a part always takes, None if it varies."""
    if isinstance(part, bytes):
        return len(part)
    if isinstance(part, Leaf):
        if isinstance(part.kind, Block):
            return part.kind.size
        wire = _WIRE.get(field_type(part.kind))
        return wire[1] if wire else None
    inner = _fixed_sizes(part.parts)
    return None if inner is None else len(part.tag) + len(varint(inner)) + inner


def _fixed_sizes(parts: Iterable[_Part]) -> int | None:
    total = 0
    for part in parts:
        size = _fixed_size(part)
        if size is None:
            return None
        total += size
    return total


def _flatten(parts: Iterable[_Part]) -> Iterator[bytes | Leaf]:
    """Yield parts of fixed size without groups."""
    for part in parts:
        if isinstance(part, _PartGroup):
            size = _fixed_sizes(part.parts)
            assert size is not None  # noqa: S101  callers pass parts of fixed size only
            yield part.tag + varint(size)
            yield from _flatten(part.parts)
        else:
            yield part


def read_leaf(leaf: Leaf, sample: bytes) -> Any:
    """Return the number, text or bytes of *leaf* in *sample*, as it goes into a message."""
    offset, bit = divmod(leaf.bit_offset, 8)
    kind = leaf.kind
    if kind.is_bits:
        # A bit field of up to 8 bits may reach into the next byte.
        word = int.from_bytes(sample[offset : offset + 2], "little") >> bit
        number = word & (1 << kind.bit_length) - 1
        return bool(number) if isinstance(kind, Boolean) else number
    octets = sample[offset : offset + kind.size]
    if isinstance(kind, Block):
        return octets
    if isinstance(kind, Boolean | Real | Text | WideChar):
        return kind.decode(octets, 0)
    return int.from_bytes(octets, "little", signed=isinstance(kind, Integer) and kind.signed)


def write_leaf(leaf: Leaf, sample: bytearray, value: Any) -> None:
    """Put a value of a message into *sample*, without touching the bits beside it."""
    offset, bit = divmod(leaf.bit_offset, 8)
    kind = leaf.kind
    if kind.is_bits:
        mask = (1 << kind.bit_length) - 1 << bit
        word = int.from_bytes(sample[offset : offset + 2], "little")
        word = word & ~mask | int(value) << bit & mask
        size = min(2, len(sample) - offset)
        sample[offset : offset + size] = word.to_bytes(2, "little")[:size]
    elif isinstance(kind, Text | WideChar):
        encoding = kind.encoding if isinstance(kind, Text) else "utf-16-le"
        # Cut, where bytes that were no text became longer when they were read.
        octets = value.encode(encoding, "replace")[: kind.size]
        sample[offset : offset + kind.size] = octets.ljust(kind.size, b"\0")
    elif isinstance(kind, Block | Boolean | Real):
        sample[offset : offset + kind.size] = kind.encode(value)
    else:
        # Eight bytes for all, then cut: so a type without sign takes the same way.
        octets = int(value).to_bytes(8, "little", signed=value < 0)
        sample[offset : offset + kind.size] = octets[: kind.size]


_SAMPLE_CODES = {
    # REAL as a number of 32 bits: a conversion to double and back may change a NaN.
    ProtobufType.DOUBLE: {8: "d"},
    ProtobufType.FLOAT: {4: "I"},
    ProtobufType.FIXED64: {8: "Q"},
    ProtobufType.FIXED32: {1: "B", 2: "H", 4: "I"},
    ProtobufType.BOOL: {1: "?"},
    ProtobufType.SFIXED32: {1: "b", 2: "h", 4: "i"},
    ProtobufType.SFIXED64: {8: "q"},
}
"""Codes of ``struct`` for a value in a sample, by type and size."""


def _is_copied(leaf: Leaf) -> bool:
    """Return whether sample and message have the same bytes for *leaf*."""
    kind = field_type(leaf.kind)
    # Bits have to be shifted to their place.
    if leaf.kind.is_bits or leaf.bit_offset % 8:
        return False
    if kind is ProtobufType.BYTES:
        return True
    wire = _WIRE.get(kind)
    return wire is not None and kind is not ProtobufType.BOOL and leaf.kind.size == wire[1]


class _Packer:
    """Messages of variables of fixed size: one unpack of the sample, one pack."""

    def __init__(self, parts: Sequence[bytes | Leaf]) -> None:
        source, target = ["<"], ["<BQ"]
        constants: list[Any] = []
        picks: list[tuple[int, Callable[[bytes], Any]]] = []
        at = 0
        for literal, run in _runs(parts):
            first = run[0]
            offset, bit = divmod(first.bit_offset, 8)
            size = sum(leaf.kind.size for leaf in run)
            code = "" if bit or first.kind.is_bits else _source_code(run, size)
            target.append(f"{len(literal)}s{_target_code(run, size)}")
            if code and offset >= at:
                source.append(f"{offset - at}x{code}")
                at = offset + size
            else:
                # What overlaps, as in a union, or has bits, is read by itself; b"" holds its place.
                source.append("0s")
                picks.append((2 * len(constants) + 1, _pick(run, code)))
            constants.append(literal)
        self._unpack = struct.Struct("".join(source)).unpack_from
        self._pack = struct.Struct("".join(target)).pack
        self._values: list[Any] = list(chain.from_iterable((each, None) for each in constants))
        self._picks = picks

    def pack(self, cycle: int, sample: bytes) -> bytes:
        """Return the message of *cycle*."""
        values = self._values
        values[1::2] = self._unpack(sample)
        for index, pick in self._picks:
            values[index] = pick(sample)
        return self._pack(_CYCLE_TAG, cycle, *values)


_CYCLE_TAG = encode_tag(1, FIXED64)[0]


def _runs(parts: Sequence[bytes | Leaf]) -> Iterator[tuple[bytes, list[Leaf]]]:
    """Yield what stands before each value, and the values that are copied in one piece."""
    literal, run = b"", list[Leaf]()
    end = -1
    for part in parts:
        if isinstance(part, bytes):
            if run:
                yield literal, run
                literal, run = b"", []
            literal += part
            continue
        if run and not (_is_copied(part) and _is_copied(run[0]) and part.bit_offset == end):
            yield literal, run
            literal, run = b"", []
        run.append(part)
        end = part.bit_offset + 8 * part.kind.size
    if run:
        yield literal, run


def _source_code(run: Sequence[Leaf], size: int) -> str:
    kind = run[0].kind
    if len(run) > 1 or isinstance(kind, Block):
        return f"{size}s"
    return _SAMPLE_CODES[field_type(kind)].get(kind.size, "")


def _target_code(run: Sequence[Leaf], size: int) -> str:
    kind = field_type(run[0].kind)
    if len(run) > 1 or kind is ProtobufType.BYTES:
        return f"{size}s"
    return "I" if kind is ProtobufType.FLOAT else _WIRE[kind][2]


def _pick(run: Sequence[Leaf], code: str) -> Callable[[bytes], Any]:
    leaf = run[0]
    offset, bit = divmod(leaf.bit_offset, 8)
    if leaf.kind.is_bits and bit + leaf.kind.bit_length <= 8:
        mask = (1 << leaf.kind.bit_length) - 1
        return lambda sample: sample[offset] >> bit & mask
    if not code:
        return lambda sample: read_leaf(leaf, sample)
    unpack = struct.Struct(f"<{code}").unpack_from
    return lambda sample: unpack(sample, offset)[0]


def _encode(parts: Iterable[_Part], sample: bytes) -> bytes:
    """Return the bytes of parts of any size."""
    found = bytearray()
    for part in parts:
        if isinstance(part, bytes):
            found += part
        elif isinstance(part, _PartGroup):
            inner = _encode(part.parts, sample)
            found += part.tag + varint(len(inner)) + inner
        else:
            value = read_leaf(part, sample)
            kind = field_type(part.kind)
            if kind is ProtobufType.STRING:
                # A WSTRING may have half of a surrogate pair, which UTF-8 has not.
                found += value.encode("utf-8", "replace")
            elif kind is ProtobufType.BYTES:
                found += value
            else:
                found += struct.pack(f"<{_WIRE[kind][2]}", value)
    return bytes(found)


class _PartReader:
    """Part of a message whose values vary in length; *at* is the position in it."""

    def __init__(self, message: bytes, at: int) -> None:
        self._message = message
        self.at = at

    def read(self, parts: Iterable[_Part], end: int) -> Iterator[Any]:
        """Yield the values of *parts*, which end at *end*."""
        for part in parts:
            if isinstance(part, bytes):
                if self._take(len(part), end) != part:
                    raise self._damaged()
            elif isinstance(part, _PartGroup):
                if self._take(len(part.tag), end) != part.tag:
                    raise self._damaged()
                inner = self._varint(end) + self.at
                if inner > end:
                    raise self._damaged()
                yield from self.read(part.parts, inner)
                # Else the next part would be read from the middle of this one.
                if self.at != inner:
                    raise self._damaged()
            else:
                yield self._value(part.kind, end)

    def _value(self, kind: DataType, end: int) -> Any:
        field = field_type(kind)
        if field is ProtobufType.STRING:
            return self._take(end - self.at, end).decode("utf-8", "replace")
        if field is ProtobufType.BYTES:
            return self._take(kind.size, end)
        _, size, code = _WIRE[field]
        return struct.unpack(f"<{code}", self._take(size, end))[0]

    def _take(self, size: int, end: int) -> bytes:
        if self.at + size > end:
            raise self._damaged()
        self.at += size
        return self._message[self.at - size : self.at]

    def _varint(self, end: int) -> int:
        number = 0
        # No length needs more than five bytes: a damaged one must not go on and on.
        for shift in range(0, 35, 7):
            octet = self._take(1, end)[0]
            number |= (octet & 0x7F) << shift
            if octet < 0x80:
                return number
        raise self._damaged()

    def _damaged(self) -> MalformedError:
        return MalformedError("is not as its schema says", layout="message", offset=self.at)


class PlacedVariable(NamedTuple):
    """A variable, and its first bit in a sample."""

    variable: RecordedVariable
    bit_offset: int


def pack_closely(variables: Iterable[RecordedVariable]) -> list[PlacedVariable]:
    """Return *variables* one behind the other, each at a whole byte: the sample of a reader."""
    placed, at = [], 0
    for variable in variables:
        placed.append(PlacedVariable(variable, 8 * at))
        at += datatypes.parse(variable.type).size
    return placed


class StationMessages:
    """Encoder and decoder of the messages of one station.

    Args:
        station: Its name.
        variables: Those that a message has, in any order.

    Attributes:
        station: The same.
        variables: The same, in the order of the message.
        leaves: Their values without parts, in the order in which :meth:`unpack` returns them.
        owners: The variable of each leaf.

    Raises:
        ValueError: the type of a variable is none.
    """

    def __init__(self, station: str, variables: Iterable[PlacedVariable]) -> None:
        self.station = station
        fields = []
        ordered = sorted(variables, key=lambda each: each.bit_offset)
        for number, (variable, bit_offset) in zip(_field_numbers(2), ordered, strict=False):
            kind = datatypes.parse(variable.type)
            fields.append((variable, list(_parts(number, variable.name, kind, bit_offset))))
        self.variables = tuple(variable for variable, _ in fields)
        # In front, where each has its place: reading them is one unpack.
        fixed = [each for each in fields if _fixed_sizes(each[1]) is not None]
        varying = [each for each in fields if _fixed_sizes(each[1]) is None]
        self._varying = [part for _, parts in varying for part in parts]
        self.owners = [owner for owner, parts in fixed + varying for _ in _leaves(parts)]
        flat = list(_flatten(chain.from_iterable(parts for _, parts in fixed)))
        self._packer = _Packer(flat)
        self.leaves = [part for part in flat if isinstance(part, Leaf)]
        self.leaves += _leaves(self._varying)
        self._fixed = struct.Struct(f"<xQ{''.join(map(_reader_code, flat))}")

    def pack(self, cycle: int, sample: bytes) -> bytes:
        """Return the message of *cycle*, whose variables are in *sample*."""
        message = self._packer.pack(cycle, sample)
        return message + _encode(self._varying, sample) if self._varying else message

    def unpack(self, message: bytes) -> tuple[int, list[Any]]:
        """Return the cycle and the values of all leaves: numbers, texts and bytes.

        The schema of the message is :meth:`descriptor`; tags are not compared again.

        Raises:
            MalformedError: the message is shorter or longer than that.
        """
        try:
            cycle, *values = self._fixed.unpack_from(message)
        except struct.error:
            raise MalformedError("is too short", layout="message", offset=len(message)) from None
        reader = _PartReader(message, self._fixed.size)
        values += reader.read(self._varying, len(message))
        if reader.at != len(message):
            raise MalformedError("is too long", layout="message", offset=reader.at)
        return cycle, values

    def sample(self, values: Iterable[Any], size: int) -> bytes:
        """Return a sample of *size* bytes with the values of :meth:`unpack`."""
        octets = bytearray(size)
        for leaf, value in zip(self.leaves, values, strict=True):
            write_leaf(leaf, octets, value)
        return bytes(octets)

    @property
    def schema_name(self) -> str:
        """Full name of the message's type."""
        return f"{PACKAGE}.{field_names([self.station])[0]}"

    def descriptor(self) -> bytes:
        """Return the ``google.protobuf.FileDescriptorSet`` that describes the messages."""
        types = _MessageTypes(self.schema_name.rpartition(".")[2])
        names = field_names((variable.name for variable in self.variables), [CYCLE_FIELD])
        fields = [_field_descriptor(CYCLE_FIELD, 1, ProtobufType.FIXED64)]
        for name, number, variable in zip(names, _field_numbers(2), self.variables, strict=False):
            fields.append(types.field(name, number, datatypes.parse(variable.type)))
        types.add(types.root, fields)
        file = (
            encode_field(1, f"{types.root}.proto")
            + encode_field(2, PACKAGE)
            + b"".join(encode_field(4, each) for each in types.messages)
            + encode_field(12, "proto3")
        )
        return encode_field(1, file)


def _leaves(parts: Iterable[_Part]) -> Iterator[Leaf]:
    for part in parts:
        if isinstance(part, Leaf):
            yield part
        elif isinstance(part, _PartGroup):
            yield from _leaves(part.parts)


def _reader_code(part: bytes | Leaf) -> str:
    if isinstance(part, bytes):
        return f"{len(part)}x"
    if isinstance(part.kind, Block):
        return f"{part.kind.size}s"
    return _WIRE[field_type(part.kind)][2]


_OPTIONAL, _REPEATED = 1, 3


def _field_descriptor(
    name: str, number: int, kind: ProtobufType, label: int = _OPTIONAL, type_name: str = ""
) -> bytes:
    named = encode_field(6, type_name) if type_name else b""
    return (
        encode_field(1, name)
        + encode_field(3, number)
        + encode_field(4, label)
        + encode_field(5, kind)
        + named
    )


class _MessageTypes:
    """Types of messages of one file, a type for each struct."""

    def __init__(self, root: str) -> None:
        self.root = root
        self.messages: list[bytes] = []
        self._names: dict[str, str] = {}

    def add(self, name: str, fields: Iterable[bytes]) -> None:
        """Add the type *name*."""
        self.messages.append(
            encode_field(1, name) + b"".join(encode_field(2, each) for each in fields)
        )

    def field(self, name: str, number: int, kind: DataType) -> bytes:
        """Return the descriptor of one field, whose type is added if it is a struct."""
        element, _ = _element_of(kind)
        label = _REPEATED if isinstance(kind, Array) else _OPTIONAL
        type_name = ""
        if isinstance(element, Structure):
            type_name = f".{PACKAGE}.{self._structure(element)}"
        return _field_descriptor(name, number, field_type(element), label, type_name)

    def _structure(self, kind: Structure) -> str:
        name = self._names.get(kind.text)
        if name is None:
            base = kind.name if "<" not in kind.name else "struct"
            taken = {self.root, *self._names.values()}
            name = self._names[kind.text] = field_names([base], taken)[0]
            members = field_names(member.name for member in kind.members)
            self.add(
                name,
                [
                    self.field(field, number, member.kind)
                    for number, (field, member) in enumerate(
                        zip(members, kind.members, strict=True), start=1
                    )
                ],
            )
        return name
