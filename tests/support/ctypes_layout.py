"""The layout that the C compiler's rules give a struct, by ctypes: the referee for ours."""

from __future__ import annotations

import ctypes
from typing import Any

from eap.codec.arrays import Array
from eap.codec.basetypes import (
    Block,
    Boolean,
    DataType,
    Integer,
    Real,
    String,
    WideChar,
    WideString,
)
from eap.codec.structures import Structure

_INTEGERS = {
    (True, 1): ctypes.c_int8,
    (True, 2): ctypes.c_int16,
    (True, 4): ctypes.c_int32,
    (True, 8): ctypes.c_int64,
    (False, 1): ctypes.c_uint8,
    (False, 2): ctypes.c_uint16,
    (False, 4): ctypes.c_uint32,
    (False, 8): ctypes.c_uint64,
}


def c_type(kind: DataType, pack: int) -> type:
    """Return the C type of *kind*; structs in it are laid out with *pack*."""
    if isinstance(kind, Structure):
        base = ctypes.Union if kind.is_union else ctypes.Structure
        fields = [(each.name, c_type(each.kind, pack)) for each in kind.members]
        return type(kind.name, (base,), {"_pack_": pack, "_fields_": fields})
    if isinstance(kind, Array):
        element: Any = c_type(kind.element, pack)
        return element * kind.count  # type: ignore[no-any-return]
    if isinstance(kind, Integer):  # enumerations and times too
        return _INTEGERS[kind.signed, kind.size]
    made: type = {
        Boolean: ctypes.c_bool,
        Real: ctypes.c_float if kind.size == 4 else ctypes.c_double,
        String: ctypes.c_char * kind.size,
        Block: ctypes.c_char * kind.size,
        WideString: ctypes.c_uint16 * (kind.size // 2),
        WideChar: ctypes.c_uint16,
    }[type(kind)]
    return made


def c_layout(kind: Structure, pack: int) -> tuple[int, list[tuple[str, int, int]]]:
    """Return the size, and name, offset and size of each member."""
    made = c_type(kind, pack)
    fields = [getattr(made, each.name) for each in kind.members]
    rows = [(m.name, f.offset, f.size) for m, f in zip(kind.members, fields, strict=True)]
    return ctypes.sizeof(made), rows
