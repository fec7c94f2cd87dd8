"""Objects made of a profile's rows, whose live entries ask the running device."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.od.model import RO, Entry, ObjectCode, OdObject
from eap.od.profiles.table import UNITS, EntryRow, ObjectRange

Read = Callable[[str], Any]
"""Returns what a key of a profile stands for: a number, octets or a text, as its type says."""
Write = Callable[[str, bytes], None]
"""Does what a download under a key asks for, or raises SdoAbortError."""


def make_object(
    row: ObjectRange,
    index: int,
    read: Read,
    *,
    write: Write | None = None,
    count: int = 0,
    extent: int = 0,
) -> OdObject:
    """Return an object.

    Args:
        row: What the profile says of objects of its kind.
        index: Its own.
        read: For live entries.
        write: For those of them that can be written.
        count: Entries of the list at its end.
        extent: Last sub-index that it has; 0 for all of the row.
    """
    entries = {}
    for each in row.entries:
        last = each.subindex + count - 1 if each.last else each.subindex
        for subindex in range(each.subindex, last + 1):
            if not extent or subindex <= extent:
                entries[subindex] = _make_entry(each, subindex, read, write)
    is_array = row.code is ObjectCode.ARRAY
    code = datatypes.parse(row.entries[-1].kind).code if is_array else None
    return OdObject(index, row.title(index), row.code, entries, data_type=code)


def _make_entry(row: EntryRow, subindex: int, read: Read, write: Write | None) -> Entry:
    kind, key = datatypes.parse(row.kind), row.live
    is_written = bool(key) and row.access != RO and write is not None
    return Entry(
        row.numbered(subindex),
        kind,
        row.access,
        row.default,
        read=(lambda: octets_of(kind, read(key))) if key else None,
        write=(lambda data: write(key, data)) if is_written and write is not None else None,
        unit=UNITS[row.unit],
    )


def octets_of(kind: DataType, value: Any) -> bytes:
    """Return a live value as it is transferred; a number beyond its type is the largest one."""
    if kind.is_text:
        return str(value).encode()[: kind.size]
    if kind.scalar_range is not None:
        value = min(value, int(kind.scalar_range[1]))
    return kind.encode(value)
