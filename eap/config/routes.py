"""Routes of a plant file: transport, next router and NetIDs of their targets, and checks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from ipaddress import IPv4Address
from itertools import count
from pathlib import Path
from typing import NamedTuple

from eap.ams.directory import ip_hop, read_address
from eap.ams.routes import Origin, RouteTable
from eap.ams.routes import Route as AmsRoute
from eap.ams.spec import DEFAULT_TARGET, HopSpec, RouteSpec, RoutingSpec, TransportKind
from eap.codec.ams import AMS_TCP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.codec.secureads import AMS_TLS_PORT
from eap.config.brokers import HOST, brokers_of, check_brokers, find_network
from eap.config.finding import FindingReport, PlantFinding, one_of
from eap.config.index import Index, is_local_only
from eap.config.structs import RouteSection, StationSection
from eap.ids import (
    STATION_OCTETS,
    Destination,
    DestinationKind,
    Endpoint,
    InterfaceUri,
    MacAddr,
    NetId,
    parse_host,
    prefix_text,
)
from eap.suggest import suggest

VIA = "STATION/PORT, mqtt:NETWORK, an IPv4 address, tcp:// and one, a MAC address or a NetID"
MQTT = "mqtt:"
"""Prefix of a ``via`` that names a network."""
_SCHEMES = {
    DestinationKind.IP: ("udp",),
    DestinationKind.TCP: ("tcp", "udp"),
    DestinationKind.MAC: ("ethernet",),
    DestinationKind.NET_ID: ("ethernet",),
}
_KINDS = {
    DestinationKind.IP: TransportKind.UDP,
    DestinationKind.TCP: TransportKind.TCP,
    DestinationKind.MAC: TransportKind.ETHERNET,
    DestinationKind.NET_ID: TransportKind.ETHERNET,
}


class SectionError(ValueError):
    """The value of a key of a section is invalid.

    Attributes:
        key: The key.
        expected: Description of valid values.
    """

    def __init__(self, key: str, message: str, expected: str) -> None:
        super().__init__(message)
        self.key = key
        self.expected = expected


class NextHop(NamedTuple):
    """First hop of a route, and the NetID of its router, empty if it is not known."""

    hop: HopSpec
    router: str


def target_of(index: Index, route: RouteSection) -> StationSection | None:
    """Return the station of the plant that *route* leads to, None for anything else."""
    return None if route.to == DEFAULT_TARGET else index.stations.get(route.to)


def next_hop(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    """Return the first hop of *route* of *station*.

    Raises:
        SectionError: the hop does not exist or cannot be reached.
    """
    if route.ams_tcp and route.via:
        raise SectionError("via", f"route {route.to!r} has via and ams_tcp", "one of the two")
    if route.port and (route.ams_tcp or route.via.startswith(MQTT)):
        message = f"route {route.to!r} leaves by no port of its own"
        raise SectionError("port", message, "port only for type 5 (via an address or STATION/PORT)")
    if route.ams_tcp:
        return _by_ams_tcp(index, station, route)
    if route.via.startswith(MQTT):
        return _by_mqtt(index, station, route)
    _check_own_port(index, station, route)
    if not route.via:
        return _direct(index, station, route)
    if "/" in route.via and "://" not in route.via:
        return _by_station(index, station, route)
    return _by_address(index, station, route)


def _check_own_port(index: Index, station: StationSection, route: RouteSection) -> None:
    if route.port and index.eap_port(station, route.port) is None:
        names = station.eap_ports
        message = (
            f"station {station.name} has no EAP port {route.port!r}{suggest(route.port, names)}"
        )
        raise SectionError("port", message, one_of(names))


def _direct(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    target = target_of(index, route)
    if target is None:
        raise SectionError("", f"route {route.to!r} has no via and no ams_tcp", f"via: {VIA}")
    hop = find_hop(index, station, target, own=route.port)
    if hop is None:
        message = f"{station.name} and {target.name} share no interface"
        raise SectionError("to", message, "via: a station between them, or ams_tcp:")
    return NextHop(hop, str(target.net_id))


def _other_port(
    index: Index, station: StationSection, text: str, key: str
) -> tuple[StationSection, str]:
    """Return the station and the port that ``STATION/PORT`` names."""
    name, _, port = text.partition("/")
    other = index.stations.get(name)
    if other is None:
        hint = suggest(name, index.stations)
        raise SectionError(key, f"no station {name!r} in this plant{hint}", one_of(index.stations))
    if other is station:
        raise SectionError(key, f"{text} is of station {name} itself", "a port of another station")
    if index.eap_port(other, port) is None:
        names = [f"{name}/{each}" for each in other.eap_ports]
        raise SectionError(key, f"station {name} has no EAP port {port!r}", one_of(names))
    return other, port


def _by_station(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    other, port = _other_port(index, station, route.via, "via")
    hop = find_hop(index, station, other, own=route.port, other=port)
    if hop is None:
        own = f"port {route.port}" if route.port else "any port"
        message = f"{route.via} cannot be reached from {own} of {station.name}"
        raise SectionError("via", message, "ports that are both of IP, or both of Ethernet")
    return NextHop(hop, str(other.net_id))


def _by_ams_tcp(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    if "/" in route.ams_tcp:
        other, port = _other_port(index, station, route.ams_tcp, "ams_tcp")
        uri = index.uris.get((other.name, port))
        if uri is None or uri.scheme not in {"udp", "tcp"} or not index.ports[other.name, port].ams:
            message = f"{route.ams_tcp} does not serve AMS/TCP"
            raise SectionError("ams_tcp", message, "a port on udp:// or tcp:// without ams: false")
        number = AMS_TCP_PORT
        if route.tls is not None:
            number = other.secure_ads.port if other.secure_ads else 0
            if not number:
                message = f"{other.name} has no Secure ADS"
                raise SectionError("ams_tcp", message, f"secure_ads at station {other.name}")
        return NextHop(_ams_tcp(uri.host, number, route), str(other.net_id))
    try:
        usual = AMS_TCP_PORT if route.tls is None else AMS_TLS_PORT
        host, number = parse_host(route.ams_tcp, usual)
    except ValueError as exc:
        raise SectionError("ams_tcp", f"ams_tcp: {exc}", f"{HOST}, or STATION/PORT") from None
    target = target_of(index, route)
    return NextHop(_ams_tcp(host, number, route), str(target.net_id) if target else "")


def _ams_tcp(host: str, port: int, route: RouteSection) -> HopSpec:
    kind = TransportKind.AMS_TCP if route.tls is None else TransportKind.AMS_TLS
    return HopSpec(kind, "", f"{host}:{port}")


def _by_mqtt(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    """Resolve ``mqtt:NETWORK`` to the target itself, ``mqtt:NETWORK/STATION`` to that forwarder."""
    network, _, name = route.via.removeprefix(MQTT).partition("/")
    if find_network(station, network) is None:
        known = [f"{MQTT}{each.network}" for each in brokers_of(station)]
        message = f"station {station.name} is in no MQTT network {network!r}"
        raise SectionError("via", message, one_of(known))
    other = index.stations.get(name) if name else target_of(index, route)
    if name and other is None:
        hint = suggest(name, index.stations)
        raise SectionError(
            "via", f"no station {name!r} in this plant{hint}", one_of(index.stations)
        )
    if other is not None and find_network(other, network) is None:
        message = f"station {other.name} is in no MQTT network {network!r}"
        raise SectionError("via", message, "a network that both are in")
    router = str(other.net_id) if other is not None else _foreign_router(route)
    return NextHop(HopSpec(TransportKind.MQTT, network, router), router)


def _foreign_router(route: RouteSection) -> str:
    try:
        return str(NetId.parse(route.net_id))
    except ValueError:
        message = f"route {route.to!r} does not say which router of the network receives it"
        raise SectionError("via", message, "mqtt:NETWORK/STATION, or a net_id") from None


def _by_address(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    try:
        destination = Destination.parse(route.via)
    except ValueError as exc:
        raise SectionError("via", f"via: {exc}", VIA) from None
    if destination.is_group:
        raise SectionError("via", f"{route.via} is a group", "the address of one station")
    schemes = _SCHEMES[destination.kind]
    ports = {
        port.name: uri
        for port in station.ports
        if index.eap_port(station, port.name) is port and route.port in {"", port.name}
        if (uri := index.uris.get((station.name, port.name))) and uri.scheme in schemes
    }
    if not ports:
        own = f"port {route.port}" if route.port else f"station {station.name}"
        message = f"{route.via} cannot be reached from {own}"
        raise SectionError("via", message, f"a port on {' or '.join(schemes)}://")
    port = _closest_port(ports, destination, route)
    target = target_of(index, route)
    address = destination.host
    if destination.kind in {DestinationKind.IP, DestinationKind.TCP}:
        address += f":{destination.port or EAP_PORT}"
    hop = HopSpec(_KINDS[destination.kind], port, address)
    return NextHop(hop, str(target.net_id) if target else "")


def _closest_port(
    ports: dict[str, InterfaceUri], destination: Destination, route: RouteSection
) -> str:
    """Return the port whose IPv4 address shares most leading bits with *destination*."""
    if destination.kind in {DestinationKind.IP, DestinationKind.TCP}:
        # XOR: the longest common prefix gives the smallest number, and the file has no netmasks.
        there = int(IPv4Address(destination.host))
        return min(ports, key=lambda name: int(IPv4Address(ports[name].host)) ^ there)
    if len(ports) > 1:
        message = f"route {route.to!r} does not say by which Ethernet interface"
        raise SectionError("port", message, one_of(ports))
    return next(iter(ports))


NET_ID_OCTETS = 6
ANY_NET_ID = NetId(bytes(NET_ID_OCTETS))


def route_net_ids(index: Index, route: RouteSection, shared: set[str]) -> list[tuple[str, int]]:
    """Return NetID and octets to match of each part of *route*.

    *shared* are the stations that :func:`stations_without_prefix` returns.
    """
    if route.to == DEFAULT_TARGET:
        return [(str(ANY_NET_ID), 0)]
    target = target_of(index, route)
    if target is None:
        # Four octets by default: router and ports of a station usually share them.
        return [(str(NetId.parse(route.net_id)), route.octets or STATION_OCTETS)]
    # A virtual NetID replaces a prefix: it cannot stand for several NetIDs of one station.
    return net_ids_of(target, set() if route.virtual else shared)


def net_ids_of(station: StationSection, shared: set[str]) -> list[tuple[str, int]]:
    """Return the NetIDs of *station*, each with the number of octets to match."""
    router = str(station.net_id)
    if station.name not in shared:
        return [(router, STATION_OCTETS)]
    return [(router, NET_ID_OCTETS), *((str(port.net_id), NET_ID_OCTETS) for port in station.ports)]


def stations_without_prefix(index: Index) -> set[str]:
    """Return the stations that share the first four octets of a NetID, or use several."""
    owners: dict[bytes, set[str]] = {}
    for station in index.plant.stations:
        for prefix in prefixes(station):
            owners.setdefault(prefix, set()).add(station.name)
    shared = {name for names in owners.values() if len(names) > 1 for name in names}
    return shared | {s.name for s in index.plant.stations if len(prefixes(s)) > 1}


def prefixes(station: StationSection) -> set[bytes]:
    """Return the first four octets of each valid NetID of *station*."""
    owned = [station.net_id, *(port.net_id for port in station.ports)]
    return {net_id.station for net_id in owned if net_id}


_IP_SCHEMES = {"udp", "tcp"}
_PREFERENCE = (TransportKind.UDP, TransportKind.TCP, TransportKind.ETHERNET)
"""UDP first: it needs no connection, and the kernel resolves addresses."""


class _Candidate(NamedTuple):
    """A hop from port to port; the smallest one is used."""

    preference: int
    differing_bits: int
    """Bits of the IPv4 addresses from the first difference on: hosts of one network come first."""
    order: int
    hop: HopSpec


def find_hop(
    index: Index, station: StationSection, target: StationSection, *, own: str = "", other: str = ""
) -> HopSpec | None:
    """Return the direct hop from *station* to *target*, None if they share no interface.

    Interfaces count as shared if both are of IP, on this host or both not, or if they are
    Ethernet interfaces of one name and VLAN.

    Args:
        index: The plant.
        station: Sender.
        target: Receiver; another station.
        own: Port of the sender; any if empty.
        other: Port of the receiver; any if empty.
    """
    found = (
        _hop(index, (station.name, mine), (target.name, theirs), is_wanted=bool(other))
        for mine in _eap_ports(index, station, own)
        for theirs in _eap_ports(index, target, other)
    )
    # UDP first, then the nearest network, then the order of the ports in the file.
    ranked = [
        _Candidate(_PREFERENCE.index(hop.kind), bits, order, hop)
        for order, each in enumerate(found)
        if each is not None
        for hop, bits in [each]
    ]
    return min(ranked).hop if ranked else None


def _eap_ports(index: Index, station: StationSection, name: str) -> Iterator[str]:
    for port in station.eap_ports:
        if (station.name, port) in index.uris and name in {"", port}:
            yield port


def _hop(
    index: Index, own: tuple[str, str], other: tuple[str, str], *, is_wanted: bool
) -> tuple[HopSpec, int] | None:
    """Return the hop from port to port, and the number of bits from the first difference on.

    With *is_wanted* the file names the port, so that the names of the interfaces may differ.
    """
    uri, target = index.uris[own], index.uris[other]
    if index.are_apart(own[0], other[0]) and (is_local_only(uri) or is_local_only(target)):
        return None
    if uri.scheme in _IP_SCHEMES and target.scheme in _IP_SCHEMES:
        hop = ip_hop(own[1], uri, target)
        bits = (int(read_address(uri.host)) ^ int(read_address(target.host))).bit_length()
        return None if hop is None else (hop, bits)
    if uri.scheme == target.scheme == "ethernet":
        port, there = index.ports[own], index.ports[other]
        if is_wanted or (uri.host == target.host and port.vlan_id == there.vlan_id):
            # The NetID stands for a MAC address that is learned from frames.
            address = MacAddr.parse(there.mac) if there.mac else there.net_id
            return HopSpec(TransportKind.ETHERNET, own[1], str(address)), 0
    return None


_OTHER_NET_ID = "a NetID that no station of the plant has, nor its first four numbers"


def check_routes(index: Index, report: FindingReport, folder: Path) -> None:
    """Report every invalid route and broker; files are in *folder*."""
    shared = stations_without_prefix(index)
    for station in index.plant.stations:
        claimed: dict[bytes, RouteSection] = {}
        for route in station.routes:
            _check_keys(route, report)
            if not route.mqtt:
                _check_route(index, station, route, report)
                _check_claims(index, (station, route), claimed, shared, report)
    check_brokers(index, report, folder)


def _check_keys(route: RouteSection, report: FindingReport) -> None:
    """Report keys of routes on brokers, and keys of brokers on routes."""
    if f"{route.at}.mqtt" in report.lines:
        what, others, expected = "a broker", RouteSection.ROUTE_KEYS, RouteSection.MQTT_KEYS
    else:
        what, others, expected = (
            "a route without mqtt",
            RouteSection.MQTT_KEYS,
            RouteSection.ROUTE_KEYS,
        )
    for key in others:
        if key not in expected and f"{route.at}.{key}" in report.lines:
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
    except SectionError as exc:
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
        report.add(f"{route.at}.to", message, "a station, default, or a net_id of the target")
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
    shared: set[str],
    report: FindingReport,
) -> None:
    """Report NetIDs that belong to another station, or to another route of the station."""
    station, route = sent
    try:
        claims = route_net_ids(index, route, shared)
        if route.virtual and route.to != DEFAULT_TARGET:
            claims = [(route.virtual, octets) for _, octets in claims]
        keys = [NetId.parse(net_id)[:octets] for net_id, octets in claims]
    except ValueError:
        return  # a finding of its own
    for key in keys:
        if key in claimed:
            _report_duplicate(claimed[key], route, report)
            return
        claimed[key] = route
    if route.to != DEFAULT_TARGET and (route.virtual or target_of(index, route) is None):
        where = f"{route.at}.{'virtual' if route.virtual else 'net_id'}"
        _check_owners(index, station, where, keys, report)


def _report_duplicate(first: RouteSection, route: RouteSection, report: FindingReport) -> None:
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
    """Return a warning for each configured route that runs in a loop or ends before its target.

    Args:
        index: A plant without findings.
        routing: Specifications of its routers.
        report: Report of the plant file, for its lines.
    """
    plant = _PlantRouters(index, routing)
    found = []
    for station in index.plant.stations:
        for route in station.routes:
            if message := _follow(plant, station, route.to):
                expected = "routes that end at their target"
                line = report.line_of(route.at)
                found.append(PlantFinding(report.file, line, route.at, message, expected))
    return tuple(found)


def _follow(plant: _PlantRouters, station: StationSection, to: str) -> str:
    """Return the error of the route called *to*, empty if none is known."""
    for spec in plant.routing[station.name].routes:
        # A default route (0 octets) leads to no target that could be followed.
        if spec.name == to and spec.octets:
            names = [station.name]
            net_id = NetId.parse(spec.net_id)
            following = plant.next_station(spec.router)
            while following and plant.owners.get(net_id) != following:
                if following in names:
                    loop = " -> ".join([*names, following])
                    return f"the route to {to!r} runs in a loop: {loop}"
                names.append(following)
                found = plant.table(following).find(net_id)
                if found is None:
                    # Routes that are announced at run time are not known here.
                    if plant.discovers_routes(following):
                        break
                    return f"the route to {to!r} ends at {following}, which has no route to it"
                # The next router knows the target by its real NetID, not by the virtual one.
                net_id = found[0].to_real(net_id)
                following = plant.next_station(str(found[0].router or ""))
    return ""


class _PlantRouters:
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
        """Return the station of a router, empty if the router is not in this plant."""
        return self._routers.get(router, "")

    def discovers_routes(self, station: str) -> bool:
        """Return whether a station auto-discovers routes."""
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
