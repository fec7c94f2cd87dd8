"""Values of entries as people read and write them, and as JSON carries them.

Octets that are an address are shown as one, told by the name of their entry; what is written in the
form of an address is read as one, for whatever entry has its length.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from eap.codec.datatypes import DataType, Plain
from eap.od.profiles.forms import Form, from_text, to_text

_TEXT, _OCTETS = 0x09, 0x0A


class _Address(NamedTuple):
    """A kind of address: its length, the entries that hold it, and what its text looks like."""

    form: Form
    size: int
    names: re.Pattern[str]
    text: re.Pattern[str]


_ADDRESSES = (
    _Address(
        Form.MAC,
        6,
        re.compile(r"\bMAC\b"),
        re.compile(r"[0-9A-Fa-f]{2}([:-][0-9A-Fa-f]{2}){5}"),
    ),
    _Address(
        Form.NET_ID,
        6,
        re.compile(r"\bNet ?ID\b|\bpublisher\b", re.IGNORECASE),
        re.compile(r"\d+(\.\d+){5}", re.ASCII),
    ),
    _Address(Form.IP, 4, re.compile(r"\bIP\b"), re.compile(r"\d+(\.\d+){3}", re.ASCII)),
)


def plain(kind: DataType, name: str, octets: bytes) -> Plain | None:
    """Return the value of an entry called *name* for JSON; None if *octets* are no such value."""
    if kind.code == _TEXT:
        return octets.rstrip(b"\0").decode(errors="replace")
    if len(octets) != kind.size:
        return None
    if kind.code == _OCTETS:
        for each in _ADDRESSES:
            if kind.size == each.size and each.names.search(name):
                return to_text(each.form, kind, octets)
        return octets.hex()
    try:
        return kind.to_plain(kind.decode(octets, 0))
    except ValueError:
        return None


def parse(kind: DataType, text: str) -> bytes:
    """Return the octets of a value as typed; raise ValueError that says what was expected.

    A text of the dictionary is as long as it is: nothing is filled up.
    """
    if kind.code == _OCTETS:
        for each in _ADDRESSES:
            if kind.size == each.size and each.text.fullmatch(text):
                return from_text(each.form, kind, text)
    octets = kind.encode(kind.parse_text(text))
    return octets.rstrip(b"\0") if kind.code == _TEXT else octets


def show(value: Plain) -> str:
    """Return a value of ``plain`` in the form that ``parse`` reads."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, list):
        return ",".join(map(str, value))
    return str(value)
