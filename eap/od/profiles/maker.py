"""Maker of objects from the rows of a profile's table."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.od.model import RO, Entry, ObjectCode, OdObject, ReadHook
from eap.od.profiles.table import OWN_TYPE, UNITS, EntryRow, ObjectRow

DEFAULT_TYPE = datatypes.parse("UINT")

Source: TypeAlias = Callable[[EntryRow, int, DataType], ReadHook | None]
"""Source of entries that store nothing: called with row, sub-index and type of each entry."""
LiveRead: TypeAlias = Callable[[str], Any]
"""Returns the value of a live key: a number, octets or a text, as the type of its entry says."""
LiveWrite: TypeAlias = Callable[[str, bytes], None]
"""Carries out a download to a live key, or raises SdoAbortError."""


def make_object(
    row: ObjectRow,
    index: int,
    source: Source,
    *,
    kind: DataType = DEFAULT_TYPE,
    last: int = 0,
    extent: int = 0xFF,
    write: LiveWrite | None = None,
) -> OdObject:
    """Return an object with its defaults.

    Args:
        row: What the profile says of objects of its kind.
        index: Its own.
        source: For entries that store nothing.
        kind: Type of entries that hold a value of the object's variable.
        last: The last sub-index of the list at its end; 0 leaves the list empty.
        extent: The last sub-index that it may have.
        write: For live entries that can be written.
    """
    entries = {
        each.subindex: make_entry(each, each.subindex, source, kind=kind, write=write)
        for each in row.entries
        if not each.last and each.subindex <= extent
    }
    if row.list_row is not None:
        for subindex in range(row.list_row.subindex, last + 1):
            entries[subindex] = make_entry(row.list_row, subindex, source)
    if row.code is not ObjectCode.VAR:
        entries[0] = Entry("SubIndex 000", "USINT", row.count_access, max(entries, default=0))
    code = datatypes.parse(row.entries[-1].kind).code if row.code is ObjectCode.ARRAY else None
    return OdObject(index, row.title(index), row.code, entries, data_type=code)


def make_entry(
    row: EntryRow,
    subindex: int,
    source: Source,
    *,
    kind: DataType = DEFAULT_TYPE,
    write: LiveWrite | None = None,
) -> Entry:
    """Return one entry with its default; arguments as for :func:`make_object`."""
    own = kind if row.kind == OWN_TYPE else datatypes.parse(row.kind)
    return Entry(
        row.numbered(subindex), own, row.access, row.default,
        read=source(row, subindex, own),
        write=partial(write, row.live) if write and row.live and row.access != RO else None,
        unit=UNITS[row.unit], minimum=row.minimum, maximum=row.maximum,
    )  # fmt: skip


def live_source(read: LiveRead) -> Source:
    """Return a source whose live entries show what *read* returns for their keys."""

    def source(row: EntryRow, _subindex: int, kind: DataType) -> ReadHook | None:
        return (lambda: live_octets(kind, read(row.live))) if row.live else None

    return source


def live_octets(kind: DataType, value: Any) -> bytes:
    """Return a live value as it is transferred; a number beyond its type is the largest one."""
    if kind.is_text:
        return str(value).encode()[: kind.size]
    if kind.scalar_range is not None:
        value = min(value, int(kind.scalar_range[1]))
    return kind.encode(value)
