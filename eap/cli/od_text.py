"""Entries of a dictionary as text, written and read again (``od dump``, ``od write --from``).

    0xD000:07 = UDINT 10000  # Cycle time, us, 0x2710

Behind the type stands the value as ``od write`` takes it, a text in quotes as in JSON; bytes that
no value stands for are written as ``hex`` and their digits.  The rest of the line is for people.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import msgspec

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.errors import ConfigError
from eap.ids import ObjectId
from eap.od import notation
from eap.ops.od import (
    Download,
    OdDumpEntry,
    OdLoadResult,
    OdOctets,
    OdValue,
    OdWholeObject,
)

Entry: TypeAlias = OdValue | OdDumpEntry

RAW = "hex"
_FROM = 10
"""Numbers from here on look different in hexadecimal digits."""
_LINE = re.compile(r"(?P<entry>\w+(?::\w+)?)\s*=\s*(?P<type>\S+)(?:\s+(?P<rest>.*))?", re.ASCII)
_REMARK = re.compile(r"(?:^|\s)#.*$")


def value_line(entry: Entry) -> str:
    """Return an entry with its value."""
    remarks = ", ".join(filter(None, [entry.name, entry.unit, _hexadecimal(entry.value)]))
    data = entry.data or ""
    line = f"{ObjectId(entry.index, entry.subindex)} = {_literal(entry, data)}"
    return f"{line}  # {remarks}" if remarks else line


def octets_line(written: OdOctets) -> str:
    """Return raw bytes that were written."""
    return f"{ObjectId(written.index, written.subindex)} = {RAW} {written.data}"


def object_lines(found: OdWholeObject) -> Iterator[str]:
    """Yield a whole object: its entries, or its raw bytes if their types are unknown."""
    yield _object_line(found.index, found.name, found.label)
    if not found.entries:
        octets = bytes.fromhex(found.data)
        yield f"{RAW} {octets.hex(' ')}  # {len(octets)} bytes"
    yield from map(value_line, found.entries)


def _object_line(index: int, name: str, label: str) -> str:
    return f"# 0x{index:04X} {object_name(name, label)}"


def object_name(name: str, label: str) -> str:
    """Return the name of an object, with that of the frame, PD or port that it describes."""
    return f"{name} ({label})" if label else name


def load_line(done: OdLoadResult) -> str:
    """Return the result of ``od write --from``."""
    rest = f", {done.unchanged} were there already" if done.unchanged else ""
    word = "entry" if done.written == 1 else "entries"
    return f"{done.target}: {done.written} {word} written{rest}"


def dump_lines(target: str, rows: Iterable[OdDumpEntry]) -> Iterator[str]:
    """Yield entries for people; those that cannot be written, or read, are behind a ``#``."""
    yield f"# The objects of {target}.  'eapctl od write TARGET --from FILE' writes them to another"
    yield "# device; what is behind a # cannot be written, or is a remark."
    index = -1
    for row in rows:
        if row.index != index:
            index = row.index
            yield ""
            yield _object_line(index, row.object, row.label)
        if row.data is None:
            reason = row.error or "cannot be read"
            yield f"# {ObjectId(index, row.subindex)}: {reason}  # {row.name}"
        else:
            yield f"{'' if 'w' in row.access else '# '}{value_line(row)}"


def read_file(path: Path) -> list[Download]:
    """Return the entries of a file, ``-`` for stdin.

    Raises:
        ConfigError: a line cannot be read; the message names the line and the cause.
        OSError: the file cannot be read.
    """
    text = sys.stdin.read() if str(path) == "-" else path.read_text(encoding="utf-8")
    entries = []
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if not line or line.startswith("#"):
            continue
        try:
            entry = _from_json(line) if line.startswith("{") else _from_text(line)
        except ValueError as exc:
            raise ConfigError(f"{path}:{number}: {exc}") from None
        if entry is not None:
            entries.append(entry)
    return entries


def _from_json(line: str) -> Download | None:
    try:
        row = msgspec.json.decode(line, type=_JsonEntry)
    except (ValueError, RecursionError) as exc:
        raise ValueError(f"not an entry as 'od dump --json' prints it: {exc}") from None
    # A dump has all entries; those that cannot be written are for its readers.
    if row.data is None or "w" not in row.access:
        return None
    return row.index, row.subindex, bytes.fromhex(row.data)


def _from_text(line: str) -> Download:
    match = _LINE.fullmatch(line)
    if match is None:
        raise ValueError(f"{line!r} is not INDEX:SUB = TYPE VALUE, such as 0xD000:07 = UDINT 10000")
    index, subindex = ObjectId.parse(match["entry"])
    rest = match["rest"] or ""
    # A quoted text may hold a #, which begins a remark everywhere else.
    value = _quoted(rest) if rest.startswith('"') else _REMARK.sub("", rest).strip()
    if match["type"] == RAW:
        return index, subindex, bytes.fromhex(value)
    return index, subindex, notation.parse(datatypes.parse(match["type"]), value)


def _quoted(text: str) -> str:
    value: Any
    value, end = json.JSONDecoder().raw_decode(text)
    if _REMARK.sub("", text[end:]).strip():
        raise ValueError(f"{text[end:]!r} follows the text")
    return str(value)


def _literal(entry: Entry, data: str) -> str:
    """Return type and value, in a form that reads back as the same bytes."""
    octets = bytes.fromhex(data)
    kind = datatypes.parse(entry.type) if entry.type else None
    text = notation.show(kind, entry.name, octets) if kind else None
    # Tried by reading it back: a float, or a text with padding, may have bytes that no literal has.
    if kind is None or text is None or not _is_exact(kind, text, octets):
        return f"{RAW} {data}"
    if kind.name != kind.text:
        # Behind the type, whose whole definition would be needed, nobody finds the value.
        return f"{RAW} {data}  # {kind.name} {text}"
    is_text = kind.text.startswith("STRING")
    return f"{kind.text} {json.dumps(text, ensure_ascii=False) if is_text else text}"


def _is_exact(kind: DataType, text: str, octets: bytes) -> bool:
    try:
        return notation.parse(kind, text) == octets
    except ValueError:
        return False


def _hexadecimal(value: Any) -> str:
    if isinstance(value, int) and not isinstance(value, bool) and value >= _FROM:
        return f"0x{value:X}"
    return ""


class _JsonEntry(msgspec.Struct):
    """Needed fields of a JSON line."""

    index: int
    subindex: int
    data: str | None
    access: str = "rw"
