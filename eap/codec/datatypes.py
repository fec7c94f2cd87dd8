"""Data types of process variables by their texts, their layout in a PD, and paths to their parts.

Names are those of ETG.1020, ESI files and IEC 61131-3; the shorter and the CANopen names are read
as well.  :func:`parse` returns the type for a text, which is complete: a struct's has all its
members, so that a type passes between processes and files as its text.
:mod:`eap.codec.structures` describes the texts of structs and enumerations.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator
from functools import lru_cache
from math import isfinite, nan
from typing import Any, NamedTuple, NoReturn, Protocol

import msgspec

from eap.codec.arrays import Array, Dimension, make_array
from eap.codec.basetypes import (
    MAX_SIZE,
    Block,
    Boolean,
    DataType,
    Integer,
    Plain,
    Real,
    String,
    Value,
    WideChar,
    WideString,
    check_size,
)
from eap.codec.enumerations import MAX_MEMBERS, make_enumeration
from eap.codec.structures import MAX_DEPTH, Member, Structure, make_structure
from eap.codec.times import TIMES
from eap.suggest import nearest_in_any_case, suggest

# Users of types import all of them from here.
__all__ = [
    "MAX_SIZE",
    "Array",
    "Block",
    "Boolean",
    "DataType",
    "Definitions",
    "Integer",
    "PdoLayout",
    "Plain",
    "Real",
    "String",
    "Value",
    "byte_bool",
    "is_base_name",
    "is_finite",
    "layout",
    "parse",
    "parse_with",
]


def _integer(name: str, code: int, bits: int, *, signed: bool = False) -> DataType:
    return Integer(name, code, bits, (bits + 7) // 8, signed=signed)


_BYTE_BOOL = Boolean("BOOL8", 0x01, 8, 1)
"""BOOL of controllers: within arrays and structs every BOOL is one."""
_BASE: dict[str, DataType] = {
    kind.text: kind
    for kind in (
        Boolean("BOOL", 0x01, 1, 1, is_bits=True),
        _BYTE_BOOL,
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
        # 0x17 is reserved.
        _integer("UINT40", 0x18, 40),
        _integer("UINT48", 0x19, 48),
        _integer("UINT56", 0x1A, 56),
        _integer("ULINT", 0x1B, 64),
        _integer("BYTE", 0x1E, 8),
        _integer("WORD", 0x1F, 16),
        _integer("DWORD", 0x20, 32),
        # Numbers of types that ETG.1020 does not list are those of the number they are.
        _integer("LWORD", 0x1B, 64),
        WideChar("WCHAR", 0x06, 16, 2),
        *TIMES,
        *(Integer(f"BIT{n}", 0x2F + n, n, 1, is_bits=True) for n in range(1, 9)),
    )
}

_BY_WIDTH = {
    "INT": {8: "SINT", 16: "INT", 32: "DINT", 64: "LINT"},
    "UINT": {8: "USINT", 16: "UINT", 32: "UDINT", 64: "ULINT"},
}
_UNTYPED = {1: "BOOL", **{bits: f"BIT{bits}" for bits in range(2, 8)}, **_BY_WIDTH["UINT"]}
_ALIASES = {
    "BOOLEAN": "BOOL",
    "BIT": "BIT1",
    "REAL32": "REAL",
    "REAL64": "LREAL",
    "VISIBLE_STRING": "STRING",
    "OCTET_STRING": "BLOCK",
    "TIME_OF_DAY": "TOD",
    "LTIME_OF_DAY": "LTOD",
    "DATE_AND_TIME": "DT",
    "LDATE_AND_TIME": "LDT",
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

# ETG.1020: VISIBLE_STRING, OCTET_STRING and UNICODE_STRING.
_SIZED: dict[str, Callable[[int], DataType]] = {
    "STRING": lambda size: String(f"STRING({size})", 0x09, size * 8, size),
    "BLOCK": lambda size: Block(f"BLOCK({size})", 0x0A, size * 8, size),
    "WSTRING": lambda count: WideString(f"WSTRING({count})", 0x0B, 16 * count + 16, 2 * count + 2),
}
_SUCH_AS = "(such as UINT, REAL[4] or STRING(16))"
_MAX_TEXT = 1 << 18
"""Characters of the longest text of a type."""
_MAX_DIMENSIONS = 8


@lru_cache(maxsize=4096)
def parse(text: str) -> DataType:
    """Return the type that *text* names: ``UINT``, ``REAL[4]``, ``STRING(16)``, ``BLOCK(600)``.

    Upper and lower case are the same, as in IEC 61131-3, and so are the IEC, CANopen and short
    names (``UINT``, ``UNSIGNED16``, ``U16``).  ``ARRAY [0..3, 1..2] OF REAL`` is read as
    ``REAL[4,1..2]``, ``DINT (-10..10)`` is a subrange; structs, enumerations and aliases are read
    with their definition.

    Raises:
        ValueError: there is no such type; the message says which one comes near.
    """
    return _Parser(text, None).whole()


class Definitions(Protocol):
    """Types that a text may refer to by their names."""

    def find(self, name: str) -> DataType | None:
        """Return the type called *name*, in whatever case; None if there is none."""

    def names(self) -> Iterable[str]:
        """Return all names, for suggestions."""


def parse_with(text: str, definitions: Definitions) -> DataType:
    """Return the type that *text* names; it may refer to *definitions*.

    Raises:
        ValueError: as of :func:`parse`, and what ``definitions.find`` raises.
    """
    return _Parser(text, definitions).whole()


def is_base_name(name: str) -> bool:
    """Return whether *name* is that of a base type, which no definition can have."""
    upper = name.upper()
    return upper in _BASE or upper in _SIZED or upper in _ALIASES or upper in {"ARRAY", "OF"}


def untyped(bits: int) -> str:
    """Return the name of the unsigned type of *bits* bits, for a value without a type, else ""."""
    return _UNTYPED.get(bits, "")


def byte_bool(kind: DataType) -> DataType:
    """Return *kind* as it is within an array, a struct or a definition: a BOOL has a byte there."""
    return _BYTE_BOOL if isinstance(kind, Boolean) and kind.is_bits else kind


# A name ends before the dots of a range, a number before its second dot.
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z_][A-Za-z0-9_]*)*", re.ASCII)
_NUMBER = re.compile(r"-?[0-9]{1,20}(?![0-9])", re.ASCII)
_SPACE = re.compile(r"\s*")


class _Parser:
    """Position in the text of a type."""

    def __init__(self, text: str, definitions: Definitions | None) -> None:
        if len(text) > _MAX_TEXT:
            raise ValueError(f"a data type of {len(text)} characters: at most {_MAX_TEXT}")
        self._text = text
        self._at = 0
        self._definitions = definitions
        self._own: dict[str, DataType] = {}
        """Definitions that the text has had so far, by name."""

    def whole(self) -> DataType:
        """Return the type of the whole text."""
        kind = self._type(0)
        self._skip()
        if self._at < len(self._text):
            self._fail()
        return kind

    def _type(self, depth: int) -> DataType:
        """Read a type; *depth* is 0 for one that is no part of another."""
        self._check_depth(depth)
        name = self._name()
        if name.upper() == "ARRAY":
            return self._iec_array(depth)
        kind = self._single(name, depth)
        while self._take("["):
            depth += 1
            self._check_depth(depth)
            kind = make_array(self._text[:60], byte_bool(kind), self._dimensions())
        return kind

    def _check_depth(self, depth: int) -> None:
        if depth > MAX_DEPTH:
            # Of a complete text, which users did not write, its name is enough.
            shown = self._text.partition("<")[0] if "<" in self._text else self._shown
            raise ValueError(
                f"{shown[:60]} is nested too deeply: expected {MAX_DEPTH} levels at most"
            )

    def _iec_array(self, depth: int) -> DataType:
        self._expect("[")
        dimensions = self._dimensions()
        if self._name().upper() != "OF":
            self._fail()
        return make_array(self._text[:60], byte_bool(self._type(depth + 1)), dimensions)

    def _single(self, name: str, depth: int) -> DataType:
        if self._take("<"):
            return self._definition(name, depth)
        kind = self._own.get(name)
        if kind is None and self._definitions and not is_base_name(name):
            kind = self._definitions.find(name)
        if kind is None:
            upper = name.upper()
            kind = self._base(name, _ALIASES.get(upper, upper))
        if isinstance(kind, Integer) and self._take("("):
            return self._subrange(kind)
        return kind if depth == 0 else byte_bool(kind)

    def _base(self, name: str, base: str) -> DataType:
        if base in _SIZED:
            length = self._length(base)
            kind = _SIZED[base](length)
            if not length:
                check_size(self._text[:60], 0)
            check_size(self._text[:60], kind.size)
            return kind
        if base in _BASE:
            return _BASE[base]
        if not self._is_word:
            self._fail()
        # All spellings: people write types as in the language that they know.
        known = [*_BASE, *_SIZED, *_ALIASES]
        if self._definitions:
            known += self._definitions.names()
        meant = _OF_OTHER_LANGUAGES.get(base)
        hint = f", did you mean {meant}?" if meant else _suggestion(name, known)
        raise ValueError(f"{name[:60]!r} is not a data type{hint}")

    def _length(self, name: str) -> int:
        close = ")" if self._take("(") else ""
        if not close:
            unit = "characters" if name == "WSTRING" else "bytes"
            raise ValueError(f"{self._shown} lacks its length in {unit}, such as {name}(16)")
        length = self._number()
        self._expect(close)
        return length

    def _subrange(self, kind: Integer) -> DataType:
        low = self._number()
        if not self._take(".."):
            if self._take(")") and kind.text in _BASE:
                raise ValueError(
                    f"{self._shown}: {kind.text} has a fixed length, arrays are {kind.text}[{low}]"
                )
            self._fail()
        high = self._number()
        self._expect(")")
        whole = kind.scalar_range
        if type(kind) is not Integer or not whole[0] <= low <= high <= whole[1]:
            bounds = f": expected a range within {whole[0]}..{whole[1]}" if whole else ""
            raise ValueError(f"{self._shown}: {low}..{high} is no range of {kind.name}{bounds}")
        return msgspec.structs.replace(
            kind,
            text=f"{kind.wire}({low}..{high})",
            name="",
            alias_of=None,
            bounds=(low, high),
            range_of=kind.wire,
        )

    def _dimensions(self) -> list[Dimension]:
        found: list[Dimension] = []
        while not found or self._take(","):
            low, high = 0, self._number()
            count = high
            if self._take(".."):
                low, high = high, self._number()
                count = high - low + 1
            if count < 1:
                raise ValueError(
                    f"{self._shown} has no elements: expected a number of elements, or a lower"
                    " bound and an upper one such as 1..3"
                )
            found.append(Dimension(low, count))
        self._expect("]")
        if len(found) > _MAX_DIMENSIONS:
            raise ValueError(
                f"{self._shown} has {len(found)} dimensions: at most {_MAX_DIMENSIONS}"
            )
        return found

    def _definition(self, name: str, depth: int) -> DataType:
        """Read what stands behind ``NAME<``."""
        self._skip()
        if is_base_name(name):
            raise ValueError(f"{self._shown} gives {name} another meaning: expected another name")
        # Only a structure begins with a number, its size.
        if _NUMBER.match(self._text, self._at):
            kind = self._structure(name, depth)
        else:
            base = self._type(depth + 1)
            kind = self._enumeration(name, base) if self._take(":") else base.named(name)
        self._expect(">")
        # Whoever uses the type twice describes it once: the second time its name is enough.
        self._own[name] = kind
        return kind

    def _structure(self, name: str, depth: int) -> DataType:
        size = self._number()
        self._expect("/")
        align = self._number()
        self._expect(":")
        members: list[Member] = []
        while not members or self._take(","):
            member = self._name()
            self._expect("@")
            bit_offset = 8 * self._number()
            if self._take("."):
                bit_offset += self._number()
            members.append(Member(member, self._type(depth + 1), bit_offset))
            if len(members) > MAX_MEMBERS:
                raise ValueError(f"{name} has more than {MAX_MEMBERS} members")
        return make_structure(name, members, size, align)

    def _enumeration(self, name: str, base: DataType) -> DataType:
        numbers: dict[str, int] = {}
        while not numbers or self._take(","):
            each = self._name()
            self._expect("=")
            if each in numbers:
                raise ValueError(f"{name} has two values {each}")
            numbers[each] = self._number()
        return make_enumeration(name, base, numbers)

    @property
    def _shown(self) -> str:
        return repr(self._text if len(self._text) <= 60 else f"{self._text[:60]}…")

    @property
    def _is_word(self) -> bool:
        """True if nothing but a type's name and its length can have been meant."""
        return self._text[self._at :].strip()[:1] in {"", "(", "[", ",", ">"}

    def _name(self) -> str:
        return self._match(_NAME)

    def _number(self) -> int:
        return int(self._match(_NUMBER))

    def _match(self, pattern: re.Pattern[str]) -> str:
        self._skip()
        match = pattern.match(self._text, self._at)
        if match is None:
            self._fail()
        self._at = match.end()
        return match[0]

    def _take(self, sign: str) -> bool:
        self._skip()
        if not self._text.startswith(sign, self._at):
            return False
        self._at += len(sign)
        return True

    def _expect(self, sign: str) -> None:
        if not self._take(sign):
            self._fail()

    def _skip(self) -> None:
        match = _SPACE.match(self._text, self._at)
        self._at = match.end() if match else self._at

    def _fail(self) -> NoReturn:
        raise ValueError(f"{self._shown} is not a data type {_SUCH_AS}")


def _suggestion(name: str, known: Iterable[str]) -> str:
    """Return the name that comes near in whatever case, or examples."""
    near = nearest_in_any_case(name, known)
    return f", did you mean {near}?" if near else f" {_SUCH_AS}"


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


def is_finite(value: Value) -> bool:
    """Return whether no number in *value* is infinite or NaN, which JSON cannot carry."""
    if isinstance(value, dict):
        return all(map(is_finite, value.values()))
    if isinstance(value, tuple):
        return all(map(is_finite, value))
    return not isinstance(value, float) or isfinite(value)


def with_nan(plain: Any) -> Any:
    """Return a plain value with NaN for each null: JSON can carry neither NaN nor infinities."""
    if plain is None:
        return nan
    if isinstance(plain, dict):
        return {name: with_nan(each) for name, each in plain.items()}
    return [with_nan(each) for each in plain] if isinstance(plain, list) else plain


def _whole_octet(bits: int) -> int:
    return (bits + 7) // 8 * 8


PATH_STEP = re.compile(r"\.([A-Za-z_]\w*)|\[\s*(-?\d{1,6}(?:\s*,\s*-?\d{1,6})*)\s*\]", re.ASCII)
"""One step of a path: a member, or the indexes of an element."""
_DELIMITERS = re.compile(r"[.\[]")


class Part(NamedTuple):
    """A member or element of a variable; *bit_offset* counts from the start of the variable."""

    kind: DataType
    bit_offset: int


@lru_cache(maxsize=4096)
def find_part(kind: DataType, path: str) -> Part:
    """Return the part of *kind* at *path*, such as ``.axes[2].position``.

    Raises:
        ValueError: there is none; the message says where the path ends.
    """
    bit_offset, at = 0, 0
    while at < len(path):
        step = PATH_STEP.match(path, at)
        if step is None:
            raise ValueError(f"{path[at:][:60]!r} is no path such as .member or [1]")
        where = path[:at] or "it"
        if step[1] is not None:
            if not isinstance(kind, Structure):
                raise ValueError(f"{where} is {kind.name} and has no members{_element_hint(kind)}")
            member = kind.by_name.get(step[1])
            if member is None:
                known = ", ".join(each.name for each in kind.members[:8])
                hint = suggest(step[1], kind.by_name) or f"; members: {known}"
                raise ValueError(f"{kind.name} has no member {step[1]!r}{hint}")
            kind, bit_offset = member.kind, bit_offset + member.bit_offset
        else:
            if not isinstance(kind, Array):
                raise ValueError(f"{where} is {kind.name} and has no elements")
            number = kind.index_of([int(each) for each in step[2].split(",")])
            bit_offset += 8 * number * kind.element.size
            kind = kind.element
        at = step.end()
    return Part(kind, bit_offset)


def _element_hint(kind: DataType) -> str:
    if not isinstance(kind, Array):
        return ""
    first = ",".join(str(low) for low, _ in kind.dimensions)
    return f": expected an element of it before, such as [{first}]"


def split_paths(name: str) -> Iterator[tuple[str, str]]:
    """Yield each way to divide *name* into a variable and a path, the longest variable first."""
    # Names of variables have dots of their own: bus0.axis.csp.Target.
    for match in reversed(list(_DELIMITERS.finditer(name))):
        if match.start():
            yield name[: match.start()], name[match.start() :]


def variable_of(name: str, known: Container[str]) -> str:
    """Return the one of *known* variables that *name* is or lies in, else *name* itself."""
    if name in known:
        return name
    return next((variable for variable, _ in split_paths(name) if variable in known), name)


def find_variable(name: str, type_of: Callable[[str], DataType | None]) -> tuple[str, Part] | None:
    """Return the variable that *name* is or lies in, and the part; None if there is none.

    Args:
        name: A variable, or a variable and a path into it; a variable of that name goes first.
        type_of: Returns the type of a variable, None if there is none.

    Raises:
        ValueError: the variable has no such part.
    """
    kind = type_of(name)
    if kind is not None:
        return name, Part(kind, 0)
    for variable, path in split_paths(name):
        kind = type_of(variable)
        if kind is not None:
            return variable, find_part(kind, path)
    return None


class SharedPart(NamedTuple):
    """A part that two types have in common, with its place in each of them."""

    old_bit: int
    new_bit: int
    bits: int


def shared_parts(old: DataType, new: DataType) -> Iterator[SharedPart]:
    """Yield what both types have: all if they are equal, else members of one name and type."""
    if old == new:
        yield SharedPart(0, 0, new.bit_length)
    elif (
        isinstance(old, Structure)
        and isinstance(new, Structure)
        # In a union the copy of one member would overwrite that of another.
        and not (old.is_union or new.is_union)
    ):
        for member in new.members:
            if (was := old.by_name.get(member.name)) is None:
                continue
            for old_bit, new_bit, bits in shared_parts(was.kind, member.kind):
                yield SharedPart(was.bit_offset + old_bit, member.bit_offset + new_bit, bits)


def parts_of(kind: DataType, path: str = "") -> Iterator[tuple[str, Part]]:
    """Yield the members of *kind*, those of nested structs too, with their paths.

    An array is one part; its elements are not listed.
    """
    if not isinstance(kind, Structure):
        return
    for member in kind.members:
        own = f"{path}.{member.name}"
        yield own, Part(member.kind, member.bit_offset)
        for inner, part in parts_of(member.kind, own):
            yield inner, Part(part.kind, member.bit_offset + part.bit_offset)
