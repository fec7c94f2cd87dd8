"""Ports of a plant file and destinations of frames: addresses, and checks of both."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from ipaddress import IPv4Address

from msgspec.structs import replace

from eap.codec.ams import AMS_TCP_PORT
from eap.codec.amsdiscovery import AMS_UDP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.config.bus import INTERFACE, check_bus_port
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.structs import FrameSection, PortSection, StationSection
from eap.ids import (
    BROADCAST_MAC,
    EAP_MULTICAST_MAC,
    INTERFACE_NAME_SIZE,
    Destination,
    DestinationKind,
    InterfaceUri,
    MacAddr,
    NetId,
    is_host,
)
from eap.od.profiles import eap1000 as profile
from eap.pd import rules
from eap.pd.rules import DESTINATIONS, NAME, check_phase, duplicates, is_group, is_name
from eap.pd.spec import REQUESTER, PortKind

IP_BROADCAST = "255.255.255.255"
EXPECTED = {
    "udp": "an IPv4 address, tcp:// and one, STATION/PORT, a port's NetID, broadcast or requester",
    "tcp": "tcp:// and an IPv4 address, STATION/PORT, a port's NetID or requester",
    "ethernet": "a MAC address, STATION/PORT, a port's NetID, multicast, broadcast or requester",
    "loop": "STATION/PORT, a port's NetID, a MAC address, multicast, broadcast or requester",
}
"""Valid values of ``to`` on each kind of interface."""
_KEYWORDS = {
    ("broadcast", "udp"): IP_BROADCAST,
    ("broadcast", "ethernet"): str(BROADCAST_MAC),
    ("broadcast", "loop"): str(BROADCAST_MAC),
    ("multicast", "ethernet"): str(EAP_MULTICAST_MAC),
    ("multicast", "loop"): str(EAP_MULTICAST_MAC),
}


def resolve_destination(text: str, uri: InterfaceUri, index: Index) -> Destination:
    """Return the address that *text* stands for in a frame that leaves by *uri*.

    Raises:
        ValueError: the address does not exist, or no frame reaches it from this interface.
    """
    if text in {"broadcast", "multicast"}:
        keyword = _KEYWORDS.get((text, uri.scheme))
        if keyword is None:
            raise ValueError(f"{text} has no usual address on {uri.scheme}://")
        return Destination.parse(keyword)
    if "/" in text and "://" not in text:
        return _port_address(text, uri, index)
    destination = Destination.parse(text)
    if destination.kind is DestinationKind.NET_ID:
        return _net_id_address(destination, uri, index)
    if destination.kind not in DESTINATIONS.get(uri.scheme, ()):
        raise ValueError(f"{text} cannot be reached from {uri}")
    if destination.kind is DestinationKind.TCP and destination.is_group:
        raise ValueError(f"{text} is a group, and TCP has none")
    return destination


def _net_id_address(destination: Destination, uri: InterfaceUri, index: Index) -> Destination:
    """Return the address of the port with that NetID, or of the only EAP port of that router.

    On Ethernet it may be outside the plant: the engine learns its MAC address from its frames.
    """
    # 0.0.0.0.0.0 stands for any publisher in a subscription and addresses no port.
    if not any(NetId.parse(destination.host)):
        raise ValueError(f"NetID {destination.host} stands for any")
    # A port comes before a router of the same NetID; a router stands for its only EAP port.
    owners = find_net_id(destination.host, index)
    if len(owners) > 1:
        several = ", ".join(f"{station}/{name}" for station, name in owners)
        raise ValueError(f"NetID {destination.host} is a router's, with several ports: {several}")
    if owners:
        return _port_address("/".join(owners[0]), uri, index)
    if uri.scheme != "ethernet":
        raise ValueError(f"no port of this plant has the NetID {destination.host}")
    return destination


def find_net_id(text: str, index: Index) -> list[tuple[str, str]]:
    """Return station and name of the EAP port of NetID *text*, or of all ports of that router."""
    wanted = NetId.parse(text)
    eap = [key for key, port in index.ports.items() if port.kind is PortKind.EAP]
    return [key for key in eap if index.ports[key].net_id == wanted] or [
        key for key in eap if index.stations[key[0]].net_id == wanted
    ]


def _port_address(text: str, uri: InterfaceUri, index: Index) -> Destination:
    station, _, name = text.partition("/")
    target = index.uris.get((station, name))
    if target is None:
        raise ValueError(f"no port {text} in this plant")
    port = index.ports[station, name]
    # A loopback line has no addresses: each frame reaches all of its other ports.
    if target.scheme == "loop" == uri.scheme and target.host == uri.host:
        return Destination.parse(str(EAP_MULTICAST_MAC))
    address = f"{target.host}:{target.port}" if target.port else target.host
    if target.scheme == uri.scheme == "udp":
        return Destination.parse(address)
    # By NetID: the file need not hold MAC addresses, the engine learns them from frames.
    if target.scheme == uri.scheme == "ethernet" and port.kind is PortKind.EAP:
        return Destination(DestinationKind.NET_ID, str(port.net_id))
    if uri.scheme in {"udp", "tcp"} and accepts_tcp(port, target):
        return Destination.parse(f"tcp://{address}")
    raise ValueError(f"{text} ({target}) has no address that is known for frames from {uri}")


def accepts_tcp(port: PortSection, uri: InterfaceUri) -> bool:
    """Return whether *port* accepts type 4 on TCP connections."""
    return uri.scheme == "tcp" or (uri.scheme == "udp" and port.tcp)


def reaches(
    destination: Destination,
    sender: tuple[PortSection, InterfaceUri],
    receiver: tuple[PortSection, InterfaceUri],
) -> bool:
    """Return whether a frame from *sender* arrives at *receiver*, which joins groups as needed.

    Any MAC address counts as reached: the plant file does not say which interface has it.
    """
    port, uri = receiver
    if sender[1].scheme == "loop" or uri.scheme == "loop":
        return (sender[1].scheme, sender[1].host) == (uri.scheme, uri.host)
    if destination.kind in {DestinationKind.MAC, DestinationKind.NET_ID}:
        is_for_it = destination.kind is DestinationKind.MAC or port.net_id == NetId.parse(
            destination.host
        )
        return uri.scheme == "ethernet" and sender[0].vlan_id == port.vlan_id and is_for_it
    if (destination.port or EAP_PORT) != (uri.port or EAP_PORT):
        return False
    if destination.kind is DestinationKind.TCP:
        return accepts_tcp(port, uri) and uri.host in {destination.host, "0.0.0.0"}  # noqa: S104
    if uri.scheme != "udp":
        return False
    # The file has no netmask, so any host number of 255 may be the directed broadcast.
    directed = port.broadcast and destination.host.endswith(".255")
    return destination.is_group or directed or uri.host in {destination.host, "0.0.0.0"}  # noqa: S104


def group_of(destination: Destination) -> str | None:
    """Return the multicast group that a receiver has to join for *destination*, if any."""
    if not destination.is_group or destination.host == IP_BROADCAST:
        return None
    if destination.kind is DestinationKind.MAC:
        # Every Ethernet port receives these two without joining.
        usual = {str(EAP_MULTICAST_MAC), str(BROADCAST_MAC)}
        return None if destination.host in usual else destination.host
    return destination.host


def check_net_id_destination(
    index: Index,
    report: FindingReport,
    sent: tuple[StationSection, FrameSection],
    destination: Destination | None,
) -> None:
    """Report a frame to a NetID that is its own, or whose MAC address cannot be learned."""
    station, frame = sent
    if destination is None or destination.kind is not DestinationKind.NET_ID:
        return
    own = index.ports[station.name, frame.port]
    for key in find_net_id(destination.host, index):
        port = index.ports[key]
        message = f"frame {frame.name!r} goes to the NetID of "
        if port is own:
            report.add(f"{frame.at}.to", f"{message}its own port", "another port")
        elif not port.mac and not _is_mac_learned(index, key, station, own):
            line = report.line_of(port.at)
            message += f"{'/'.join(key)}, whose MAC address cannot be learned: no frame from there "
            message += "arrives by a MAC address or a group"
            report.add(
                f"{frame.at}.to", message, f"such a frame, or mac: on that port (line {line})"
            )


def _is_mac_learned(
    index: Index, key: tuple[str, str], station: StationSection, own: PortSection
) -> bool:
    """Return whether a frame of port *key* arrives at port *own* without resolving a NetID."""
    sender = index.ports[key], index.uris[key]
    receiver = own, index.uris[station.name, own.name]
    subscribed = [
        sent.frame
        for subscription in station.subscribe
        if subscription.port == own.name
        for sent in index.publishers(subscription)
    ]
    joined = {
        str(MacAddr.parse(text)) for text in own.join if rules.is_group(text, receiver[1].scheme)
    }
    for (name, _), frame in index.frames.items():
        if (name, frame.port) != key:
            continue
        if frame.to == REQUESTER:
            return True  # if this port sends the request
        try:
            destination = resolve_destination(frame.to, sender[1], index)
        except ValueError:
            continue  # a finding of its own
        is_known = destination.kind is not DestinationKind.NET_ID or bool(own.mac)
        is_taken = group_of(destination) in {None, *joined} or frame in subscribed
        if is_known and is_taken and reaches(destination, sender, receiver):
            return True
    return False


def check_frame_monitoring(
    report: FindingReport, frame: FrameSection, destination: Destination | None, uri: InterfaceUri
) -> None:
    """Report monitoring of a destination that cannot be monitored, and invalid addresses.

    *destination* is None for frames to the requester.
    """
    spec = frame.spec(str(destination))
    if frame.monitor_ip and uri.scheme == "ethernet" and not _is_remote_host(frame.monitor_ip):
        path = f"{frame.at}.monitor_ip"
        report.add(path, f"monitor_ip is {frame.monitor_ip!r}", "the IPv4 address of one host")
        spec = replace(spec, monitor_ip="")
    report.add_breaches(frame.at, rules.check_monitoring(spec, destination, uri))


_EAP_SCHEMES = {"udp", "ethernet", "tcp", "loop"}
_SCHEMES = {row.key.partition(".")[0]: row.schemes for row in profile.row_of(profile.PORT).entries}
_LIMITED = {
    "vlan": "has a vlan",
    "broadcast": "listens to UDP broadcasts",
    "tcp": "receives type 4 over TCP",
}
"""Keys of a port that only some interfaces have, and their effects."""


def check_ports(index: Index, report: FindingReport) -> None:
    """Report every invalid station and port."""
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
        # Duplicates are looked for among valid names only: one finding for each item.
        if is_name(name):
            named.append((name, (path, name)))
        else:
            report.add(path, f"{what} name {name!r}", NAME)
    for (path, name), (first, _) in duplicates(named):
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
    if uri.scheme == "ethernet" and (len(uri.host) > INTERFACE_NAME_SIZE or "/" in uri.host):
        expected = f"a name of at most {INTERFACE_NAME_SIZE} characters"
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


def _is_remote_host(text: str) -> bool:
    return is_host(text) and not IPv4Address(text).is_loopback


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
        for key in _own_addresses(station, port, uri):
            if key in first:
                line = report.line_of(first[key])
                message = f"{uri} is used twice (first in line {line})"
                report.add(path, message, "an address of its own for each port")
                break
            first[key] = path
        if port.redundant and port.redundant in {str(each) for each in index.uris.values()} - {
            str(uri)
        }:
            message = f"{port.redundant} is the interface of another port"
            report.add(f"{port.at}.redundant", message, "an interface of its own for each line")
    # Slaves forward every frame, also those of other stations on the same interface.
    _check_segments(index, report)


def _own_addresses(station: str, port: PortSection, uri: InterfaceUri) -> Iterator[tuple[str, ...]]:
    """Yield the addresses of *port* that no other port may have."""
    if uri.scheme == "udp":
        yield "UDP", uri.host, str(uri.port or EAP_PORT)
    if port.kind is PortKind.EAP and accepts_tcp(port, uri):
        yield "TCP", uri.host, str(uri.port or EAP_PORT)
    if uri.scheme == "ethernet":
        # Stations share an interface, ports of one station would take each frame twice.
        vid = port.vlan_id if port.kind is PortKind.EAP else 0
        yield station, port.kind.value, uri.host, str(vid)


def _check_segments(index: Index, report: FindingReport) -> None:
    """Report EAP ports on the interface of a bus of the same station."""
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
        message = f"the slaves of {bus.name} would forward and return the frames of {name}"
        report.add(
            f"{bus.at}.interface",
            f"{uri} is the interface of {name} too (line {line}): {message}",
            "an interface of its own for a bus",
        )
