"""Objects of any device as plain data: read, written, listed, with their types and names."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from msgspec.structs import replace

from eap.appliance.commands.od_device import Content, EntryInfo, ObjectInfo, OdDevice
from eap.codec import pdo
from eap.codec.datatypes import DataType
from eap.errors import ConfigError
from eap.ids import ObjectId
from eap.od import notation
from eap.od.dictionary import take_bits

_PLAIN_SIZES = (1, 2, 4, 8)


def read_entry(
    device: OdDevice, index: int, subindex: int, kind: DataType | None = None
) -> dict[str, Any]:
    """Return an entry as a row; *kind* instead of the type that the device tells.

    Raises:
        SdoAbortError, ControlError: the device refuses.
    """
    octets = device.read(index, subindex)
    entry = device.entry(index, subindex) or EntryInfo(subindex, "", None, "")
    if kind is not None:
        entry = replace(entry, kind=kind)
    return _row(index, entry, octets)


def read_object(device: OdDevice, index: int, first: int) -> dict[str, Any]:
    """Return an object that was read as a whole from subindex *first* on, with its entries.

    Raises:
        SdoAbortError, ControlError: the device refuses.
    """
    octets = device.read(index, first, complete=True)
    found = device.describe(index)
    row = {"index": index, "subindex": first, "complete": True, "name": found.name}
    return row | {
        "label": found.label,
        "data": octets.hex(),
        "entries": _parts(found, first, octets),
    }


def write_entry(
    device: OdDevice, index: int, subindex: int, text: str, kind: DataType | None = None
) -> dict[str, Any]:
    """Write a value as typed, by the type that the device tells or by *kind*; return its row.

    Raises:
        ConfigError: *text* is no value of the type, or nobody knows the type.
        SdoAbortError, ControlError: the device refuses.
    """
    name = str(ObjectId(index, subindex))
    entry = device.entry(index, subindex) or EntryInfo(subindex, "", None, "")
    kind = kind or entry.kind
    if kind is None:
        raise ConfigError(
            f"{name}: nobody tells its type: say it with --type, such as UINT, or give the octets"
            " with --hex"
        )
    try:
        octets = notation.parse(kind, text)
    except ValueError as exc:
        raise ConfigError(f"{name}: {exc}") from None
    device.write(index, subindex, octets)
    return _row(index, replace(entry, kind=kind), octets)


def write_octets(
    device: OdDevice, index: int, subindex: int, octets: bytes, *, complete: bool
) -> dict[str, Any]:
    """Write octets as they are; return them as a row; raises as write_entry does."""
    device.write(index, subindex, octets, complete=complete)
    return {"index": index, "subindex": subindex, "complete": complete, "data": octets.hex()}


def object_rows(objects: Iterable[ObjectInfo]) -> Iterator[dict[str, Any]]:
    """Yield objects without their entries."""
    for each in objects:
        yield {
            "index": each.index,
            "name": each.name,
            "label": each.label,
            "code": each.code,
            "max_subindex": each.max_subindex,
        }


def dump_rows(contents: Iterable[Content]) -> Iterator[dict[str, Any]]:
    """Yield entries with their values, or with the reason why there is none."""
    for each in contents:
        row = {"object": each.object.name, "label": each.object.label, "code": each.object.code}
        row |= _row(each.object.index, each.entry, each.octets)
        yield row | {"error": each.error} if each.error else row


def _row(index: int, entry: EntryInfo, octets: bytes | None) -> dict[str, Any]:
    kind = entry.kind
    value: Any = None
    if octets is not None and kind is not None:
        value = notation.plain(kind, entry.name, octets)
    elif octets is not None and len(octets) in _PLAIN_SIZES:
        value = int.from_bytes(octets, "little")
    return {
        "index": index,
        "subindex": entry.subindex,
        "complete": False,
        "name": entry.name,
        "access": entry.access,
        "type": kind.text if kind else None,
        "unit": entry.unit,
        "value": value,
        "data": None if octets is None else octets.hex(),
    }


def _parts(found: ObjectInfo, first: int, octets: bytes) -> list[dict[str, Any]]:
    """Return the entries that *octets* are made of, as far as the types are known."""
    rows = []
    chosen = [each for each in found.entries if 1 <= each.subindex <= found.max_subindex]
    if first == 0:
        count = next((each for each in found.entries if each.subindex == 0), None)
        if count is not None:
            rows.append(_row(found.index, count, octets[:1]))
        octets = octets[2:]
    kinds = [each.kind for each in chosen if each.kind is not None]
    plan = pdo.layout(kinds)
    if len(kinds) != len(chosen) or plan.size != len(octets):
        return rows
    for entry, kind, bit_offset in zip(chosen, kinds, plan.bit_offsets, strict=True):
        rows.append(_row(found.index, entry, take_bits(octets, bit_offset, kind)))
    return rows
