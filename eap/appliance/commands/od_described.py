"""Devices that describe their objects as CoE does, through a mailbox or by ADS."""

from __future__ import annotations

from collections.abc import Iterator

from msgspec.structs import replace

from eap.appliance.commands.bus_sdo import kind_of
from eap.appliance.commands.od_device import Content, EntryInfo, ObjectInfo, OdDevice
from eap.codec.sdoinfo import EntryDescription, ObjectDescription
from eap.od.model import Access, ObjectCode


def object_info(index: int, found: ObjectDescription) -> ObjectInfo:
    """Return what a description says of an object, without its entries."""
    known = found.code in ObjectCode._value2member_map_
    code = ObjectCode(found.code).name if known else str(found.code)
    return ObjectInfo(index, found.name, code, found.max_subindex)


def entry_info(subindex: int, found: EntryDescription) -> EntryInfo:
    """Return what a description says of an entry."""
    reads = "r" if found.access & Access.READ_ANY else ""
    writes = "w" if found.access & Access.WRITE_ANY else ""
    return EntryInfo(subindex, found.name, kind_of(found), reads + writes)


def with_entries(device: OdDevice, found: ObjectInfo) -> ObjectInfo:
    """Return an object with the entries that *device* tells of."""
    known = (device.entry(found.index, subindex) for subindex in range(found.max_subindex + 1))
    return replace(found, entries=tuple(each for each in known if each is not None))


def read_all(device: OdDevice, *refusals: type[Exception]) -> Iterator[Content]:
    """Yield all entries of all objects of *device*, as they come in.

    *refusals* are the errors that are told beside an entry; others are raised.
    """
    for found in device.objects():
        for entry in device.describe(found.index).entries:
            octets, error = None, ""
            if "r" in entry.access:
                try:
                    octets = device.read(found.index, entry.subindex)
                except refusals as exc:
                    error = str(exc)
            yield Content(found, entry, octets, error)
