"""Base data types of process variables by name (ETG.1020), and their layout in a PD.

Names are those of ESI files and IEC 61131-3; the shorter and the CANopen names are read as well.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import NamedTuple

from eap.codec.values import Array, Block, Boolean, DataType, Integer, Plain, Real, String, Value
from eap.suggest import suggest

__all__ = ["MAX_SIZE", "DataType", "PdoLayout", "Plain", "Value", "layout", "parse"]

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
