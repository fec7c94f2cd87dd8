"""Routes of a plant file: transport, address, next router and NetIDs of their targets."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Address
from typing import NamedTuple

from eap.ams.spec import DEFAULT_TARGET, HopSpec, TransportKind
from eap.ams.via import ip_hop, read_address
from eap.codec.amstcp import AMS_TCP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.config.brokers import HOST, brokers_of, find_network
from eap.config.finding import one_of
from eap.config.index import Index
from eap.config.structs import PortSection, RouteSection, StationSection
from eap.ids import (
    STATION_OCTETS,
    Destination,
    DestinationKind,
    InterfaceUri,
    MacAddr,
    NetId,
    parse_host,
)
from eap.pd.spec import PortKind
from eap.suggest import suggest

VIA = "STATION/PORT, mqtt:NETWORK, an IPv4 address, tcp:// and one, a MAC address or a NetID"
MQTT = "mqtt:"
"""Begin of a ``via`` that names a network."""
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


class MisfitError(ValueError):
    """A key of a section cannot be what it is.

    Attributes:
        key: Which one.
        expected: What it could be.
    """

    def __init__(self, key: str, message: str, expected: str) -> None:
        super().__init__(message)
        self.key = key
        self.expected = expected


class NextHop(NamedTuple):
    """First hop of a route, and the NetID of the router there, empty if it is not known."""

    hop: HopSpec
    router: str


def target_of(index: Index, route: RouteSection) -> StationSection | None:
    """Return the station of the plant that *route* leads to, None for anything else."""
    return None if route.to == DEFAULT_TARGET else index.stations.get(route.to)


def next_hop(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    """Return where *route* of *station* leads first.

    Raises:
        MisfitError: there is no such way.
    """
    if route.ams_tcp and route.via:
        raise MisfitError("via", f"route {route.to!r} has via and ams_tcp", "one of the two")
    if route.port and (route.ams_tcp or route.via.startswith(MQTT)):
        message = f"route {route.to!r} leaves by no port of its own"
        raise MisfitError("port", message, "port only for type 5 (via an address or STATION/PORT)")
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
        names = [port.name for port in station.ports if port.kind is PortKind.EAP]
        message = (
            f"station {station.name} has no EAP port {route.port!r}{suggest(route.port, names)}"
        )
        raise MisfitError("port", message, one_of(names))


def _direct(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    target = target_of(index, route)
    if target is None:
        raise MisfitError("", f"route {route.to!r} has no via and no ams_tcp", f"via: {VIA}")
    hop = find_hop(index, station, target, own=route.port)
    if hop is None:
        message = f"{station.name} and {target.name} share no interface"
        raise MisfitError("to", message, "via: a station between them, or ams_tcp:")
    return NextHop(hop, str(target.net_id))


def _other_port(
    index: Index, station: StationSection, text: str, key: str
) -> tuple[StationSection, str]:
    """Return the station and the port that ``STATION/PORT`` names."""
    name, _, port = text.partition("/")
    other = index.stations.get(name)
    if other is None:
        hint = suggest(name, index.stations)
        raise MisfitError(key, f"no station {name!r} in this plant{hint}", one_of(index.stations))
    if other is station:
        raise MisfitError(key, f"{text} is of station {name} itself", "a port of another station")
    if index.eap_port(other, port) is None:
        names = [f"{name}/{each.name}" for each in other.ports if each.kind is PortKind.EAP]
        raise MisfitError(key, f"station {name} has no EAP port {port!r}", one_of(names))
    return other, port


def _by_station(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    other, port = _other_port(index, station, route.via, "via")
    hop = find_hop(index, station, other, own=route.port, other=port)
    if hop is None:
        own = f"port {route.port}" if route.port else "any port"
        message = f"{route.via} cannot be reached from {own} of {station.name}"
        raise MisfitError("via", message, "ports that are both of IP, or both of Ethernet")
    return NextHop(hop, str(other.net_id))


def _by_ams_tcp(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    if "/" in route.ams_tcp:
        other, port = _other_port(index, station, route.ams_tcp, "ams_tcp")
        uri = index.uris.get((other.name, port))
        if uri is None or uri.scheme not in {"udp", "tcp"} or not index.ports[other.name, port].ams:
            message = f"{route.ams_tcp} does not serve AMS/TCP"
            raise MisfitError("ams_tcp", message, "a port on udp:// or tcp:// without ams: false")
        return NextHop(_ams_tcp(uri.host, AMS_TCP_PORT), str(other.net_id))
    try:
        host, number = parse_host(route.ams_tcp, AMS_TCP_PORT)
    except ValueError as exc:
        raise MisfitError("ams_tcp", f"ams_tcp: {exc}", f"{HOST}, or STATION/PORT") from None
    target = target_of(index, route)
    return NextHop(_ams_tcp(host, number), str(target.net_id) if target else "")


def _ams_tcp(host: str, port: int) -> HopSpec:
    return HopSpec(TransportKind.AMS_TCP, "", f"{host}:{port}")


def _by_mqtt(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    """``mqtt:NETWORK``: to the target itself; ``mqtt:NETWORK/STATION``: to who passes it on."""
    network, _, name = route.via.removeprefix(MQTT).partition("/")
    if find_network(station, network) is None:
        known = [f"{MQTT}{each.network}" for each in brokers_of(station)]
        message = f"station {station.name} is in no MQTT network {network!r}"
        raise MisfitError("via", message, one_of(known))
    other = index.stations.get(name) if name else target_of(index, route)
    if name and other is None:
        hint = suggest(name, index.stations)
        raise MisfitError("via", f"no station {name!r} in this plant{hint}", one_of(index.stations))
    if other is not None and find_network(other, network) is None:
        message = f"station {other.name} is in no MQTT network {network!r}"
        raise MisfitError("via", message, "a network that both are in")
    router = str(other.net_id) if other is not None else _foreign_router(route)
    return NextHop(HopSpec(TransportKind.MQTT, network, router), router)


def _foreign_router(route: RouteSection) -> str:
    try:
        return str(NetId.parse(route.net_id))
    except ValueError:
        message = f"route {route.to!r} does not say which router of the network takes it"
        raise MisfitError("via", message, "mqtt:NETWORK/STATION, or a net_id") from None


def _by_address(index: Index, station: StationSection, route: RouteSection) -> NextHop:
    try:
        destination = Destination.parse(route.via)
    except ValueError as exc:
        raise MisfitError("via", f"via: {exc}", VIA) from None
    if destination.is_group:
        raise MisfitError("via", f"{route.via} is a group", "the address of one station")
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
        raise MisfitError("via", message, f"a port on {' or '.join(schemes)}://")
    port = _nearest(ports, destination, route)
    target = target_of(index, route)
    address = destination.host
    if destination.kind in {DestinationKind.IP, DestinationKind.TCP}:
        address += f":{destination.port or EAP_PORT}"
    hop = HopSpec(_KINDS[destination.kind], port, address)
    return NextHop(hop, str(target.net_id) if target else "")


def _nearest(ports: dict[str, InterfaceUri], destination: Destination, route: RouteSection) -> str:
    """Return the port whose network *destination* is in."""
    if destination.kind in {DestinationKind.IP, DestinationKind.TCP}:
        there = int(IPv4Address(destination.host))
        return min(ports, key=lambda name: int(IPv4Address(ports[name].host)) ^ there)
    if len(ports) > 1:
        message = f"route {route.to!r} does not say by which Ethernet interface"
        raise MisfitError("port", message, one_of(ports))
    return next(iter(ports))


WHOLE = 6
NOBODY = NetId(bytes(WHOLE))


def reach(index: Index, route: RouteSection, loose: set[str]) -> list[tuple[str, int]]:
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


def net_ids_of(station: StationSection, loose: set[str]) -> list[tuple[str, int]]:
    """Return by which NetIDs, and octets of them, everything at *station* is reached."""
    router = str(station.net_id)
    if station.name not in loose:
        return [(router, STATION_OCTETS)]
    return [(router, WHOLE), *((str(port.net_id), WHOLE) for port in station.ports)]


def without_prefix(index: Index) -> set[str]:
    """Return the stations whose NetIDs have no four octets to themselves."""
    owners: dict[bytes, set[str]] = {}
    for station in index.plant.stations:
        for prefix in prefixes(station):
            owners.setdefault(prefix, set()).add(station.name)
    shared = {name for names in owners.values() if len(names) > 1 for name in names}
    return shared | {s.name for s in index.plant.stations if len(prefixes(s)) > 1}


def prefixes(station: StationSection) -> set[bytes]:
    """Return the first four octets of each NetID of *station* that is one."""
    owned = [station.net_id, *(port.net_id for port in station.ports)]
    return {net_id.station for net_id in owned if net_id}


_IP_SCHEMES = {"udp", "tcp"}
_PREFERENCE = (TransportKind.UDP, TransportKind.TCP, TransportKind.ETHERNET)
"""UDP first: it needs no connection, and the kernel knows who has an address."""


class _Candidate(NamedTuple):
    """A way from port to port; the smallest one is taken."""

    preference: int
    differing_bits: int
    """Of IPv4 addresses, from the first one that differs on: hosts of one network come first."""
    order: int
    hop: HopSpec


def find_hop(
    index: Index, station: StationSection, target: StationSection, *, own: str = "", other: str = ""
) -> HopSpec | None:
    """Return how packets go from *station* to *target* directly, None if no interface is shared.

    Interfaces are taken for shared if both are of IP, on this host or both not, or if they are
    Ethernet interfaces of one name and VLAN.

    Args:
        index: The plant.
        station: From where.
        target: To where; another station.
        own: The port to leave by; any if empty.
        other: The port to arrive at; any if empty.
    """
    found = (
        _hop(index, (station.name, mine), (target.name, theirs), is_wanted=bool(other))
        for mine in _eap_ports(index, station, own)
        for theirs in _eap_ports(index, target, other)
    )
    ranked = [
        _Candidate(_PREFERENCE.index(hop.kind), bits, order, hop)
        for order, each in enumerate(found)
        if each is not None
        for hop, bits in [each]
    ]
    return min(ranked).hop if ranked else None


def _eap_ports(index: Index, station: StationSection, name: str) -> Iterator[str]:
    for port in station.ports:
        known = port.kind is PortKind.EAP and (station.name, port.name) in index.uris
        if known and name in {"", port.name}:
            yield port.name


def _hop(
    index: Index, own: tuple[str, str], other: tuple[str, str], *, is_wanted: bool
) -> tuple[HopSpec, int] | None:
    """Return the hop from port to port, and how many bits of their addresses differ.

    With *is_wanted* the file says that it is there, whatever the names of the interfaces are.
    """
    uri, target = index.uris[own], index.uris[other]
    if uri.scheme in _IP_SCHEMES and target.scheme in _IP_SCHEMES:
        hop = ip_hop(own[1], uri, target)
        bits = (int(read_address(uri.host)) ^ int(read_address(target.host))).bit_length()
        return None if hop is None else (hop, bits)
    if uri.scheme == target.scheme == "ethernet":
        port, there = index.ports[own], index.ports[other]
        if is_wanted or (uri.host == target.host and _vid(port) == _vid(there)):
            address = MacAddr.parse(there.mac) if there.mac else there.net_id
            return HopSpec(TransportKind.ETHERNET, own[1], str(address)), 0
    return None


def _vid(port: PortSection) -> int:
    return port.vlan.id if port.vlan else 0
