"""Checks of names, NetIDs and ports: what must be unique and what fits an interface."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from ipaddress import IPv4Address

from eap.codec.amsdiscovery import AMS_UDP_PORT
from eap.codec.amstcp import AMS_TCP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.config.bus import INTERFACE, check_bus_port
from eap.config.destination import takes_tcp
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.structs import PortSection, StationSection
from eap.ids import InterfaceUri, MacAddr, NetId
from eap.od.profiles import eap1000 as profile
from eap.pd.rules import NAME, check_phase, doubles, is_group, is_name
from eap.pd.spec import PortKind

_EAP_SCHEMES = {"udp", "ethernet", "tcp", "loop"}
_MAX_INTERFACE_NAME = 15
_SCHEMES = {row.key.partition(".")[0]: row.schemes for row in profile.row_of(profile.PORT).entries}
_LIMITED = {
    "vlan": "has a vlan",
    "broadcast": "listens to UDP broadcasts",
    "tcp": "takes type 4 from TCP",
}
"""Keys of a port that only some interfaces have, and what they do."""


def check_ports(index: Index, report: FindingReport) -> None:
    """Report every station and port that cannot be as it is."""
    plant = index.plant
    if not is_name(plant.plant):
        report.add("plant", f"plant name {plant.plant!r}", NAME)
    if not plant.stations:
        report.add("stations", "the plant has no stations", "at least one station")
    check_names(((s.at, s.name) for s in plant.stations), "station", report)
    _check_net_ids(plant.stations, report)
    for station in plant.stations:
        check_names(((p.at, p.name) for p in station.ports), "port", report)
        _check_order(station, report)
        for port in station.ports:
            _check_port(port, report)
        cycle = index.cycle_us(station)
        report.add_breaches(station.at, check_phase(cycle, station.phase_us or 0))
    _check_addresses(index, report)


def check_names(names: Iterable[tuple[str, str]], what: str, report: FindingReport) -> None:
    """Report names that are malformed or given twice; *names* are (path of the item, name)."""
    named = []
    for at, name in names:
        path = f"{at}.name" if f"{at}.name" in report.lines else at
        if is_name(name):
            named.append((name, (path, name)))
        else:
            report.add(path, f"{what} name {name!r}", NAME)
    for (path, name), (first, _) in doubles(named):
        message = f"{what} {name!r} exists already (line {report.line_of(first)})"
        report.add(path, message, "a name of its own")


def _check_net_ids(stations: tuple[StationSection, ...], report: FindingReport) -> None:
    first: dict[NetId, str] = {}
    owners: list[StationSection | PortSection] = []
    for station in stations:
        owners += [station, *station.ports]
    for section in owners:
        path = f"{section.at}.net_id"
        net_id = section.net_id
        if not net_id:  # reported when it was read
            continue
        if not any(net_id):
            report.add(path, f"NetID {net_id} stands for any", "a NetID of its own")
        elif net_id in first:
            line = report.line_of(first[net_id])
            message = f"NetID {net_id} is used twice (first in line {line})"
            report.add(path, message, "a NetID of its own for each router and port")
        else:
            first[net_id] = path


def _check_order(station: StationSection, report: FindingReport) -> None:
    if not station.ports and f"{station.at}.ports[0]" not in report.lines:
        report.add(f"{station.at}.ports", f"station {station.name} has no ports", "an EAP port")
    bus_seen = False
    for port in station.ports:
        if port.kind is PortKind.BUS:
            bus_seen = True
        elif bus_seen:
            report.add(port.at, f"EAP port {port.name} after a bus port", "EAP ports first")


def _check_port(port: PortSection, report: FindingReport) -> None:
    path = f"{port.at}.interface"
    _check_keys(port, report)
    try:
        uri = InterfaceUri.parse(port.interface)
    except ValueError as exc:
        is_bus = port.kind is PortKind.BUS
        expected = INTERFACE if is_bus else "such as udp://127.0.1.1 or ethernet://eth0"
        report.add(path, f"interface: {exc}", expected)
        return
    if uri.scheme == "ethernet" and (len(uri.host) > _MAX_INTERFACE_NAME or "/" in uri.host):
        expected = f"a name of at most {_MAX_INTERFACE_NAME} characters"
        report.add(path, f"{uri.host!r} is no interface name", expected)
    if port.kind is PortKind.BUS:
        check_bus_port(port, uri, report)
        return
    if uri.scheme not in _EAP_SCHEMES:
        report.add(path, f"{uri.scheme}:// is no interface of an EAP port", "udp, ethernet or tcp")
        return
    if uri.scheme in {"udp", "tcp"} and not _is_own(uri.host):
        report.add(path, f"{uri.host} is no address of a host", "the address of this station")
    if uri.options and uri.scheme != "loop":
        report.add(path, f"{uri.scheme}:// takes no options", f"{uri.scheme}://{uri.host}")
    _check_options(port, uri, report)


def _check_keys(port: PortSection, report: FindingReport) -> None:
    is_bus = port.kind is PortKind.BUS
    for key in PortSection.EAP_KEYS if is_bus else PortSection.BUS_KEYS:
        if f"{port.at}.{key}" in report.lines:
            what, other = ("bus", "EAP") if is_bus else ("EAP", "bus")
            message = f"{port.name} is a port of kind {port.kind.value}, {key} belongs to {other}"
            report.add(f"{port.at}.{key}", f"{message} ports", f"no {key} on {what} ports")


def _is_own(host: str) -> bool:
    address = IPv4Address(host)
    return not address.is_multicast and str(address) != "255.255.255.255"


def _is_station(mac: str) -> bool:
    try:
        address = MacAddr.parse(mac)
    except ValueError:
        return False
    return any(address) and not address.is_group


def _check_options(port: PortSection, uri: InterfaceUri, report: FindingReport) -> None:
    only = f"it only on a port of another kind than {uri.scheme}://"
    for key, does in _LIMITED.items():
        if getattr(port, key) and uri.scheme not in _SCHEMES[key]:
            report.add(f"{port.at}.{key}", f"port {port.name} {does}", only)
    _check_ams(port, uri, report)
    if port.mac and uri.scheme != "ethernet":
        report.add(f"{port.at}.mac", f"port {port.name} has a MAC address", only)
    elif port.mac and not _is_station(port.mac):
        report.add(
            f"{port.at}.mac", f"mac is {port.mac!r}", "the address of one station's interface"
        )
    for position, group in enumerate(port.join):
        if not is_group(group, uri.scheme):
            kind = "MAC" if uri.scheme == "ethernet" else "IPv4"
            expected = (
                f"a multicast address ({kind})" if uri.scheme in {"udp", "ethernet"} else only
            )
            report.add(f"{port.at}.join[{position}]", f"{group!r} cannot be joined", expected)


def _check_ams(port: PortSection, uri: InterfaceUri, report: FindingReport) -> None:
    path = f"{port.at}.ams"
    if uri.scheme not in {"udp", "tcp"}:
        if path in report.lines:
            message = f"port {port.name} says whether AMS is served at its IP address"
            report.add(path, message, f"it only on udp:// and tcp://: {uri.scheme}:// has none")
    elif port.ams and uri.port in {AMS_TCP_PORT, AMS_UDP_PORT}:
        message = f"port number {uri.port} belongs to AMS"
        report.add(f"{port.at}.interface", message, "another one, or ams: false")


def _check_addresses(index: Index, report: FindingReport) -> None:
    first: dict[tuple[str, ...], str] = {}
    for (station, name), uri in index.uris.items():
        port = index.ports[station, name]
        path = f"{port.at}.interface"
        for key in _own_keys(station, port, uri):
            if key in first:
                line = report.line_of(first[key])
                message = f"{uri} is used twice (first in line {line})"
                report.add(path, message, "an address of its own for each port")
                break
            first[key] = path
    _check_segments(index, report)


def _own_keys(station: str, port: PortSection, uri: InterfaceUri) -> Iterator[tuple[str, ...]]:
    """Yield the resources of *port* that no other port may have."""
    if uri.scheme == "udp":
        yield "UDP", uri.host, str(uri.port or EAP_PORT)
    if port.kind is PortKind.EAP and takes_tcp(port, uri):
        yield "TCP", uri.host, str(uri.port or EAP_PORT)
    if uri.scheme == "ethernet":
        # Stations share an interface, ports of one station would take each frame twice.
        vid = port.vlan.id if port.vlan and port.kind is PortKind.EAP else 0
        yield station, port.kind.value, uri.host, str(vid)


def _check_segments(index: Index, report: FindingReport) -> None:
    """Report EAP ports on the interface that a bus of the same station is wired to."""
    buses = {
        (station, uri.host): index.ports[station, name]
        for (station, name), uri in index.uris.items()
        if uri.scheme == "ethernet" and index.ports[station, name].kind is PortKind.BUS
    }
    for (station, name), uri in index.uris.items():
        port = index.ports[station, name]
        bus = buses.get((station, uri.host))
        if bus is None or uri.scheme != "ethernet" or port.kind is PortKind.BUS:
            continue
        line = report.line_of(f"{port.at}.interface")
        message = f"the slaves of {bus.name} would pass on and send back the frames of {name}"
        report.add(
            f"{bus.at}.interface",
            f"{uri} is the interface of {name} too (line {line}): {message}",
            "an interface of its own for a bus",
        )
