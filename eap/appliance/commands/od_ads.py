"""The object dictionary of any device that ADS reaches (ETG.1020, AoE: CoE by index groups)."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from eap.aoe.ads_operation import Read, Write
from eap.appliance.commands.ams_device import AmsDevice, AmsRefusedError
from eap.appliance.commands.od_described import entry_info, object_info, read_all, with_entries
from eap.appliance.commands.od_device import Content, EntryInfo, ObjectInfo
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.sdoinfo import EntryDescription, ObjectDescription
from eap.errors import CodecError, ControlError
from eap.ids import ObjectId
from eap.od.info import ListType, ValueInfo

_ROOM = 0x20002
"""Octets of the longest description: a list of all indexes there can be."""
_COMPLETE = 0x100
_LIST_TYPE = 2
"""Octets in front of the indexes of a list."""
_PADDED = 2
"""Octets of subindex 0 in a whole object."""
_UNTOLD = frozenset((AdsError.NOT_FOUND, AdsError.SERVICE, AdsError.INDEX_GROUP, AdsError.GENERAL))


class AdsOd:
    """The objects of one device.

    Raises:
        AmsRefusedError: (every method) the device refuses, or nobody gets to it.
    """

    def __init__(self, device: AmsDevice) -> None:
        self._device = device

    def objects(self) -> list[ObjectInfo]:
        """Return all objects that the device describes, without their entries."""
        body = self._read(IndexGroup.OBJECT_LIST, ListType.ALL << 16, "object list")
        indexes = body[_LIST_TYPE : len(body) // 2 * 2]
        return [self._object(index) for (index,) in struct.iter_unpack("<H", indexes)]

    def describe(self, index: int) -> ObjectInfo:
        """Return one object with its entries."""
        return with_entries(self, self._object(index))

    def entry(self, index: int, subindex: int) -> EntryInfo | None:
        """Return what the device says of an entry; None if it says nothing."""
        offset = index << 16 | int(~ValueInfo(0)) << 8 | subindex
        name = str(ObjectId(index, subindex))
        try:
            body = self._read(IndexGroup.ENTRY_DESCRIPTION, offset, name)
            found = EntryDescription.decode(body)
        except AmsRefusedError as exc:
            if exc.result in _UNTOLD:
                return None
            raise
        except CodecError:
            return None
        return entry_info(subindex, found)

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the octets of an entry or of an object."""
        name = str(ObjectId(index, subindex))
        if not complete:
            return self._read(IndexGroup.SDO, index << 16 | subindex, name)
        octets = self._read(IndexGroup.SDO, index << 16 | _COMPLETE, name)
        return octets[_PADDED:] if subindex else octets

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        """Write an entry or an object."""
        name = str(ObjectId(index, subindex))
        if complete and subindex:
            raise ControlError(f"{name}: by ADS a whole object is written from subindex 0 on")
        offset = index << 16 | (_COMPLETE if complete else subindex)
        self._device.demand(Write(IndexGroup.SDO, offset, octets), name)

    def contents(self) -> Iterator[Content]:
        """Return all entries of all objects, as they come in."""
        return read_all(self, AmsRefusedError)

    def _object(self, index: int) -> ObjectInfo:
        name = f"0x{index:04X}"
        body = self._read(IndexGroup.OBJECT_DESCRIPTION, index << 16, name)
        try:
            found = ObjectDescription.decode(body)
        except CodecError as exc:
            raise ControlError(f"{name}: its description cannot be read: {exc}") from None
        return object_info(index, found)

    def _read(self, group: int, offset: int, what: str) -> bytes:
        return self._device.demand(Read(group, offset, _ROOM), what)
