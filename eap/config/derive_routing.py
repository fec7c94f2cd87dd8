"""From a plant file without findings to what the routers of its stations are told."""

from __future__ import annotations

from collections.abc import Iterator

from eap.aoe.spec import DirectoryPort, DirectoryStation, HopSpec, RouteSpec, RoutingSpec
from eap.config.index import Index
from eap.config.neighbours import find_hop
from eap.config.structs import Station
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import PortKind

_COMMON = 4
"""Octets that all NetIDs of a station usually have in common."""


def derive_routing(index: Index) -> dict[str, RoutingSpec]:
    """Return by its name what the router of each station is told."""
    loose = _without_prefix(index)
    return {
        station.name: RoutingSpec(routes=tuple(_derived(index, station, loose)))
        for station in index.plant.stations
    }


def derive_directory(index: Index) -> tuple[DirectoryStation, ...]:
    """Return the names of everything in the plant."""
    return tuple(
        DirectoryStation(
            name=station.name,
            net_id=str(NetId.parse(station.net_id)),
            ports=tuple(
                DirectoryPort(
                    name=port.name,
                    is_bus=port.kind is PortKind.BUS,
                    net_id=str(NetId.parse(port.net_id)),
                    interface=str(InterfaceUri.parse(port.interface)),
                    slaves=_slaves(index, station, port.name),
                )
                for port in station.ports
            ),
        )
        for station in index.plant.stations
    )


def _slaves(index: Index, station: Station, port: str) -> dict[str, int]:
    bus = index.buses.get((station.name, port))
    return {slave.name: slave.station for slave in bus.slaves} if bus else {}


def _derived(index: Index, station: Station, loose: set[str]) -> Iterator[RouteSpec]:
    """Yield routes to the stations that share an interface with *station*."""
    for target in index.plant.stations:
        if target is not station and (hop := find_hop(index, station, target)) is not None:
            yield from _routes_to(target, hop, is_loose=target.name in loose)


def _routes_to(target: Station, hop: HopSpec, *, is_loose: bool) -> Iterator[RouteSpec]:
    router = str(NetId.parse(target.net_id))
    net_ids, octets = [router], _COMMON
    if is_loose:
        net_ids += [str(NetId.parse(port.net_id)) for port in target.ports]
        octets = len(NetId.parse(router))
    for net_id in net_ids:
        yield RouteSpec(
            name=target.name, net_id=net_id, hop=hop, octets=octets, router=router, is_derived=True
        )


def _without_prefix(index: Index) -> set[str]:
    """Return the stations whose NetIDs have no four octets to themselves."""
    owners: dict[bytes, set[str]] = {}
    for station in index.plant.stations:
        for prefix in _prefixes(station):
            owners.setdefault(prefix, set()).add(station.name)
    shared = {name for names in owners.values() if len(names) > 1 for name in names}
    return shared | {s.name for s in index.plant.stations if len(_prefixes(s)) > 1}


def _prefixes(station: Station) -> set[bytes]:
    net_ids = [station.net_id, *(port.net_id for port in station.ports)]
    return {NetId.parse(text)[:_COMMON] for text in net_ids}
