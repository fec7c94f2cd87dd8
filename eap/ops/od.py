"""Object dictionaries of any device, as commands use them: typed results on one interface.

Three kinds fit :class:`OdDevice` (eap/ops/od_devices.py): an EAP port or a router of
a running station, a slave behind one of its buses, and any device that ADS reaches.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from typing import Any, NamedTuple, Protocol, TypeAlias

import msgspec
from msgspec import UNSET, UnsetType
from msgspec.structs import replace

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.errors import ConfigError, ControlError, EapError
from eap.ids import ObjectId
from eap.od import notation
from eap.od.dictionary import extract_bits

_PLAIN_SIZES = (1, 2, 4, 8)

Download: TypeAlias = tuple[int, int, bytes]
"""Index, subindex and bytes."""

CONTROL = 0xF200
"""Requests to a device are no part of its configuration."""
_MAPPINGS = (
    range(0x1600, 0x1C00),
    range(0x1C10, 0x1C30),
    range(0x2000, 0x2E00),
    range(0x3000, 0x3E00),
)
"""PDOs and their assignment (ETG.1000.6), and the further PDOs of an EAP port."""
_RANKS = (
    (range(0x6000, 0x8000), 0),
    *((each, 1) for each in _MAPPINGS),
    (range(0xD000, 0xF000), 2),
    (range(0x8000, 0x9000), 3),
)
_LAST = 4


class EntryInfo(msgspec.Struct, frozen=True):
    """Description of one entry by its device."""

    subindex: int
    name: str
    kind: DataType | None
    """None if the device does not describe it, or the type is not known here."""
    access: str
    """``r``, ``w`` or ``rw``, empty if it does not tell."""
    unit: str = ""


class ObjectInfo(msgspec.Struct, frozen=True):
    """Description of one object by its device."""

    index: int
    name: str
    code: str
    """VAR, ARRAY, RECORD, or its number."""
    max_subindex: int
    label: str = ""
    """Name of the frame, PD or port that it describes, if the device has it."""
    entries: tuple[EntryInfo, ...] = ()
    """In the order of their subindexes; gaps are left out."""


class Content(msgspec.Struct, frozen=True):
    """One entry with its bytes, or with the reason why they cannot be read."""

    object: ObjectInfo
    entry: EntryInfo
    octets: bytes | None
    error: str = ""


class OdDevice(Protocol):
    """A device with an object dictionary."""

    def objects(self) -> Sequence[ObjectInfo]:
        """Return all objects in the order of their indexes, without their entries."""

    def describe(self, index: int) -> ObjectInfo:
        """Return one object with its entries; refuse as ``read`` does."""

    def entry(self, index: int, subindex: int) -> EntryInfo | None:
        """Return the description of an entry, also of one that a download would create.

        None without a description; raises if the description excludes such an entry.
        """

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the bytes of an entry or, with *complete*, of an object; raise if refused."""

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        """Write an entry or, with *complete*, an object; raise if refused."""

    def contents(self) -> Iterable[Content]:
        """Return all entries of all objects."""


class OdValue(msgspec.Struct, frozen=True, kw_only=True):
    """``eapctl od read`` and ``write``: an entry, its bytes in hexadecimal digits."""

    index: int
    subindex: int
    complete: bool
    name: str
    access: str
    type: str | None
    unit: str
    value: Any
    data: str | None


class OdOctets(msgspec.Struct, frozen=True):
    """``eapctl od write --hex``."""

    index: int
    subindex: int
    complete: bool
    data: str


class OdWholeObject(msgspec.Struct, frozen=True, kw_only=True):
    """``eapctl od read --complete``: an object from *subindex* on, with its entries."""

    index: int
    subindex: int
    complete: bool
    name: str
    label: str
    data: str
    entries: list[OdValue]


class OdObjectRow(msgspec.Struct, frozen=True):
    """``eapctl od list``."""

    index: int
    name: str
    label: str
    code: str
    max_subindex: int


class OdDumpEntry(msgspec.Struct, frozen=True, kw_only=True):
    """``eapctl od dump``: an entry with its value, or with the *error* why there is none."""

    object: str
    label: str
    code: str
    index: int
    subindex: int
    complete: bool
    name: str
    access: str
    type: str | None
    unit: str
    value: Any
    data: str | None
    error: str | UnsetType = UNSET


class OdLoadResult(msgspec.Struct, frozen=True):
    """``eapctl od write --from``: numbers of entries, as in LoadedEntries."""

    target: str
    written: int
    unchanged: int


class LoadedEntries(NamedTuple):
    """Numbers of entries: *unchanged* are those of objects that held all of it already."""

    written: int
    unchanged: int


def read_entry(
    device: OdDevice, index: int, subindex: int, kind: DataType | None = None
) -> OdValue:
    """Return an entry; *kind* instead of the type that the device describes.

    Raises:
        SdoAbortError, ControlError: the device refuses.
    """
    octets = device.read(index, subindex)
    entry = device.entry(index, subindex) or EntryInfo(subindex, "", None, "")
    if kind is not None:
        entry = replace(entry, kind=kind)
    return _value(index, entry, octets)


def read_object(device: OdDevice, index: int, first: int) -> OdWholeObject:
    """Return an object that was read as a whole from subindex *first* on, with its entries.

    Raises:
        SdoAbortError, ControlError: the device refuses.
    """
    octets = device.read(index, first, complete=True)
    found = device.describe(index)
    return OdWholeObject(
        index=index,
        subindex=first,
        complete=True,
        name=found.name,
        label=found.label,
        data=octets.hex(),
        entries=_parts(found, first, octets),
    )


def write_entry(
    device: OdDevice, index: int, subindex: int, text: str, kind: DataType | None = None
) -> OdValue:
    """Write a value as typed, by the type that the device describes or by *kind*.

    Raises:
        ConfigError: *text* is no value of the type, or the type is not known.
        SdoAbortError, ControlError: the device refuses.
    """
    name = str(ObjectId(index, subindex))
    entry = device.entry(index, subindex) or EntryInfo(subindex, "", None, "")
    kind = kind or entry.kind
    if kind is None:
        raise ConfigError(
            f"{name}: the device does not describe its type: give it with --type, such as UINT, or"
            " write bytes with --hex"
        )
    try:
        octets = notation.parse(kind, text)
    except ValueError as exc:
        raise ConfigError(f"{name}: {exc}") from None
    device.write(index, subindex, octets)
    return _value(index, replace(entry, kind=kind), octets)


def write_octets(
    device: OdDevice, index: int, subindex: int, octets: bytes, *, complete: bool
) -> OdOctets:
    """Write raw bytes; raises as write_entry does."""
    device.write(index, subindex, octets, complete=complete)
    return OdOctets(index, subindex, complete, octets.hex())


def object_rows(objects: Iterable[ObjectInfo]) -> Iterator[OdObjectRow]:
    """Yield objects without their entries."""
    for each in objects:
        yield OdObjectRow(each.index, each.name, each.label, each.code, each.max_subindex)


def dump_rows(contents: Iterable[Content]) -> Iterator[OdDumpEntry]:
    """Yield entries with their values, or with the reason why there is none."""
    for each in contents:
        found = each.object
        value = _value(found.index, each.entry, each.octets)
        yield OdDumpEntry(
            object=found.name,
            label=found.label,
            code=found.code,
            **msgspec.structs.asdict(value),
            error=each.error or UNSET,
        )


def _value(index: int, entry: EntryInfo, octets: bytes | None) -> OdValue:
    kind = entry.kind
    value: Any = None
    if octets is not None and kind is not None:
        value = notation.plain(kind, entry.name, octets)
    elif octets is not None and len(octets) in _PLAIN_SIZES:
        value = int.from_bytes(octets, "little")
    return OdValue(
        index=index,
        subindex=entry.subindex,
        complete=False,
        name=entry.name,
        access=entry.access,
        type=kind.text if kind else None,
        unit=entry.unit,
        value=value,
        data=None if octets is None else octets.hex(),
    )


def _parts(found: ObjectInfo, first: int, octets: bytes) -> list[OdValue]:
    """Return the entries in *octets*, as far as the types are known."""
    rows = []
    chosen = [each for each in found.entries if 1 <= each.subindex <= found.max_subindex]
    if first == 0:
        count = next((each for each in found.entries if each.subindex == 0), None)
        if count is not None:
            rows.append(_value(found.index, count, octets[:1]))
        # In complete access subindex 0 is padded to 16 bits.
        octets = octets[2:]
    kinds = [each.kind for each in chosen if each.kind is not None]
    plan = datatypes.layout(kinds)
    # Without all types no offset behind the first unknown one is certain.
    if len(kinds) != len(chosen) or plan.size != len(octets):
        return rows
    for entry, kind, bit_offset in zip(chosen, kinds, plan.bit_offsets, strict=True):
        rows.append(_value(found.index, entry, extract_bits(octets, bit_offset, kind)))
    return rows


def load(device: OdDevice, entries: Iterable[Download]) -> LoadedEntries:
    """Write *entries* in the order that a device needs: an object after those that it refers to.

    Variables come first, then PDOs, PDs, frames, and all else.  A list of a PDO is emptied before
    its entries are written, and counted afterwards.  An object that holds all of it already is left
    alone.

    Raises:
        ControlError: the device refuses one of them; those before it are written.
    """
    present = {(each.object.index, each.entry.subindex): each.octets for each in device.contents()}
    written = unchanged = 0
    for index, group in groupby(sorted(entries, key=_order), key=lambda entry: entry[0]):
        chosen = list(group)
        # Unchanged objects are left alone: writing one anew may be refused while others refer to
        # it.
        if index == CONTROL or all(present.get(each[:2]) == each[2] for each in chosen):
            unchanged += len(chosen)
            continue
        for step in _steps(index, chosen):
            try:
                device.write(*step)
            except EapError as exc:
                raise ControlError(f"{exc}; {_entries_were(written)} written before") from None
        written += len(chosen)
    return LoadedEntries(written, unchanged)


def _order(entry: Download) -> tuple[int, int, int]:
    index, subindex, _ = entry
    rank = next((rank for indexes, rank in _RANKS if index in indexes), _LAST)
    # Subindex 0 last: it is checked against the entries that are there.
    return rank, index, subindex or 0x100


def _steps(index: int, entries: list[Download]) -> list[Download]:
    """Return the downloads for one object; *entries* have subindex 0 last."""
    counts = entries[-1][1] == 0 and len(entries) > 1
    if counts and any(index in each for each in _MAPPINGS):
        # As in slaves: a mapping can be written only while its subindex 0 is 0.
        return [(index, 0, bytes(1)), *entries]
    return entries


def _entries_were(written: int) -> str:
    if written < 2:
        return "1 entry was" if written else "nothing was"
    return f"{written} entries were"
