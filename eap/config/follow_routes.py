"""Where routes lead in the end: from station to station as the plant file has them.

What is wrong with that is a warning only: stations may learn routes, or get others at run time.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import count

from eap.aoe.routes import Origin, Route, RouteTable
from eap.aoe.spec import RouteSpec, RoutingSpec
from eap.aoe.way import Way
from eap.config.finding import Finding, Report
from eap.config.index import Index
from eap.config.structs import Station
from eap.ids import NetId


def follow_routes(
    index: Index, routing: Mapping[str, RoutingSpec], report: Report
) -> tuple[Finding, ...]:
    """Return a warning for each written route that runs in a circle or gets nowhere.

    Args:
        index: A plant without findings.
        routing: What its routers are told.
        report: Of the plant file, for its lines.
    """
    plant = _Plant(index, routing)
    found = []
    for station in index.plant.stations:
        for route in station.routes:
            if message := _follow(plant, station, route.to):
                expected = "routes that end at who is meant"
                line = report.line_of(route.at)
                found.append(Finding(report.file, line, route.at, message, expected))
    return tuple(found)


def _follow(plant: _Plant, station: Station, to: str) -> str:
    """Return what is wrong with the route called *to*, empty if nothing is known to be."""
    for spec in plant.routing[station.name].routes:
        if spec.name == to and spec.octets:
            names = [station.name]
            net_id = NetId.parse(spec.net_id)
            following = plant.next_station(spec.router)
            while following and plant.owners.get(net_id) != following:
                if following in names:
                    circle = " -> ".join([*names, following])
                    return f"the route to {to!r} runs in a circle: {circle}"
                names.append(following)
                found = plant.table(following).find(net_id)
                if found is None:
                    if plant.may_learn(following):
                        break
                    return f"the route to {to!r} ends at {following}, which has none on to it"
                net_id = found[0].to_real(net_id)
                following = plant.next_station(str(found[0].router or ""))
    return ""


class _Plant:
    """The routers of a plant by their NetIDs."""

    def __init__(self, index: Index, routing: Mapping[str, RoutingSpec]) -> None:
        self.routing = routing
        self.owners: dict[NetId, str] = {}
        self._routers = {}
        self._tables: dict[str, RouteTable] = {}
        for station in index.plant.stations:
            router = NetId.parse(station.net_id)
            self._routers[str(router)] = station.name
            self.owners[router] = station.name
            self.owners |= {NetId.parse(port.net_id): station.name for port in station.ports}

    def next_station(self, router: str) -> str:
        """Return the station that has a router, empty if that is not of this plant."""
        return self._routers.get(router, "")

    def may_learn(self, station: str) -> bool:
        """Tell whether others make routes known to a station."""
        routing = self.routing[station]
        return any(routing.learns_by_mqtt(each.network) for each in routing.mqtt)

    def table(self, station: str) -> RouteTable:
        """Return the routes of a station."""
        if station not in self._tables:
            self._tables[station] = RouteTable([*_routes(self.routing[station].routes)])
        return self._tables[station]


def _routes(specs: tuple[RouteSpec, ...]) -> Iterator[Route]:
    for number, spec in zip(count(), specs):
        net_id = NetId.parse(spec.net_id)
        yield Route(
            NetId.parse(spec.virtual) if spec.virtual else net_id,
            spec.name,
            Way(spec.hop.kind, str(number)),
            Origin.STATIC,
            spec.octets,
            real=net_id if spec.virtual else None,
            router=NetId.parse(spec.router) if spec.router else None,
        )
