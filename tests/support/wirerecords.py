"""Hypothesis strategies for every record that WireStruct compiles, made from its declaration."""

from __future__ import annotations

import struct
from enum import Enum
from typing import ClassVar, get_args, get_origin, get_type_hints

from hypothesis import strategies as st

from eap.codec.wire import Bits, Scalar, WireStruct


def records(record: type[WireStruct]) -> st.SearchStrategy[WireStruct]:
    """Any value of *record* that fits its layout."""
    hints = get_type_hints(record, include_extras=True)
    fields = [
        _field(get_args(hint)[1]) for hint in hints.values() if get_origin(hint) is not ClassVar
    ]
    return st.tuples(*fields).map(lambda values: record(*values))


def _field(kind: Scalar | Bits) -> st.SearchStrategy:
    if kind.wrap is not None and issubclass(kind.wrap, Enum):
        return st.sampled_from(kind.wrap)
    if isinstance(kind, Bits):
        return st.integers(0, (1 << kind.width) - 1)
    size = struct.calcsize(f"<{kind.code}")
    if kind.code.endswith("s"):
        return st.binary(min_size=size, max_size=size).map(kind.wrap or bytes)
    if kind.code.islower():
        return st.integers(-1 << 8 * size - 1, (1 << 8 * size - 1) - 1)
    return st.integers(0, (1 << 8 * size) - 1)
