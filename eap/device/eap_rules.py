"""Rules for the content of single entries, beyond size and limits, by the name in their rows.

Each takes the octets of a download and returns them as they are to be stored, or raises ValueError
with the reason; the dictionary makes an abort of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from eap.codec import datatypes
from eap.ids import MacAddr
from eap.od.model import Entry
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import RxFlag
from eap.od.profiles.forms import Rule
from eap.od.profiles.table import ObjectRow
from eap.pd.address import address_text, source_octets
from eap.pd.rules import MADE_SUFFIXES, NAME, is_group, is_name

REQUESTED = frozenset({2, 4, 8})
"""States that can be asked for; Init cannot."""
_BOOL = 0x01


def checked(row: ObjectRow, subindex: int, entry: Entry, data: bytes) -> bytes:
    """Return *data* as *entry* at *subindex* of one of *row*'s objects stores it."""
    if entry.is_text:
        data = _text(data)
    list_row = row.list_row
    first = list_row.subindex if list_row and subindex >= list_row.subindex else subindex
    ruled = _RULED.get((row.first, first))
    if ruled is not None and ruled.refers:
        _check_reference(int.from_bytes(data, "little"), ruled.refers)
    elif ruled is not None:
        data = _RULES[ruled.rule](data, entry)
    elif entry.kind.code == _BOOL:
        data = bytes((data != b"\0",))
    return data


def _text(data: bytes) -> bytes:
    data = data.rstrip(b"\0")
    if 0 in data:
        raise ValueError("text with a NUL in it")
    try:
        data.decode()
    except UnicodeDecodeError:
        raise ValueError("text is no UTF-8") from None
    return data


def _check_reference(index: int, ranges: tuple[int, ...]) -> None:
    if not index:
        return
    rows = [profile.row_of(first) for first in ranges]
    if not any(row.first <= index <= row.last for row in rows):
        expected = " or ".join(f"0x{row.first:04X} to 0x{row.last:04X}" for row in rows)
        raise ValueError(f"0x{index:04X} cannot be referred to here: {expected}, or 0 for none")


def _name(data: bytes, _entry: Entry) -> bytes:
    name = data.decode()
    if not is_name(name):
        raise ValueError(f"{name!r} is no name: {NAME}")
    if name.endswith(MADE_SUFFIXES):
        raise ValueError(f"{name!r}: {' and '.join(MADE_SUFFIXES)} are made by the appliance")
    return data


def _type(data: bytes, _entry: Entry) -> bytes:
    return datatypes.parse(data.decode()).text.encode()


def _flags(data: bytes, _entry: Entry) -> bytes:
    known = RxFlag.ENABLED | RxFlag.IGNORE_NETID | RxFlag.IGNORE_VERSION
    if data[0] & ~known:
        raise ValueError(f"flags 0x{data[0]:02X}: of the flags 0x{known:02X} only")
    return data


def _default(data: bytes, entry: Entry) -> bytes:
    value = entry.kind.decode(data.ljust(entry.kind.size, b"\0"), 0)
    numbers = value if isinstance(value, tuple) else (value,)
    if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
        raise ValueError("a default is a finite number")
    # A bit field is stored without the bits beyond it.
    return entry.kind.encode(value) if entry.kind.is_bits else data


def _group(data: bytes, _entry: Entry) -> bytes:
    text = data.decode()
    if text and not (is_group(text, "ethernet") or is_group(text, "udp")):
        raise ValueError(f"{text!r} is no multicast address (MAC or IPv4)")
    return str(MacAddr.parse(text)).encode() if ":" in text or "-" in text else data


def _state(data: bytes, _entry: Entry) -> bytes:
    state = int.from_bytes(data, "little")
    if state not in REQUESTED:
        raise ValueError(f"{state} cannot be requested: 2 PreOp, 4 SafeOp or 8 Op")
    return data


def _source(data: bytes, _entry: Entry) -> bytes:
    text = data.decode()
    try:
        return address_text(source_octets(text)).encode() if text else data
    except ValueError:
        raise ValueError(f"{text!r} is no MAC and no IPv4 address") from None


_RULED = {
    (row.first, each.subindex): each
    for row in profile.ALL
    for each in row.entries
    if each.refers or each.rule is not Rule.NONE
}
_RULES: dict[Rule, Callable[[bytes, Entry], bytes]] = {
    Rule.NAME: _name,
    Rule.TYPE: _type,
    Rule.DEFAULT: _default,
    Rule.FLAGS: _flags,
    Rule.GROUP: _group,
    Rule.SOURCE: _source,
    Rule.STATE: _state,
}
