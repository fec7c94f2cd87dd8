"""Members and elements of a symbol: by path, by number, and by offset.

Parts are numbered in the order of their definition, each before its own parts: handles are made of
these numbers, so that nothing is kept for a client.  Upper and lower case are the same in a path,
as in IEC 61131-3, unless a struct has two members that differ in nothing else.
"""

from __future__ import annotations

from bisect import bisect_right
from functools import lru_cache
from itertools import accumulate
from typing import NamedTuple

from eap.codec.basetypes import Text
from eap.codec.datatypes import PATH_STEP, Array, DataType
from eap.codec.structures import Structure


class SymbolPart(NamedTuple):
    """A member or element; offset and number count from those of the symbol."""

    path: str
    """From the symbol on, in the case of the definitions; empty for the whole."""
    kind: DataType
    bit_offset: int
    number: int


@lru_cache(maxsize=4096)
def count_parts(kind: DataType) -> int:
    """Return the number of a symbol's parts, with the symbol itself."""
    if isinstance(kind, Structure):
        return 1 + sum(count_parts(each.kind) for each in kind.members)
    if isinstance(kind, Array):
        return 1 + kind.count * count_parts(kind.element)
    return 1


@lru_cache(maxsize=4096)
def find_by_path(kind: DataType, path: str) -> SymbolPart:
    """Return the part at *path*, such as ``.axes[2].position``.

    Raises:
        ValueError: there is none.
    """
    part = SymbolPart("", kind, 0, 0)
    at = 0
    while at < len(path):
        step = PATH_STEP.match(path, at)
        if step is None:
            raise ValueError(f"{path[at:][:60]!r} is no path such as .member or [1]")
        if step[1] is not None and isinstance(part.kind, Structure):
            part = _named_member(part, part.kind, step[1])
        elif step[2] is not None and isinstance(part.kind, Array):
            indexes = [int(each) for each in step[2].split(",")]
            part = _element(part, part.kind, part.kind.index_of(indexes))
        else:
            raise ValueError(f"{part.kind.name} has no part {step[0][:60]!r}")
        at = step.end()
    return part


@lru_cache(maxsize=4096)
def find_by_number(kind: DataType, number: int) -> SymbolPart:
    """Return a part by its number, which is less than :func:`count_parts` returns."""
    part = SymbolPart("", kind, 0, 0)
    while number > part.number and isinstance(part.kind, Structure | Array):
        rest = number - part.number
        if isinstance(part.kind, Structure):
            part = _member(part, part.kind, bisect_right(_numbers(part.kind), rest) - 1)
        else:
            part = _element(part, part.kind, (rest - 1) // count_parts(part.kind.element))
    return part


@lru_cache(maxsize=4096)
def find_path_at(kind: DataType, bit_offset: int, bit_length: int) -> str | None:
    """Return the path of a part by its place, None if there is none.

    A text is found by its first bytes, too.

    Args:
        kind: Type of the symbol.
        bit_offset: From the start of the symbol.
        bit_length: 0 for the bit field that starts there.
    """
    if not bit_offset and _has_length(kind, bit_length):
        return ""
    end = bit_offset + (bit_length or 1)
    if isinstance(kind, Structure):
        for member in kind.members:
            # Members of a union lie at the same place: the first that fits is as good as others.
            if member.bit_offset <= bit_offset and end <= member.end:
                rest = find_path_at(member.kind, bit_offset - member.bit_offset, bit_length)
                if rest is not None:
                    return f".{member.name}{rest}"
    elif isinstance(kind, Array) and end <= kind.bit_length:
        position, inner = divmod(bit_offset, kind.element.bit_length)
        rest = find_path_at(kind.element, inner, bit_length)
        return None if rest is None else _index_text(kind, position) + rest
    return None


def _has_length(kind: DataType, bit_length: int) -> bool:
    if kind.is_bits or not bit_length:
        return kind.is_bits and not bit_length
    is_text = isinstance(kind, Text)
    return bit_length == kind.bit_length or (is_text and bit_length < kind.bit_length)


@lru_cache(maxsize=4096)
def _numbers(kind: Structure) -> tuple[int, ...]:
    """Return the number of each member."""
    return tuple(accumulate((count_parts(each.kind) for each in kind.members[:-1]), initial=1))


@lru_cache(maxsize=4096)
def _folded(kind: Structure) -> dict[str, str | None]:
    """Return the name of each member by its name without case, None for two of one."""
    names: dict[str, str | None] = {}
    for name in kind.by_name:
        key = name.casefold()
        names[key] = None if key in names else name
    return names


@lru_cache(maxsize=4096)
def _positions(kind: Structure) -> dict[str, int]:
    return {name: position for position, name in enumerate(kind.by_name)}


def _named_member(part: SymbolPart, kind: Structure, name: str) -> SymbolPart:
    exact = name if name in kind.by_name else _folded(kind).get(name.casefold())
    if exact is None:
        # Without a suggestion, which takes long in a large struct: any host may ask.
        raise ValueError(f"{kind.name} has no member {name[:60]!r}")
    return _member(part, kind, _positions(kind)[exact])


def _member(part: SymbolPart, kind: Structure, position: int) -> SymbolPart:
    name, inner, bit_offset = kind.members[position]
    number = part.number + _numbers(kind)[position]
    return SymbolPart(f"{part.path}.{name}", inner, part.bit_offset + bit_offset, number)


def _element(part: SymbolPart, kind: Array, position: int) -> SymbolPart:
    return SymbolPart(
        part.path + _index_text(kind, position),
        kind.element,
        part.bit_offset + position * kind.element.bit_length,
        part.number + 1 + position * count_parts(kind.element),
    )


def _index_text(kind: Array, position: int) -> str:
    indexes: list[str] = []
    for low, count in reversed(kind.dimensions):
        position, index = divmod(position, count)
        indexes.append(str(low + index))
    return f"[{','.join(reversed(indexes))}]"
