"""Records of results with the fields that a test cares about; the others are empty."""

from __future__ import annotations

from typing import Any, TypeVar

import msgspec
from msgspec.inspect import StructType, type_info

T = TypeVar("T", bound=msgspec.Struct)

_EMPTY: dict[str, Any] = {"str": "", "int": 0, "float": 0.0, "bool": False, "list": []}


def record(kind: type[T], **fields: Any) -> T:
    """Return a record of *kind*; required fields that are not given are empty."""
    return msgspec.convert(_filled(kind, fields), kind)


def _filled(kind: type[msgspec.Struct], fields: dict[str, Any]) -> dict[str, Any]:
    info = type_info(kind)
    assert isinstance(info, StructType)
    names = {
        field.encode_name: _EMPTY.get(type(field.type).__name__.removesuffix("Type").lower())
        for field in info.fields
        if field.required
    }
    return names | fields
