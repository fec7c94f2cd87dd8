"""What ``eapctl od dump`` prints, read again: as text for people, or as JSON lines."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from eap.appliance.commands.od_load import Download
from eap.cli.od_view import RAW, Row, object_line, value_line
from eap.codec import datatypes
from eap.errors import ConfigError
from eap.ids import ObjectId
from eap.od import notation

_LINE = re.compile(r"(?P<entry>\w+(?::\w+)?)\s*=\s*(?P<type>\S+)(?:\s+(?P<rest>.*))?", re.ASCII)
_REMARK = re.compile(r"(?:^|\s)#.*$")


def dump_lines(target: str, rows: Iterable[Row]) -> Iterator[str]:
    """Yield entries for people; what cannot be written, or read, is behind a ``#``."""
    yield f"# The objects of {target}.  'eapctl od write TARGET --from FILE' writes them to another"
    yield "# device; what is behind a # cannot be written, or is a remark."
    index = -1
    for row in rows:
        if row["index"] != index:
            index = row["index"]
            yield ""
            yield object_line(row)
        if row["data"] is None:
            reason = row.get("error") or "cannot be read"
            yield f"# {ObjectId(index, row['subindex'])}: {reason}  # {row['name']}"
        else:
            yield f"{'' if 'w' in row['access'] else '# '}{value_line(row)}"


def read_file(path: Path) -> list[Download]:
    """Return the entries of a file, ``-`` for stdin.

    Raises:
        ConfigError: a line cannot be read; the message says which one, and why.
        OSError: the file cannot be read.
    """
    import sys

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
    except msgspec.MsgspecError as exc:
        raise ValueError(f"not an entry as 'od dump --json' prints it: {exc}") from None
    if row.data is None or "w" not in row.access:
        return None
    return row.index, row.subindex, bytes.fromhex(row.data)


def _from_text(line: str) -> Download:
    match = _LINE.fullmatch(line)
    if match is None:
        raise ValueError(f"{line!r} is not INDEX:SUB = TYPE VALUE, such as 0xD000:07 = UDINT 10000")
    index, subindex = ObjectId.parse(match["entry"])
    rest = match["rest"] or ""
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


class _JsonEntry(msgspec.Struct):
    """What is needed of a line."""

    index: int
    subindex: int
    data: str | None
    access: str = "rw"
