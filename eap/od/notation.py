"""Notation of entry values: text for operators, and JSON.

An address, a mapping or the index of another object is recognized by the name of its entry, because
a foreign device gives nothing else.  A text in one of these forms is read as such for every entry
of its length.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from eap.codec.datatypes import Block, DataType, Plain
from eap.codec.literals import write_literal
from eap.od.profiles.table import Form, from_text, to_text


class _Known(NamedTuple):
    """Form of entries of a type and a name, and the pattern of its text."""

    form: Form
    type: str
    names: re.Pattern[str]
    text: re.Pattern[str]


_KNOWN = (
    _Known(
        Form.MAC,
        "BLOCK(6)",
        re.compile(r"\bMAC\b"),
        re.compile(r"[0-9A-Fa-f]{2}([:-][0-9A-Fa-f]{2}){5}"),
    ),
    _Known(
        Form.NET_ID,
        "BLOCK(6)",
        re.compile(r"\bNet ?ID\b|\bpublisher\b", re.IGNORECASE),
        re.compile(r"\d+(\.\d+){5}", re.ASCII),
    ),
    _Known(Form.IP, "BLOCK(4)", re.compile(r"\bIP\b"), re.compile(r"\d+(\.\d+){3}", re.ASCII)),
    _Known(
        Form.MAPPING,
        "UDINT",
        re.compile(r"Mapping \d+"),
        re.compile(r"(0x)?[0-9A-Fa-f]+:(0x)?[0-9A-Fa-f]+/\d+", re.ASCII | re.IGNORECASE),
    ),
    _Known(
        Form.INDEX,
        "UINT",
        re.compile(r"PDO index|TxPD \d+|Poll request [RT]xPD"),
        re.compile(r"0x[0-9A-Fa-f]{4}"),
    ),
)


def plain(kind: DataType, name: str, octets: bytes) -> Plain | None:
    """Return the value of an entry called *name* for JSON; None if *octets* are no such value."""
    if kind.is_text:
        return octets.rstrip(b"\0").decode(errors="replace")
    if len(octets) != kind.size:
        return None
    if isinstance(kind, Block):
        form = _form(kind, name)
        return octets.hex() if form is Form.PLAIN else to_text(form, kind, octets)
    try:
        return kind.to_plain(kind.decode(octets, 0))
    except ValueError:
        return None


def parse(kind: DataType, text: str) -> bytes:
    """Return the bytes of a value as typed; raise ValueError that says what was expected.

    A text of the dictionary is as long as it is: nothing is filled up.
    """
    for each in _KNOWN:
        if kind.text == each.type and each.text.fullmatch(text):
            return from_text(each.form, kind, text)
    octets = kind.encode(kind.parse_text(text))
    return octets.rstrip(b"\0") if kind.is_text else octets


def show(kind: DataType, name: str, octets: bytes) -> str | None:
    """Return the value of an entry as ``parse`` reads it; None if *octets* are no such value."""
    value = plain(kind, name, octets)
    if value is None:
        return None
    form = _form(kind, name)
    if form is not Form.PLAIN:
        return to_text(form, kind, octets)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        value = _short(kind, value)
    if isinstance(value, list) and not any(isinstance(each, list | dict | str) for each in value):
        return ",".join(map(str, value))
    return str(value) if isinstance(value, str) else write_literal(value)


def _short(kind: DataType, value: float) -> float:
    """Return the number with the fewest digits that *kind* stores as *value*: 0.1 of a REAL."""
    shorter = (float(f"{value:.{digits}g}") for digits in range(6, 10))
    octets = kind.encode(value)
    return next((each for each in shorter if kind.encode(each) == octets), value)


def _form(kind: DataType, name: str) -> Form:
    for each in _KNOWN:
        if kind.text == each.type and each.names.search(name):
            return each.form
    return Form.PLAIN
