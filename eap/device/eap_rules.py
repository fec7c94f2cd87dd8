"""What an entry of an EAP device's configuration may hold, beyond its size and limits.

Each rule takes the octets of a download and returns them as they are to be stored, or raises
ValueError with the reason; the dictionary makes an abort of it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from ipaddress import IPv4Address

from eap.codec import datatypes
from eap.ids import MacAddr
from eap.od.model import Entry
from eap.od.profiles.eap1000 import (
    MORE_RX_PDO,
    MORE_TX_PDO,
    RX_PD,
    RX_PDO,
    RX_VARIABLE,
    TX_FRAME,
    TX_PD,
    TX_PDO,
    TX_VARIABLE,
)
from eap.od.profiles.eap1000keys import Frame, Rx, RxFlag, Tx, Var
from eap.od.profiles.table import ObjectRange
from eap.pd.address import address_text, source_octets
from eap.pd.layout import FRAME_CTRL, VAR_CTRL

GROUPS = 0xF811
CONTROL = 0xF200
REQUESTED = frozenset({2, 4, 8})
"""States that can be asked for; Init cannot."""
_BOOL = 0x01
_NAME = re.compile(r"[^\s/]+")
_NAME_ENTRIES = {
    (TX_FRAME.first, Frame.NAME), (TX_PD.first, Tx.NAME), (RX_PD.first, Rx.NAME),
    (TX_VARIABLE.first, Var.NAME), (RX_VARIABLE.first, Var.NAME),
}  # fmt: skip
_REFERENCES: dict[tuple[int, int], tuple[ObjectRange, ...]] = {
    (TX_PD.first, Tx.PDO_INDEX): (TX_PDO, MORE_TX_PDO),
    (TX_PD.first, Tx.POLL_REQUEST_RXPD): (RX_PD,),
    (RX_PD.first, Rx.PDO_INDEX): (RX_PDO, MORE_RX_PDO),
    (RX_PD.first, Rx.POLL_REQUEST_TXPD): (TX_PD,),
    (TX_FRAME.first, Frame.TXPD): (TX_PD,),
}


def check_name(name: str) -> None:
    """Refuse what is no name of the house."""
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} is no name: a text without spaces and slashes")
    if name.endswith((VAR_CTRL, FRAME_CTRL)):
        raise ValueError(f"{name!r}: {VAR_CTRL} and {FRAME_CTRL} are made by the appliance")


def checked(row: ObjectRange, subindex: int, entry: Entry, data: bytes) -> bytes:
    """Return *data* as *entry* at *subindex* of one of *row*'s objects stores it."""
    if entry.is_text:
        data = _text(data)
    list_row = row.list_row
    first = list_row.subindex if list_row and subindex >= list_row.subindex else subindex
    key = (row.first, first)
    if key in _NAME_ENTRIES:
        check_name(data.decode())
    elif key in _REFERENCES:
        _check_reference(int.from_bytes(data, "little"), _REFERENCES[key])
    elif rule := _RULES.get(key):
        data = rule(data, entry)
    elif entry.kind.code == _BOOL:
        data = _truth(data, entry)
    return data


def is_group(text: str, *, ethernet: bool | None) -> bool:
    """Tell whether *text* is a multicast address: a MAC, an IPv4 address, or with None neither."""
    if ethernet is None:
        return False
    try:
        return MacAddr.parse(text).is_group if ethernet else IPv4Address(text).is_multicast
    except ValueError:
        return False


def _text(data: bytes) -> bytes:
    data = data.rstrip(b"\0")
    if 0 in data:
        raise ValueError("text with a NUL in it")
    try:
        data.decode()
    except UnicodeDecodeError:
        raise ValueError("text is no UTF-8") from None
    return data


def _check_reference(index: int, ranges: tuple[ObjectRange, ...]) -> None:
    if index and not any(row.first <= index <= row.last for row in ranges):
        expected = " or ".join(f"0x{row.first:04X} to 0x{row.last:04X}" for row in ranges)
        raise ValueError(f"0x{index:04X} cannot be referred to here: {expected}, or 0 for none")


def _type(data: bytes, _entry: Entry) -> bytes:
    return datatypes.parse(data.decode()).text.encode()


def _truth(data: bytes, _entry: Entry) -> bytes:
    return bytes((data != b"\0",))


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
    if text and not (is_group(text, ethernet=True) or is_group(text, ethernet=False)):
        raise ValueError(f"{text!r} is no multicast address (MAC or IPv4)")
    return str(MacAddr.parse(text)).encode() if ":" in text or "-" in text else data


def _request(data: bytes, _entry: Entry) -> bytes:
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


_RULES: dict[tuple[int, int], Callable[[bytes, Entry], bytes]] = {
    (TX_VARIABLE.first, Var.TYPE_NAME): _type,
    (RX_VARIABLE.first, Var.TYPE_NAME): _type,
    (TX_VARIABLE.first, Var.DEFAULT): _default,
    (RX_VARIABLE.first, Var.DEFAULT): _default,
    (GROUPS, 1): _group,
    (CONTROL, 1): _request,
    (RX_PD.first, Rx.FLAGS): _flags,
    (RX_PD.first, Rx.SOURCE): _source,
}
