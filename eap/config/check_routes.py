"""Checks of routes: targets, NetIDs that two of them claim, and loops."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path

from eap.ads.endpoint import Endpoint
from eap.ams.routes import Origin, RouteTable
from eap.ams.routes import Route as AmsRoute
from eap.ams.spec import DEFAULT_TARGET, RouteSpec, RoutingSpec
from eap.config.brokers import check_brokers
from eap.config.finding import FindingReport, PlantFinding, one_of
from eap.config.index import Index
from eap.config.routes import MQTT, MisfitError, next_hop, reach, target_of, without_prefix
from eap.config.structs import RouteSection, StationSection
from eap.ids import NetId, prefix_text
from eap.suggest import suggest

_OTHER_NET_ID = "a NetID that no station of the plant has, nor its first four numbers"


def check_routes(index: Index, report: FindingReport, folder: Path) -> None:
    """Report every route and broker that cannot be as it is; files are in *folder*."""
    loose = without_prefix(index)
    for station in index.plant.stations:
        claimed: dict[bytes, RouteSection] = {}
        for route in station.routes:
            _check_keys(route, report)
            if not route.mqtt:
                _check_route(index, station, route, report)
                _check_claims(index, (station, route), claimed, loose, report)
    check_brokers(index, report, folder)


def _check_keys(route: RouteSection, report: FindingReport) -> None:
    """Report keys of routes at brokers, and the other way round."""
    if f"{route.at}.mqtt" in report.lines:
        what, others, expected = "a broker", RouteSection.ROUTE_KEYS, RouteSection.MQTT_KEYS
    else:
        what, others, expected = (
            "a route without mqtt",
            RouteSection.MQTT_KEYS,
            RouteSection.ROUTE_KEYS,
        )
    for key in others:
        if f"{route.at}.{key}" in report.lines:
            report.add(f"{route.at}.{key}", f"{key} does not belong to {what}", one_of(expected))
    if not route.to and not route.mqtt:
        report.add(route.at, "route has neither to nor mqtt", "to: STATION, or mqtt: URL")


def _check_route(
    index: Index, station: StationSection, route: RouteSection, report: FindingReport
) -> None:
    if route.to == station.name:
        report.add(f"{route.at}.to", f"route of {station.name} to itself", "another station")
        return
    if not route.to or route.to in report.broken:
        return
    _check_net_id(index, route, report)
    if not (route.via or route.ams_tcp or route.net_id or _is_known(index, route)):
        return  # reported already
    try:
        next_hop(index, station, route)
    except MisfitError as exc:
        path = f"{route.at}.{exc.key}" if exc.key else route.at
        report.add(path, str(exc), exc.expected)
    except ValueError:
        pass  # a NetID or an interface that is a finding of its own


def _check_net_id(index: Index, route: RouteSection, report: FindingReport) -> None:
    is_default, known = route.to == DEFAULT_TARGET, _is_known(index, route)
    path = f"{route.at}.net_id"
    names_router = is_default and route.via.startswith(MQTT)  # the one that takes the rest
    if known and route.net_id and not names_router:
        what = "a default route" if is_default else f"{route.to} is a station of this plant, it"
        report.add(path, f"{what} needs no net_id", "none")
    elif not known and not route.net_id:
        hint = suggest(route.to, index.stations)
        message = f"no station {route.to!r} in this plant{hint}, and no net_id"
        report.add(f"{route.at}.to", message, "a station, default, or a net_id of who is meant")
    if known and route.octets is not None:
        report.add(f"{route.at}.octets", f"octets of the route to {route.to!r}", "it with a net_id")
    if is_default and route.virtual:
        report.add(f"{route.at}.virtual", "a default route has no virtual NetID", "none")
    for key, text in (("net_id", route.net_id), ("virtual", route.virtual)):
        if text and not _is_usable(text):
            message = f"{key}: {text!r} is not an AMS NetID of a station"
            report.add(f"{route.at}.{key}", message, "six numbers such as 5.23.91.23.1.1")


def _is_known(index: Index, route: RouteSection) -> bool:
    return route.to == DEFAULT_TARGET or target_of(index, route) is not None


def _is_usable(text: str) -> bool:
    try:
        return any(NetId.parse(text))
    except ValueError:
        return False


def _check_claims(
    index: Index,
    sent: tuple[StationSection, RouteSection],
    claimed: dict[bytes, RouteSection],
    loose: set[str],
    report: FindingReport,
) -> None:
    """Report NetIDs that belong to another station, or to another route of the station."""
    station, route = sent
    try:
        claims = reach(index, route, loose)
        if route.virtual and route.to != DEFAULT_TARGET:
            claims = [(route.virtual, octets) for _, octets in claims]
        keys = [NetId.parse(net_id)[:octets] for net_id, octets in claims]
    except ValueError:
        return  # a finding of its own
    for key in keys:
        if key in claimed:
            _report_doubled(claimed[key], route, report)
            return
        claimed[key] = route
    if route.to != DEFAULT_TARGET and (route.virtual or target_of(index, route) is None):
        where = f"{route.at}.{'virtual' if route.virtual else 'net_id'}"
        _check_owners(index, station, where, keys, report)


def _report_doubled(first: RouteSection, route: RouteSection, report: FindingReport) -> None:
    line = report.line_of(first.at)
    if first.to == route.to:
        report.add(route.at, f"a second route to {route.to!r} (first in line {line})", "one")
        return
    key = "virtual" if route.virtual else "net_id"
    message = f"the route to {first.to!r} (line {line}) is for the same NetIDs"
    report.add(f"{route.at}.{key}", message, "other NetIDs, or octets: 5 or 6 on both")


def _check_owners(
    index: Index, station: StationSection, path: str, keys: list[bytes], report: FindingReport
) -> None:
    for prefix in keys:
        for owner in index.plant.stations:
            owned = [owner.net_id, *(port.net_id for port in owner.ports)]
            if any(net_id.startswith(prefix) for net_id in owned):
                whose = "this station" if owner is station else f"station {owner.name}"
                report.add(path, f"NetID {prefix_text(prefix)} is one of {whose}", _OTHER_NET_ID)
                return


def follow_routes(
    index: Index, routing: Mapping[str, RoutingSpec], report: FindingReport
) -> tuple[PlantFinding, ...]:
    """Return a warning for each written route that runs in a circle or gets nowhere.

    Args:
        index: A plant without findings.
        routing: Specifications of its routers.
        report: Of the plant file, for its lines.
    """
    plant = _Plant(index, routing)
    found = []
    for station in index.plant.stations:
        for route in station.routes:
            if message := _follow(plant, station, route.to):
                expected = "routes that end at who is meant"
                line = report.line_of(route.at)
                found.append(PlantFinding(report.file, line, route.at, message, expected))
    return tuple(found)


def _follow(plant: _Plant, station: StationSection, to: str) -> str:
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
            self._routers[str(station.net_id)] = station.name
            self.owners[station.net_id] = station.name
            self.owners |= {port.net_id: station.name for port in station.ports}

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


def _routes(specs: tuple[RouteSpec, ...]) -> Iterator[AmsRoute]:
    for number, spec in zip(count(), specs):
        net_id = NetId.parse(spec.net_id)
        yield AmsRoute(
            NetId.parse(spec.virtual) if spec.virtual else net_id,
            spec.name,
            Endpoint(spec.hop.kind, str(number)),
            Origin.STATIC,
            spec.octets,
            real=net_id if spec.virtual else None,
            router=NetId.parse(spec.router) if spec.router else None,
        )
