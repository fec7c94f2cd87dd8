"""Object dictionary of a station's router: its ports, its routes, and counters of packets.

All of it is read only.  The objects of routes are made on each access, for routes come and
go by themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from heapq import merge
from ipaddress import IPv4Address
from itertools import starmap
from typing import Any, Protocol

from eap.device.eap_objects import DeviceIdentity
from eap.ids import InterfaceUri, NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdObject
from eap.od.profiles import eap1000
from eap.od.profiles import router9000 as profile
from eap.od.profiles.router9000 import RouterLive
from eap.od.profiles.table import ProfileObject, live_source, make_object
from eap.pd.spec import PortKind, PortSpec, StationSpec

_IP_SCHEMES = ("udp", "tcp")
_MAX_ROUTES = profile.ROUTE.last - profile.ROUTE.first + 1


class RouterValues(Protocol):
    """The running router; values are numbers, octets or texts, as the profile's types say."""

    def number(self, key: RouterLive) -> int:
        """Return what *key* stands for, of the router as a whole."""

    def state_of(self, port: str) -> int:
        """Return the state of a port."""

    def mac_of(self, port: str) -> bytes:
        """Return the MAC address of a port's interface; all zero if it has none."""

    def routes(self) -> Sequence[object]:
        """Return all routes in their order."""

    def of_route(self, key: RouterLive, route: object) -> Any:
        """Return what *key* stands for, of one of the routes."""


class RouterDictionary(ObjectDictionary):
    """Dictionary of a station's router, for clients to read.

    Args:
        station: Whose router it is.
        values: Where live entries get theirs.
        identity: What 0x1008 to 0x1018 show.
    """

    def __init__(
        self, station: StationSpec, values: RouterValues, identity: DeviceIdentity
    ) -> None:
        super().__init__()
        self._values = values
        self._names = {
            profile.DEVICE.first + number: port.name for number, port in enumerate(station.ports)
        }
        for row in profile.STATIC:
            self.add(_make(row, row.first, self._read, last=len(station.ports)))
        for number, port in enumerate(station.ports):
            index = profile.DEVICE.first + number
            self.add(_make(profile.DEVICE, index, partial(self._read_device, port.name)))
        self._set_fixed(station, identity)

    def name_of(self, index: int) -> str:
        """Return the name of what the object at *index* is about, empty for the router itself."""
        if _is_route(index):
            return str(self[index].entries[3].value)
        return self._names.get(index, "")

    def __contains__(self, index: int) -> bool:
        return super().__contains__(index) or index in self._route_indexes()

    def __getitem__(self, index: int) -> OdObject:
        """Return the object at *index*; refuse with NO_OBJECT."""
        if _is_route(index) and index in self._route_indexes():
            return self._make_route(index, self._values.routes()[index - profile.ROUTE.first])
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[OdObject]:
        """Yield the objects in the order of their indexes."""
        routes = zip(self._route_indexes(), self._values.routes(), strict=False)
        objects = super().__iter__()
        return merge(objects, starmap(self._make_route, routes), key=lambda item: item.index)

    def __len__(self) -> int:
        return super().__len__() + len(self._route_indexes())

    def _route_indexes(self) -> range:
        first = profile.ROUTE.first
        return range(first, first + min(len(self._values.routes()), _MAX_ROUTES))

    def _make_route(self, index: int, route: object) -> OdObject:
        return _make(profile.ROUTE, index, lambda key: self._values.of_route(key, route))

    def _read(self, key: RouterLive) -> int:
        return self._values.number(key)

    def _read_device(self, port: str, key: RouterLive) -> int | bytes:
        if key is RouterLive.DEVICE_STATE:
            return self._values.state_of(port)
        return self._values.mac_of(port)

    def _set_fixed(self, station: StationSpec, identity: DeviceIdentity) -> None:
        fixed: dict[tuple[int, int], Any] = {
            **identity.entries(),
            (0xF920, 1): NetId.parse(station.net_id),
        }
        for number, port in enumerate(station.ports):
            kind = _PROFILES[port.kind]
            fixed[profile.MODULES.first, number + 1] = kind
            index = profile.DEVICE.first + number
            fixed |= {
                (index, 1): NetId.parse(port.net_id),
                (index, 2): kind,
                (index, 3): port.interface,
                (index, 5): _ip_of(port),
                (index, 7): port.name,
            }
        for (index, subindex), value in fixed.items():
            self[index].entries[subindex].value = value


_PROFILES = {PortKind.EAP: eap1000.MODULE_PROFILE, PortKind.BUS: profile.MASTER_PROFILE}


def _make(
    row: ProfileObject, index: int, read: Callable[[RouterLive], Any], *, last: int = 0
) -> OdObject:
    return make_object(row, index, live_source(lambda key: read(RouterLive(key))), last=last)


def _is_route(index: int) -> bool:
    return profile.ROUTE.first <= index <= profile.ROUTE.last


def _ip_of(port: PortSpec) -> bytes:
    uri = InterfaceUri.parse(port.interface)
    return IPv4Address(uri.host).packed if uri.scheme in _IP_SCHEMES else bytes(4)
