"""Dictionaries whose objects are created on each access: of a router and of an EtherCAT master.

Routes and slaves come and go without a download, so their objects are not kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from heapq import merge
from ipaddress import IPv4Address
from itertools import starmap
from typing import Any, Protocol

from eap.device.eap_dictionary import DeviceIdentity
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdObject, OdState
from eap.od.profiles import eap1000, master1100, router9000
from eap.od.profiles.master1100 import MasterLive
from eap.od.profiles.router9000 import RouterLive
from eap.od.profiles.table import ProfileObject, live_source, make_object
from eap.pd.spec import PortKind, PortSpec, StationSpec

_IP_SCHEMES = ("udp", "tcp")
_MAX_ROUTES = router9000.ROUTE.last - router9000.ROUTE.first + 1


class RouterValues(Protocol):
    """The running router; values are numbers, bytes or texts, as the types of the profile say."""

    def number(self, key: RouterLive) -> int:
        """Return the value of *key* for the router as a whole."""

    def state_of(self, port: str) -> int:
        """Return the state of a port."""

    def mac_of(self, port: str) -> bytes:
        """Return the MAC address of a port's interface; all zero if it has none."""

    def routes(self) -> Sequence[object]:
        """Return all routes in their order."""

    def of_route(self, key: RouterLive, route: object) -> Any:
        """Return the value of *key* for one route."""


class RouterDictionary(ObjectDictionary):
    """Dictionary of a station's router, for clients to read.

    Args:
        station: Station of the router.
        values: Source of the values of live entries.
        identity: Values of 0x1008 to 0x1018.
    """

    def __init__(
        self, station: StationSpec, values: RouterValues, identity: DeviceIdentity
    ) -> None:
        super().__init__()
        self._values = values
        self._identity = identity
        self.follow(station)

    def follow(self, station: StationSpec) -> None:
        """Have the objects of the present ports of *station*."""
        self._objects.clear()
        self._names = {
            router9000.DEVICE.first + number: port.name for number, port in enumerate(station.ports)
        }
        for row in router9000.STATIC:
            self.add(_make(row, row.first, self._read, last=len(station.ports)))
        for number, port in enumerate(station.ports):
            index = router9000.DEVICE.first + number
            self.add(_make(router9000.DEVICE, index, partial(self._read_device, port.name)))
        self._set_fixed(station)

    def name_of(self, index: int) -> str:
        """Return the name of the subject of the object at *index*, empty for the router itself."""
        if _is_route(index):
            return str(self[index].entries[3].value)
        return self._names.get(index, "")

    def __contains__(self, index: int) -> bool:
        return super().__contains__(index) or index in self._route_indexes()

    def __getitem__(self, index: int) -> OdObject:
        """Return the object at *index*; refuse with NO_OBJECT."""
        if _is_route(index) and index in self._route_indexes():
            return self._make_route(index, self._values.routes()[index - router9000.ROUTE.first])
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[OdObject]:
        """Yield the objects in the order of their indexes."""
        routes = zip(self._route_indexes(), self._values.routes(), strict=False)
        objects = super().__iter__()
        return merge(objects, starmap(self._make_route, routes), key=lambda item: item.index)

    def __len__(self) -> int:
        return super().__len__() + len(self._route_indexes())

    def _route_indexes(self) -> range:
        first = router9000.ROUTE.first
        # More routes than indexes: the rest is not in the dictionary, but the router uses it.
        return range(first, first + min(len(self._values.routes()), _MAX_ROUTES))

    def _make_route(self, index: int, route: object) -> OdObject:
        return _make(router9000.ROUTE, index, lambda key: self._values.of_route(key, route))

    def _read(self, key: RouterLive) -> int:
        return self._values.number(key)

    def _read_device(self, port: str, key: RouterLive) -> int | bytes:
        if key is RouterLive.DEVICE_STATE:
            return self._values.state_of(port)
        return self._values.mac_of(port)

    def _set_fixed(self, station: StationSpec) -> None:
        fixed: dict[tuple[int, int], Any] = {
            **self._identity.entries(),
            (0xF920, 1): station.net_id,
        }
        for number, port in enumerate(station.ports):
            kind = _PROFILES[port.kind]
            fixed[router9000.MODULES.first, number + 1] = kind
            index = router9000.DEVICE.first + number
            fixed |= {
                (index, 1): port.net_id,
                (index, 2): kind,
                (index, 3): str(port.interface),
                (index, 5): _ip_of(port),
                (index, 7): port.name,
            }
        for (index, subindex), value in fixed.items():
            self[index].entries[subindex].value = value


_PROFILES = {PortKind.EAP: eap1000.MODULE_PROFILE, PortKind.BUS: router9000.MASTER_PROFILE}


def _make(
    row: ProfileObject, index: int, read: Callable[[RouterLive], Any], *, last: int = 0
) -> OdObject:
    return make_object(row, index, live_source(lambda key: read(RouterLive(key))), last=last)


def _is_route(index: int) -> bool:
    return router9000.ROUTE.first <= index <= router9000.ROUTE.last


def _ip_of(port: PortSpec) -> bytes:
    uri = port.interface
    return IPv4Address(uri.host).packed if uri.scheme in _IP_SCHEMES else bytes(4)


_DETECT = 0xF002


class MasterValues(Protocol):
    """The running master; values are numbers, bytes or texts, as the types of the profile say."""

    def configured(self) -> Sequence[int]:
        """Return the station addresses of the configuration, in the order of the bus."""

    def detected(self) -> Sequence[int]:
        """Return the station addresses that the last scan detected."""

    def of_configured(self, station: int, key: MasterLive) -> Any:
        """Return the value of *key* for a configured slave."""

    def of_detected(self, station: int, key: MasterLive) -> Any:
        """Return the value of *key* for a detected slave."""

    def of_diagnosis(self, station: int, key: MasterLive) -> Any:
        """Return the value of *key* for the diagnosis of a configured slave."""

    def of_master(self, key: MasterLive) -> Any:
        """Return the value of *key* for the master itself."""

    def write_slave(self, station: int, key: MasterLive, value: int) -> None:
        """Execute a download, or raise SdoAbortError."""

    def write_master(self, key: MasterLive, data: bytes) -> None:
        """Execute a download, or raise SdoAbortError."""


class MasterDictionary(ObjectDictionary):
    """Dictionary of a master.

    Args:
        values: Source of the values of live entries.
        identity: Values of 0x1008 to 0x1018.
        full: Whether objects of slaves have all entries of ETG.1510, or those that TwinCAT has.
        padded: Whether in complete access an entry of an even size begins at an even offset.
    """

    # ETG.1510 clients request all of the entry description and read any extra bytes as the name.
    describes_values = False

    def __init__(
        self,
        values: MasterValues,
        identity: DeviceIdentity,
        *,
        full: bool = False,
        padded: bool = False,
    ) -> None:
        super().__init__()
        self._values = values
        self._full = full
        self._padded = padded
        for row in master1100.FIXED:
            self.add(make_object(row, row.first, live_source(self._read), write=self._write))
        for (index, subindex), value in identity.entries().items():
            self[index].entries[subindex].value = value

    def __contains__(self, index: int) -> bool:
        return index in self._objects or index in self._dynamic_indexes()

    def __getitem__(self, index: int) -> OdObject:
        """Return the object at *index*; refuse with NO_OBJECT."""
        for row in (*master1100.SLAVES, *master1100.LISTS):
            if row.first <= index <= row.last:
                return self._make(row, index)
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[OdObject]:
        """Yield the objects in the order of their indexes."""
        return (self[index] for index in sorted({*self._objects, *self._dynamic_indexes()}))

    def __len__(self) -> int:
        return len(self._objects) + len(self._dynamic_indexes())

    def upload_complete(self, index: int, first: int, state: OdState) -> bytes:
        """Return a whole object as :class:`ObjectDictionary` does, padded if configured."""
        # TwinCAT refuses this too, and clients of ETG.1510 are written against it.
        if index == _DETECT and not self._padded:
            raise SdoAbortError(AbortCode.PARAMETER, index, first, "no complete access, as TwinCAT")
        octets = super().upload_complete(index, first, state)
        return self._pad(self[index], octets, first) if self._padded else octets

    def _pad(self, item: OdObject, octets: bytes, first: int) -> bytes:
        """Insert a byte before each entry of an even size that begins at an odd offset."""
        # Subindex 0 is padded to 16 bits already.
        start = 2 if first == 0 else 0
        padded = bytearray(octets[:start])
        for subindex, entry in item.entries.items():
            if not subindex:
                continue
            size = (entry.kind.bit_length + 7) // 8
            if len(padded) % 2 and size % 2 == 0:
                padded.append(0)
            padded += octets[start : start + size]
            start += size
        return bytes(padded)

    def _dynamic_indexes(self) -> set[int]:
        found: set[int] = set()
        for row in master1100.SLAVES:
            found.update(range(row.first, row.first + len(self._stations(row))))
        for row in master1100.LISTS:
            # The first list exists on an empty bus too: clients read it without listing the
            # objects.
            lists = max(1, -(-len(self._stations(row)) // master1100.PER_LIST))
            found.update(range(row.first, row.first + lists))
        return found

    def _stations(self, row: ProfileObject) -> Sequence[int]:
        is_found = row in {master1100.DETECTED, master1100.DETECTED_LIST}
        stations = self._values.detected() if is_found else self._values.configured()
        return stations[: master1100.MAX_SLAVES]

    def _make(self, row: ProfileObject, index: int) -> OdObject:
        stations, number = self._stations(row), index - row.first
        if row in master1100.LISTS:
            return self._make_list(row, index, stations)
        if number >= len(stations):
            raise SdoAbortError(AbortCode.NO_OBJECT, index, 0)
        station = stations[number]
        # ETG.1510 has more entries than TwinCAT shows; some clients expect exactly TwinCAT's.
        extent = row.last_subindex if self._full else master1100.USUAL_EXTENT[row.first]
        read = {
            master1100.CONFIGURED.first: self._values.of_configured,
            master1100.DETECTED.first: self._values.of_detected,
            master1100.DIAGNOSIS.first: self._values.of_diagnosis,
        }[row.first]

        def write(key: str, data: bytes) -> None:
            self._values.write_slave(station, MasterLive(key), int.from_bytes(data, "little"))

        source = live_source(lambda key: read(station, MasterLive(key)))
        return make_object(row, index, source, write=write, extent=extent)

    def _make_list(self, row: ProfileObject, index: int, stations: Sequence[int]) -> OdObject:
        start = (index - row.first) * master1100.PER_LIST
        part = stations[start : start + master1100.PER_LIST]
        if start and not part:
            raise SdoAbortError(AbortCode.NO_OBJECT, index, 0)
        item = make_object(row, index, live_source(self._read), last=len(part))
        for subindex, station in enumerate(part, 1):
            item.entries[subindex].value = station
        return item

    def _read(self, key: str) -> Any:
        return self._values.of_master(MasterLive(key))

    def _write(self, key: str, data: bytes) -> None:
        self._values.write_master(MasterLive(key), data)
