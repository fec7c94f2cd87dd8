"""Objects of slaves as plain data: read, written, listed, with the types the slaves tell."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from typing import Any

from devicebus.errors import MailboxProtocolError, MailboxRefusedError
from devicebus.mailbox import coe_client, coeinfo_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.commands.bus_slave import Slave, SlaveBus
from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.codec.sdoinfo import EntryDescription
from eap.errors import ConfigError, EapError
from eap.ids import ObjectId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import Access, ObjectCode

_TEXT, _OCTETS = 0x09, 0x0A
_NUMBERS = (
    *("BOOL", "SINT", "INT", "DINT", "USINT", "UINT", "UDINT", "REAL", "INT24", "LREAL", "INT40"),
    *("INT48", "INT56", "LINT", "UINT24", "UINT40", "UINT48", "UINT56", "ULINT", "BYTE", "WORD"),
    *("DWORD", *(f"BIT{n}" for n in range(1, 9))),
)
_PLAIN_SIZES = (1, 2, 4, 8)


def read_entry(
    bus: SlaveBus, slave: str, index: int, subindex: int, *, kind: DataType | None, complete: bool
) -> dict[str, Any]:
    """Return an entry, or with *complete* the octets of an object.

    Raises:
        SdoAbortError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)

    def conversation(sizes: MailboxSizes) -> Conversation[dict[str, Any]]:
        del sizes
        octets = yield from coe_client.upload(index, subindex, complete=complete)
        known = kind
        if known is None and not complete:
            known = yield from _kind_of_entry(index, subindex)
        row = {"index": index, "subindex": subindex, "complete": complete}
        return row | _shown(known, octets, complete=complete)

    return {"slave": unit.station} | bus.converse(unit, conversation, _name(index, subindex))


def write_entry(
    bus: SlaveBus,
    slave: str,
    index: int,
    subindex: int,
    text: str,
    *,
    kind: DataType | None,
    complete: bool,
) -> dict[str, Any]:
    """Write an entry, or with *complete* a whole object given as hexadecimal digits.

    Raises:
        ConfigError: *text* is no value of the entry's type, or nobody knows the type.
        SdoAbortError: the slave refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)

    def conversation(sizes: MailboxSizes) -> Conversation[bytes]:
        known = kind
        if known is None and not complete:
            known = yield from _kind_of_entry(index, subindex)
        octets = _octets_of(text, known, _name(index, subindex), complete=complete)
        yield from coe_client.download(index, subindex, octets, sizes, complete=complete)
        return octets

    octets = bus.converse(unit, conversation, _name(index, subindex))
    return {
        "slave": unit.station,
        "index": index,
        "subindex": subindex,
        "complete": complete,
        "data": octets.hex(),
    }


def list_objects(bus: SlaveBus, slave: str) -> Iterator[dict[str, Any]]:
    """Yield what a slave says of each of its objects; raises as read_entry() does."""
    unit = bus.find(slave)
    indexes = bus.converse(unit, lambda _: coeinfo_client.object_list(), "object list")
    for index in indexes:
        yield _described(bus, unit, index)


def dump_entries(bus: SlaveBus, slave: str) -> Iterator[dict[str, Any]]:
    """Yield every entry of every object with its value; refusals are in *error* of the entry."""
    unit = bus.find(slave)
    for found in list_objects(bus, slave):
        index = found["index"]
        for subindex in range(found["max_subindex"] + 1):
            row = _dumped(bus, unit, index, subindex)
            if row is not None:
                yield {"index": index, "subindex": subindex, "object": found["name"]} | row


def _described(bus: SlaveBus, unit: Slave, index: int) -> dict[str, Any]:
    found = bus.converse(unit, lambda _: coeinfo_client.object_description(index), _name(index))
    codes = ObjectCode._value2member_map_
    return {
        "index": index,
        "name": found.name,
        "code": ObjectCode(found.code).name if found.code in codes else str(found.code),
        "data_type": found.data_type,
        "max_subindex": found.max_subindex,
    }


def _dumped(bus: SlaveBus, unit: Slave, index: int, subindex: int) -> dict[str, Any] | None:
    """Return one entry, None for a gap."""
    name = _name(index, subindex)
    try:
        entry = bus.converse(
            unit, lambda _: coeinfo_client.entry_description(index, subindex), name
        )
    except SdoAbortError as exc:
        gaps = {AbortCode.NO_SUBINDEX, AbortCode.NO_OBJECT, AbortCode.NOT_STORED}
        return None if exc.code in gaps else {"name": "", "error": str(exc)}
    except MailboxProtocolError as exc:  # one bad description is no reason to lose all others
        return {"name": "", "error": str(exc)}
    row: dict[str, Any] = {"name": entry.name, "access": _access(entry)}
    if not entry.access & Access.READ_ANY:
        return row | _shown(kind_of(entry), None, complete=False)
    try:
        octets = bus.converse(unit, lambda _: coe_client.upload(index, subindex), name)
    except (SdoAbortError, MailboxProtocolError) as exc:
        return row | {"error": str(exc)}
    return row | _shown(kind_of(entry), octets, complete=False)


def _name(index: int, subindex: int | None = None) -> str:
    return f"0x{index:04X}" if subindex is None else str(ObjectId(index, subindex))


def _access(entry: EntryDescription) -> str:
    reads = "r" if entry.access & Access.READ_ANY else ""
    return f"{reads}w" if entry.access & Access.WRITE_ANY else reads


def _kind_of_entry(index: int, subindex: int) -> Conversation[DataType | None]:
    """Ask the slave for an entry's type; None if it does not tell."""
    try:
        entry = yield from coeinfo_client.entry_description(index, subindex)
    except (SdoAbortError, MailboxRefusedError, MailboxProtocolError):
        return None
    return kind_of(entry)


def kind_of(entry: EntryDescription) -> DataType | None:
    """Return the type of an entry, None if it is none of ours."""
    size = max(1, (entry.bit_length + 7) // 8)
    if entry.data_type == _TEXT:
        return datatypes.parse(f"STRING({size})")
    if entry.data_type == _OCTETS:
        return datatypes.parse(f"BLOCK({size})")
    return _numbers().get(entry.data_type)


@cache
def _numbers() -> dict[int, DataType]:
    return {kind.code: kind for kind in map(datatypes.parse, _NUMBERS)}


def _shown(kind: DataType | None, octets: bytes | None, *, complete: bool) -> dict[str, Any]:
    """Return type, value and octets as far as they are known."""
    row: dict[str, Any] = {"type": kind.text if kind else None, "value": None}
    if octets is None:
        return row | {"data": None}
    row["data"] = octets.hex()
    if kind is not None and kind.is_text:
        row["value"] = octets.rstrip(b"\0").decode(errors="replace")
    elif kind is not None and kind.code == _OCTETS:
        row["value"] = octets.hex()
    elif kind is not None and len(octets) == kind.size:
        with suppress(ValueError):
            row["value"] = kind.to_plain(kind.decode(octets, 0))
    elif kind is None and not complete and len(octets) in _PLAIN_SIZES:
        row["value"] = int.from_bytes(octets, "little")
    return row


def _octets_of(text: str, kind: DataType | None, name: str, *, complete: bool) -> bytes:
    try:
        if complete:
            return bytes.fromhex(text)
        if kind is not None:
            return kind.encode(kind.parse_text(text))
    except (EapError, ValueError) as exc:
        raise ConfigError(f"{name}: {exc}") from None
    raise ConfigError(f"{name}: the slave does not tell its type: say it with --type, such as UINT")
