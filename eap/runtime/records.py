"""Values of structs as dataclasses and msgspec records of a user program."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")


def to_record(value: Any, kind: type[T]) -> T:
    """Return the value of a struct as *kind*, whose fields have the names of members.

    Members without a field are left out.  A field of another record, of an ``Enum``, or of a list
    or tuple of these is converted; every other value is taken as it is.

    Raises:
        ValueError: *kind* is no record, or has a field without a member.
    """
    names = _field_names(kind)
    if names is None or not isinstance(value, dict):
        expected = "a struct for a dataclass or msgspec record"
        raise ValueError(f"{value!r:.60} as {kind.__name__}: expected {expected}")
    missing = [name for name in names if name not in value]
    if missing:
        known = ", ".join(value)
        raise ValueError(f"{kind.__name__} has a field {missing[0]!r}: expected one of {known}")
    hints = get_type_hints(kind)
    return kind(**{name: _converted(value[name], hints[name]) for name in names})


def _field_names(kind: Any) -> Iterable[str] | None:
    fields: Iterable[str] | None = getattr(kind, "__dataclass_fields__", None)
    return getattr(kind, "__struct_fields__", None) if fields is None else fields


def _converted(value: Any, hint: Any) -> Any:
    if isinstance(value, tuple):
        items = get_args(hint)
        item = items[0] if items else Any
        elements = [_converted(each, item) for each in value]
        return elements if get_origin(hint) is list else tuple(elements)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(int(value))
    return value if _field_names(hint) is None else to_record(value, hint)
