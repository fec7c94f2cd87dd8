"""Exceptions of a bus as records, on both sockets, and records as exceptions."""

from __future__ import annotations

from typing import TypeAlias

import msgspec

from devicebus import errors
from devicebus.errors import BusError
from eap.errors import EapError, EngineRefusedError

BusException: TypeAlias = BusError | EngineRefusedError

_HALF = 16
"""Bits of each number where an exception has two."""
_CLASSES: dict[str, type[BusException]] = {
    kind.__name__: kind
    for kind in (EngineRefusedError, *vars(errors).values())
    if isinstance(kind, type) and issubclass(kind, BusException)
}
_FACTS: dict[type[BusException], tuple[str, ...]] = {
    errors.WorkingCounterError: ("expected", "received"),
    errors.AlStatusError: ("state", "code"),
    errors.MailboxRefusedError: ("detail",),
    errors.SoeError: ("code",),
    errors.FoeError: ("code",),
    errors.EoeError: ("result",),
}
"""Attributes that *detail* holds; keyword arguments of the class, the upper half first."""


class ErrorRecord(msgspec.Struct, frozen=True):
    """An exception on its way to another process; *kind* is the name of its class."""

    kind: str
    message: str
    detail: int = 0
    """Its numbers in one; an FoE text is part of *message*."""


def to_record(error: EapError) -> ErrorRecord:
    """Return the record of an exception; one of no known class is recorded as BusError."""
    kind = type(error)
    if _CLASSES.get(kind.__name__) is not kind:
        return ErrorRecord(BusError.__name__, str(error))
    detail = 0
    for name in _FACTS.get(kind, ()):
        detail = detail << _HALF | getattr(error, name)
    return ErrorRecord(kind.__name__, str(error), detail)


def to_error(record: ErrorRecord) -> BusException:
    """Return the exception of a record, with its text and its numbers; BusError if not known."""
    # A class of another release is still a BusError with its text.
    kind = _CLASSES.get(record.kind, BusError)
    names = _FACTS.get(kind, ())
    if len(names) == 1:
        return kind(record.message, **{names[0]: record.detail})
    numbers = (record.detail >> _HALF, record.detail & (1 << _HALF) - 1)
    return kind(record.message, **dict(zip(names, numbers, strict=False)))
