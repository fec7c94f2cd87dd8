"""Which NetIDs a route is for, and by how many octets they are told from others."""

from __future__ import annotations

from eap.aoe.spec import DEFAULT_TARGET
from eap.config.index import Index
from eap.config.routes import target_of
from eap.config.structs import Route, Station
from eap.ids import STATION_OCTETS, NetId

WHOLE = 6
NOBODY = NetId(bytes(WHOLE))


def reach(index: Index, route: Route, loose: set[str]) -> list[tuple[str, int]]:
    """Return NetID and octets to match of each part of *route*.

    *loose* are the stations that :func:`without_prefix` returns.
    """
    if route.to == DEFAULT_TARGET:
        return [(str(NOBODY), 0)]
    target = target_of(index, route)
    if target is None:
        return [(str(NetId.parse(route.net_id)), route.octets or STATION_OCTETS)]
    # One NetID only can stand for another, so a virtual one is for all that begin alike.
    return net_ids_of(target, set() if route.virtual else loose)


def net_ids_of(station: Station, loose: set[str]) -> list[tuple[str, int]]:
    """Return by which NetIDs, and octets of them, everything at *station* is reached."""
    router = str(NetId.parse(station.net_id))
    if station.name not in loose:
        return [(router, STATION_OCTETS)]
    return [(router, WHOLE), *((str(NetId.parse(port.net_id)), WHOLE) for port in station.ports)]


def without_prefix(index: Index) -> set[str]:
    """Return the stations whose NetIDs have no four octets to themselves."""
    owners: dict[bytes, set[str]] = {}
    for station in index.plant.stations:
        for prefix in prefixes(station):
            owners.setdefault(prefix, set()).add(station.name)
    shared = {name for names in owners.values() if len(names) > 1 for name in names}
    return shared | {s.name for s in index.plant.stations if len(prefixes(s)) > 1}


def prefixes(station: Station) -> set[bytes]:
    """Return the first four octets of each NetID of *station* that is one."""
    found = set()
    for text in [station.net_id, *(port.net_id for port in station.ports)]:
        try:
            found.add(NetId.parse(text).station)
        except ValueError:
            continue  # a finding of its own
    return found
