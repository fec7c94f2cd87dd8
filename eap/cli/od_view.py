"""Entries of an object dictionary as lines: for people, and for ``od write --from``.

    0xD000:07 = UDINT 10000  # Cycle time, us, 0x2710

Behind the type stands the value as ``od write`` takes it, a text in quotes as in JSON; octets that
no value stands for are written as ``hex`` and their digits.  The rest of the line is for people.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, TypeAlias

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.ids import ObjectId
from eap.od import notation

Row: TypeAlias = dict[str, Any]

RAW = "hex"
_FROM = 10
"""Numbers from here on look different in hexadecimal digits."""


def value_line(row: Row) -> str:
    """Return an entry with its value."""
    remarks = ", ".join(filter(None, [row.get("name"), row.get("unit"), _hexadecimal(row)]))
    line = f"{ObjectId(row['index'], row['subindex'])} = {_literal(row)}"
    return f"{line}  # {remarks}" if remarks else line


def object_lines(row: Row) -> Iterator[str]:
    """Yield a whole object: its entries, or its octets if nobody knows what they are."""
    yield object_line(row)
    if not row["entries"]:
        octets = bytes.fromhex(row["data"])
        yield f"{RAW} {octets.hex(' ')}  # {len(octets)} octets"
    for entry in row["entries"]:
        yield value_line(entry)


def object_line(row: Row) -> str:
    """Return index and name of an object, as a remark."""
    name = row["object"] if "object" in row else row["name"]
    return f"# 0x{row['index']:04X} {object_name(name, row['label'])}"


def object_name(name: str, label: str) -> str:
    """Return the name of an object, with that of what it is about."""
    return f"{name} ({label})" if label else name


def _literal(row: Row) -> str:
    """Return type and value, in a form that reads as the very octets."""
    octets = bytes.fromhex(row["data"])
    kind = datatypes.parse(row["type"]) if row.get("type") else None
    text = notation.show(kind, row["name"], octets) if kind else None
    if kind is None or text is None or not _is_exact(kind, text, octets):
        return f"{RAW} {row['data']}"
    is_text = kind.text.startswith("STRING")
    return f"{kind.text} {json.dumps(text, ensure_ascii=False) if is_text else text}"


def _is_exact(kind: DataType, text: str, octets: bytes) -> bool:
    try:
        return notation.parse(kind, text) == octets
    except ValueError:
        return False


def _hexadecimal(row: Row) -> str:
    value = row.get("value")
    if isinstance(value, int) and not isinstance(value, bool) and value >= _FROM:
        return f"0x{value:X}"
    return ""
