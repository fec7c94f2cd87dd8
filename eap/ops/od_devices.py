"""Devices with an object dictionary, and the search for the one that a command names.

An EAP port, a router or a slave of a station that runs here is reached by its appliance; everything
else by ADS, through the routes of the first appliance that knows it (ETG.1020, AoE: CoE by index
groups).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple, Self

from msgspec.structs import replace

from devicebus.errors import MailboxProtocolError, MailboxRefusedError
from devicebus.mailbox import coe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.request import Read, Write
from eap.codec import datatypes
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.coe import EntryDescription, ObjectDescription
from eap.control.device import (
    OD_DESCRIBE,
    OD_DUMP,
    OD_LIST,
    OD_READ,
    OD_WRITE,
    DescribedEntry,
    DescribedObject,
    ListedObject,
)
from eap.control.protocol import ErrorCode
from eap.errors import CodecError, ControlError
from eap.gateway.error_table import Cause, cause_of
from eap.ids import NetId, ObjectId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.info import ListType, ValueInfo
from eap.od.model import Access, ObjectCode
from eap.od.profiles.eap1000 import CONTROL
from eap.ops.bus_objects import kind_of
from eap.ops.bus_session import SlaveBus
from eap.ops.client import ControlClient, connect_station
from eap.ops.od import Content, EntryInfo, ObjectInfo, OdDevice
from eap.ops.routing import AmsDevice, AmsRefusedError, open_ams
from eap.runtime.folder import find_running

_MAX_SIZE = 0x20002
"""Size of the longest description: a list of all possible indexes."""
_COMPLETE = 0x100
_LIST_TYPE = 2
"""Bytes before the indexes of a list."""
_PADDED = 2
"""Size of subindex 0 in a whole object."""
_NOT_DESCRIBED = frozenset(
    (AdsError.NOT_FOUND, AdsError.SERVICE, AdsError.INDEX_GROUP, AdsError.GENERAL)
)
_OCTETS = 6
_NOT_THERE = "is not STATION, STATION/PORT, STATION/PORT/SLAVE or NETID[:PORT]"


class Target(NamedTuple):
    """A device by name or address; *plant* chooses where several plants run the station."""

    station: str
    """Or ``NETID[:PORT]``."""
    port: str = ""
    """Empty: the first EAP port."""
    slave: str = ""
    """Of a bus port."""
    plant: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read ``STATION[/PORT[/SLAVE]]`` or ``NETID[:PORT]``; raise ValueError otherwise."""
        parts = text.split("/")
        if len(parts) > 3 or not all(parts):
            raise ValueError(f"{text!r} {_NOT_THERE}")
        if text.count(".") == _OCTETS - 1 and len(parts) == 1:
            NetId.parse(text.partition(":")[0])
        return cls(*parts)

    @property
    def is_address(self) -> bool:
        """True for a NetID, false for a name."""
        return not self.port and self.station.count(".") == _OCTETS - 1

    @property
    def is_here(self) -> bool:
        """True if its station runs on this host, or no station does."""
        running = [info for _, info in find_running()]
        chosen = [info for info in running if self.plant in {None, info.plant}]
        names = {name for info in chosen for name in info.stations}
        # Without any appliance the error is that of the local way, which says how to start one.
        return not chosen or (not self.is_address and self.station in names)

    def __str__(self) -> str:
        return "/".join(part for part in self[:3] if part)


@contextmanager
def open_device(target: Target) -> Iterator[OdDevice]:
    """Reach the object dictionary of *target*, for the length of a block.

    Raises:
        ControlError: no appliance runs the station or has a route to it, or several run it and its
            plant is left open.
        BusError: the bus has no such slave.
    """
    if not target.is_here:
        with _open_far(target) as device:
            yield device
    elif target.slave:
        from eap.ops.bus_running import open_running  # a master, for slaves alone

        with open_running(target.station, target.port, target.plant) as bus:
            yield SlaveOd(bus, target.slave)
    else:
        with connect_station(target.station, target.plant) as client:
            if not is_bus(client, target):
                yield StationOd(client, str(target))
                return
        with _open_far(target) as device:
            yield device


def is_bus(client: ControlClient, target: Target) -> bool:
    """Return whether *target* is a bus port of a local station: its master."""
    if not target.port or target.slave:
        return False
    stations = client.request("status")["stations"]
    return any(
        port["name"] == target.port and port["kind"] == "bus"
        for station in stations
        if station["name"] == target.station
        for port in station["ports"]
    )


@contextmanager
def _open_far(target: Target) -> Iterator[OdDevice]:
    with open_ams(str(target), target.plant) as device:
        yield AdsOd(device)


def object_info(index: int, found: ObjectDescription) -> ObjectInfo:
    """Return the description of an object, without its entries."""
    known = found.code in ObjectCode._value2member_map_
    code = ObjectCode(found.code).name if known else str(found.code)
    return ObjectInfo(index, found.name, code, found.max_subindex)


def entry_info(subindex: int, found: EntryDescription) -> EntryInfo:
    """Return the description of an entry."""
    reads = "r" if found.access & Access.READ_ANY else ""
    writes = "w" if found.access & Access.WRITE_ANY else ""
    return EntryInfo(subindex, found.name, kind_of(found), reads + writes)


def with_entries(device: OdDevice, found: ObjectInfo) -> ObjectInfo:
    """Return an object with the entries that *device* describes."""
    known = (device.entry(found.index, subindex) for subindex in range(found.max_subindex + 1))
    return replace(found, entries=tuple(each for each in known if each is not None))


def read_all(device: OdDevice, *refusals: type[Exception]) -> Iterator[Content]:
    """Yield all entries of all objects of *device*, as they come in.

    Errors of the types *refusals* are stored with the entry; others are raised.
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


class SlaveOd:
    """The objects of one slave.

    Raises:
        SdoAbortError: (every method) the slave refuses.
        BusError: (every method) there is no such slave, or it does not answer.
    """

    def __init__(self, bus: SlaveBus, slave: str) -> None:
        self._bus = bus
        self._slave = bus.find(slave)

    def objects(self) -> list[ObjectInfo]:
        """Return all objects that the slave describes, without their entries."""
        begin = coe_client.object_list
        indexes = self._bus.converse(self._slave, lambda _: begin(), "object list")
        return [self._object(index) for index in indexes]

    def describe(self, index: int) -> ObjectInfo:
        """Return one object with its entries."""
        return with_entries(self, self._object(index))

    def entry(self, index: int, subindex: int) -> EntryInfo | None:
        """Return the slave's description of an entry, or None."""
        name = str(ObjectId(index, subindex))
        try:
            found = self._bus.converse(
                self._slave, lambda _: coe_client.entry_description(index, subindex), name
            )
        except (MailboxProtocolError, MailboxRefusedError):
            return None
        except SdoAbortError as exc:
            if cause_of(exc) is Cause.NOT_FOUND:
                return None
            raise
        return entry_info(subindex, found)

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the bytes of an entry or of an object."""
        return self._bus.converse(
            self._slave,
            lambda _: coe_client.upload(index, subindex, complete=complete),
            str(ObjectId(index, subindex)),
        )

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        """Write an entry or an object."""

        def begin(sizes: MailboxSizes) -> Conversation[None]:
            return coe_client.download(index, subindex, octets, sizes, complete=complete)

        self._bus.converse(self._slave, begin, str(ObjectId(index, subindex)))

    def contents(self) -> Iterator[Content]:
        """Return all entries of all objects, as they come in."""
        return read_all(self, SdoAbortError, MailboxProtocolError)

    def _object(self, index: int) -> ObjectInfo:
        found = self._bus.converse(
            self._slave,
            lambda _: coe_client.object_description(index),
            f"0x{index:04X}",
        )
        return object_info(index, found)


class AdsOd:
    """The objects of one device.

    Raises:
        AmsRefusedError: (every method) the device refuses, or cannot be reached.
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
        """Return the device's description of an entry, or None."""
        # All value information that there is; a device leaves out what it does not have.
        offset = index << 16 | int(~ValueInfo(0)) << 8 | subindex
        name = str(ObjectId(index, subindex))
        try:
            body = self._read(IndexGroup.ENTRY_DESCRIPTION, offset, name)
            found = EntryDescription.decode(body)
        except AmsRefusedError as exc:
            if exc.result in _NOT_DESCRIBED:
                return None
            raise
        except CodecError:
            return None
        return entry_info(subindex, found)

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the bytes of an entry or of an object."""
        name = str(ObjectId(index, subindex))
        if not complete:
            return self._read(IndexGroup.SDO, index << 16 | subindex, name)
        # By ADS complete access begins with subindex 0, which takes two bytes there.
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
        # ADS has no way to ask for a length first: the device answers with as much as it has.
        return self._device.demand(Read(group, offset, _MAX_SIZE), what)


class StationOd:
    """The objects of *target*, which is STATION or STATION/PORT.

    Raises:
        ControlError: (every method) the station refuses, with code ``abort`` where the dictionary
            did, or the appliance does not answer.
        SdoAbortError: (``entry``) there is no such entry, and none can be made.
    """

    def __init__(self, client: ControlClient, target: str) -> None:
        self._client = client
        self._target = target

    def objects(self) -> list[ObjectInfo]:
        """Return all objects without their entries."""
        rows: list[ListedObject] = []
        first: int | None = 0
        while first is not None:
            page = self._client.call(OD_LIST, target=self._target, first=first)
            rows += page.objects
            first = page.next
        return [_station_object(row) for row in rows]

    def describe(self, index: int) -> ObjectInfo:
        """Return one object with its entries."""
        return _described(self._client.call(OD_DESCRIBE, target=self._target, index=index))

    def entry(self, index: int, subindex: int) -> EntryInfo:
        """Return a description of an entry, also of one that a download would make."""
        found = _described(
            self._client.call(OD_DESCRIBE, target=self._target, index=index, subindex=subindex)
        )
        for each in found.entries:
            if each.subindex == subindex:
                return each
        raise SdoAbortError(AbortCode.NO_SUBINDEX, index, subindex)

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Return the bytes of an entry or of an object."""
        where = {"index": index, "subindex": subindex, "complete": complete}
        return bytes.fromhex(self._client.call(OD_READ, target=self._target, **where).data)

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        """Write an entry or an object; a refusal has a remedy, if one is known."""
        where = {"index": index, "subindex": subindex, "complete": complete}
        try:
            self._client.call(OD_WRITE, target=self._target, **where, data=octets.hex())
        except ControlError as exc:
            # At the control word the state request itself was refused, and the text has the reason.
            if (
                index != CONTROL
                and exc.code == ErrorCode.ABORT
                and f"0x{AbortCode.DEVICE_STATE:08X}" in str(exc)
            ):
                hint = f"bring it to PREOP first: eapctl state {self._target} PREOP"
                raise ControlError(f"{exc}; {hint}", code=exc.code) from None
            raise

    def contents(self) -> Iterator[Content]:
        """Yield all entries of all objects, page by page."""
        first: int | None = 0
        while first is not None:
            page = self._client.call(OD_DUMP, target=self._target, first=first)
            for row in page.objects:
                found = _station_object(row)
                for each in row.entries:
                    octets = None if each.data is None else bytes.fromhex(each.data)
                    yield Content(found, _station_entry(each), octets)
            first = page.next


def _station_object(row: ListedObject) -> ObjectInfo:
    return ObjectInfo(row.index, row.name, row.code, row.max_subindex, row.label)


def _described(row: DescribedObject) -> ObjectInfo:
    return replace(_station_object(row), entries=tuple(map(_station_entry, row.entries)))


def _station_entry(row: DescribedEntry) -> EntryInfo:
    try:
        kind = datatypes.parse(row.type)
    except ValueError:
        kind = None  # a newer appliance may have more data types
    return EntryInfo(row.subindex, row.name, kind, row.access, row.unit)
