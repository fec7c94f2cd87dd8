"""Arrays: a fixed number of elements of one type, in one dimension or several, from any bound on.

``ELEMENT[DIMENSION,…]`` is the text of an array, a dimension its number of elements or its bounds
(``REAL[4]``, ``REAL[1..3,2]``).  Elements lie one behind the other, those of the last dimension
next to each other.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from eap.codec.basetypes import DataType, Integer, Plain, Real, Value, check_size
from eap.codec.literals import Literal, read_literal
from eap.codec.wire import Buffer


class Dimension(NamedTuple):
    """One dimension of an array: its lower bound, and its number of elements."""

    low: int
    size: int

    def __str__(self) -> str:
        return f"{self.low}..{self.low + self.size - 1}" if self.low else str(self.size)


_CODES = {
    (False, 1): "B", (False, 2): "H", (False, 4): "I", (False, 8): "Q",
    (True, 1): "b", (True, 2): "h", (True, 4): "i", (True, 8): "q",
}  # fmt: skip


class Array(DataType, frozen=True, kw_only=True):
    """A fixed number of equal elements; its value is a tuple, with a tuple for each dimension."""

    element: DataType
    dimensions: tuple[Dimension, ...]

    @property
    def alignment(self) -> int:
        """That of the elements."""
        return self.element.alignment

    @property
    def wire(self) -> str:
        """Text without lower bounds."""
        counts = ",".join(str(each.size) for each in self.dimensions)
        return f"{self.element.wire}[{counts}]"

    def compose(self, seen: dict[str, DataType]) -> str:
        """Return the text of the element with the dimensions behind it."""
        if self.alias_of:
            return super().compose(seen)
        return f"{self.element.compose(seen)}[{_shape_text(self.dimensions)}]"

    def encode(self, value: Any) -> bytes:
        """Return the bytes of a sequence of exactly as many elements; take bytes as they are.

        Errors name the element.
        """
        if isinstance(value, bytes) and len(value) == self.size:
            return value
        items = self._flat(value)
        packer = _packer(self.element, self.count)
        if packer:
            try:
                return packer.pack(*items)
            except (struct.error, OverflowError):
                pass  # the loop below finds the element
        octets = bytearray()
        for position, item in enumerate(items):
            try:
                octets += self.element.encode(item)
            except ValueError as exc:
                raise self._at(position, exc) from None
        return bytes(octets)

    def decode(self, buffer: Buffer, offset: int) -> Value:
        """Read all elements."""
        packer = _packer(self.element, self.count)
        if packer:
            return self._nested(packer.unpack_from(buffer, offset))
        end, step = offset + self.size, self.element.size
        return self._nested([self.element.decode(buffer, at) for at in range(offset, end, step)])

    def parse_text(self, text: str) -> Value:
        """Read the elements between commas; brackets around them are allowed."""
        literal = read_literal(text)
        if not isinstance(literal, list):
            literal = [literal]
        # Of several dimensions, all elements in one list are read as well.
        is_flat = len(self.dimensions) == 1 or not any(isinstance(each, list) for each in literal)
        return self._parsed(literal if is_flat else self._flat(literal))

    def from_literal(self, literal: Literal) -> Value:
        """Read a list of elements, with a list for each dimension."""
        return self._parsed(self._flat(literal))

    def _parsed(self, literals: Sequence[Any]) -> Value:
        self._check_count(literals, self.count, " between commas")
        found: list[Value] = []
        for position, each in enumerate(literals):
            try:
                found.append(self.element.from_literal(each))
            except ValueError as exc:
                raise self._at(position, exc) from None
        return self._nested(found)

    def from_plain(self, plain: object) -> Value:
        """Read a list of elements, with a list for each dimension."""
        found = []
        for position, each in enumerate(self._flat(plain)):
            try:
                found.append(self.element.from_plain(each))
            except ValueError as exc:
                raise self._at(position, exc) from None
        return self._nested(found)

    def to_plain(self, value: Value) -> Plain:
        """Return a list of elements, with a list for each dimension."""
        elements = [self.element.to_plain(each) for each in self._flat(value)]
        plain: list[Any] = _rows(elements, self.dimensions, list)
        return plain

    def index_of(self, indexes: Sequence[int]) -> int:
        """Return the position of an element; raise ValueError if there is none."""
        if len(indexes) != len(self.dimensions):
            raise ValueError(f"{self.name} has {len(self.dimensions)} dimensions")
        position = 0
        for index, (low, count) in zip(indexes, self.dimensions, strict=True):
            if not low <= index < low + count:
                raise ValueError(f"{self.name} has no element {index}: {low} to {low + count - 1}")
            position = position * count + index - low
        return position

    def _nested(self, items: Sequence[Any]) -> Value:
        rows: tuple[Any, ...] = _rows(items, self.dimensions, tuple)
        return rows

    def _flat(self, value: Any) -> Sequence[Any]:
        """Return the elements of a value in one sequence; raise ValueError for another shape."""
        items: Sequence[Any] = (value,)
        for _, count in self.dimensions:
            for item in items:
                self._check_count(item, count, "")
            items = items[0] if len(items) == 1 else [each for item in items for each in item]
        return items

    def _check_count(self, value: Any, count: int, where: str) -> None:
        if not isinstance(value, Sequence) or isinstance(value, str | bytes | bytearray):
            raise self._refuse(value, f"{count} values")
        if len(value) != count:
            raise self._refuse(value, f"{count} values{where}, these are {len(value)}")

    def _at(self, position: int, exc: ValueError) -> ValueError:
        indexes: list[str] = []
        for low, count in reversed(self.dimensions):
            indexes.append(str(low + position % count))
            position //= count
        return ValueError(f"element {','.join(reversed(indexes))} of {self.name}: {exc}")


def _rows(items: Sequence[Any], dimensions: Sequence[Dimension], make: Any) -> Any:
    rows: Sequence[Any] = items
    for _, count in reversed(dimensions[1:]):
        rows = [make(rows[at : at + count]) for at in range(0, len(rows), count)]
    return make(rows)


def _shape_text(dimensions: Iterable[Dimension]) -> str:
    return ",".join(map(str, dimensions))


def _packer(element: DataType, count: int) -> struct.Struct | None:
    """Return what packs *count* elements with one call, None where that is not possible."""
    if type(element) is Real:
        return _struct("f" if element.size == 4 else "d", count)
    # Neither a subrange, whose limits the call would not check, nor a subclass.
    if type(element) is Integer and element.bounds is None and not element.is_bits:
        code = _CODES.get((element.signed, element.size))
        return _struct(code, count) if code else None
    return None


@lru_cache(maxsize=256)
def _struct(code: str, count: int) -> struct.Struct:
    return struct.Struct(f"<{count}{code}")


def make_array(text: str, element: DataType, dimensions: Sequence[Dimension]) -> Array:
    """Return an array of *element*; raise ValueError, which begins with *text*, for a bad one."""
    if element.is_bits:
        raise ValueError(f"{text!r}: arrays of bits are not supported, use BOOL or BYTE")
    count = 1
    for each in dimensions:
        count *= each.size
    check_size(text, element.size * count)
    shape = _shape_text(dimensions)
    return Array(
        f"{element.compose({})}[{shape}]",
        element.code,
        element.bit_length * count,
        element.size * count,
        count=count,
        name="" if element.name == element.text else f"{element.name}[{shape}]",
        element=element,
        dimensions=tuple(dimensions),
    )
