"""Destinations of frames: addresses of plant-file texts, and checks of them."""

from __future__ import annotations

from ipaddress import IPv4Address

from msgspec.structs import replace

from eap.codec.ethercat import EAP_PORT
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.structs import FrameSection, PortSection, StationSection
from eap.ids import (
    BROADCAST_MAC,
    EAP_MULTICAST_MAC,
    Destination,
    DestinationKind,
    InterfaceUri,
    MacAddr,
    NetId,
)
from eap.pd import rules
from eap.pd.rules import DESTINATIONS
from eap.pd.spec import REQUESTER, PortKind

IP_BROADCAST = "255.255.255.255"
EXPECTED = {
    "udp": "an IPv4 address, tcp:// and one, STATION/PORT, a port's NetID, broadcast or requester",
    "tcp": "tcp:// and an IPv4 address, STATION/PORT, a port's NetID or requester",
    "ethernet": "a MAC address, STATION/PORT, a port's NetID, multicast, broadcast or requester",
    "loop": "STATION/PORT, a port's NetID, a MAC address, multicast, broadcast or requester",
}
"""What ``to`` may be on each kind of interface."""
_KEYWORDS = {
    ("broadcast", "udp"): IP_BROADCAST,
    ("broadcast", "ethernet"): str(BROADCAST_MAC),
    ("broadcast", "loop"): str(BROADCAST_MAC),
    ("multicast", "ethernet"): str(EAP_MULTICAST_MAC),
    ("multicast", "loop"): str(EAP_MULTICAST_MAC),
}


def resolve(text: str, uri: InterfaceUri, index: Index) -> Destination:
    """Return the address that *text* means for a frame that leaves by *uri*.

    Raises:
        ValueError: there is no such address, or no frame gets there from this interface.
    """
    if text in {"broadcast", "multicast"}:
        keyword = _KEYWORDS.get((text, uri.scheme))
        if keyword is None:
            raise ValueError(f"{text} has no usual address on {uri.scheme}://")
        return Destination.parse(keyword)
    if "/" in text and "://" not in text:
        return _of_port(text, uri, index)
    destination = Destination.parse(text)
    if destination.kind is DestinationKind.NET_ID:
        return _of_net_id(destination, uri, index)
    if destination.kind not in DESTINATIONS.get(uri.scheme, ()):
        raise ValueError(f"{text} cannot be reached from {uri}")
    if destination.kind is DestinationKind.TCP and destination.is_group:
        raise ValueError(f"{text} is a group, and TCP has none")
    return destination


def _of_net_id(destination: Destination, uri: InterfaceUri, index: Index) -> Destination:
    """Return where the port of that NetID is, or the one EAP port of the router that has it.

    On Ethernet it may be outside the plant: what it sends tells its MAC address.
    """
    if not any(NetId.parse(destination.host)):
        raise ValueError(f"NetID {destination.host} stands for any")
    owners = find_net_id(destination.host, index)
    if len(owners) > 1:
        several = ", ".join(f"{station}/{name}" for station, name in owners)
        raise ValueError(f"NetID {destination.host} is a router's, with several ports: {several}")
    if owners:
        return _of_port("/".join(owners[0]), uri, index)
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


def _of_port(text: str, uri: InterfaceUri, index: Index) -> Destination:
    station, _, name = text.partition("/")
    target = index.uris.get((station, name))
    if target is None:
        raise ValueError(f"{text} is no port of this plant")
    port = index.ports[station, name]
    if target.scheme == "loop" == uri.scheme and target.host == uri.host:
        return Destination.parse(str(EAP_MULTICAST_MAC))
    address = f"{target.host}:{target.port}" if target.port else target.host
    if target.scheme == uri.scheme == "udp":
        return Destination.parse(address)
    if target.scheme == uri.scheme == "ethernet" and port.kind is PortKind.EAP:
        return Destination(DestinationKind.NET_ID, str(port.net_id))
    if uri.scheme in {"udp", "tcp"} and takes_tcp(port, target):
        return Destination.parse(f"tcp://{address}")
    raise ValueError(f"{text} ({target}) has no address that is known for frames from {uri}")


def takes_tcp(port: PortSection, uri: InterfaceUri) -> bool:
    """Tell whether *port* takes type 4 from TCP connections."""
    return uri.scheme == "tcp" or (uri.scheme == "udp" and port.tcp)


def reaches(
    destination: Destination,
    sender: tuple[PortSection, InterfaceUri],
    receiver: tuple[PortSection, InterfaceUri],
) -> bool:
    """Tell whether a frame from *sender* arrives at *receiver*, which joins groups as needed.

    A MAC address is believed: which interface has it is not in the plant file.
    """
    port, uri = receiver
    if sender[1].scheme == "loop" or uri.scheme == "loop":
        return (sender[1].scheme, sender[1].host) == (uri.scheme, uri.host)
    if destination.kind in {DestinationKind.MAC, DestinationKind.NET_ID}:
        is_for_it = destination.kind is DestinationKind.MAC or port.net_id == NetId.parse(
            destination.host
        )
        return uri.scheme == "ethernet" and _vid(sender[0]) == _vid(port) and is_for_it
    if (destination.port or EAP_PORT) != (uri.port or EAP_PORT):
        return False
    if destination.kind is DestinationKind.TCP:
        return takes_tcp(port, uri) and uri.host in {destination.host, "0.0.0.0"}  # noqa: S104
    if uri.scheme != "udp":
        return False
    directed = port.broadcast and destination.host.endswith(".255")
    return destination.is_group or directed or uri.host in {destination.host, "0.0.0.0"}  # noqa: S104


def group_of(destination: Destination) -> str | None:
    """Return the group that a receiver has to join for *destination*, None if there is none."""
    if not destination.is_group or destination.host == IP_BROADCAST:
        return None
    if destination.kind is DestinationKind.MAC:
        usual = {str(EAP_MULTICAST_MAC), str(BROADCAST_MAC)}
        return None if destination.host in usual else destination.host
    return destination.host


def _vid(port: PortSection) -> int:
    return port.vlan.id if port.vlan else 0


def check_address(
    index: Index,
    report: FindingReport,
    sent: tuple[StationSection, FrameSection],
    destination: Destination | None,
) -> None:
    """Report a frame to a NetID that is its own, or whose MAC address nothing will tell."""
    station, frame = sent
    if destination is None or destination.kind is not DestinationKind.NET_ID:
        return
    own = index.ports[station.name, frame.port]
    for key in find_net_id(destination.host, index):
        port = index.ports[key]
        message = f"frame {frame.name!r} goes to the NetID of "
        if port is own:
            report.add(f"{frame.at}.to", f"{message}its own port", "another port")
        elif not port.mac and not _is_heard(index, key, station, own):
            line = report.line_of(port.at)
            message += f"{'/'.join(key)}, whose MAC address nothing will tell: no frame from there "
            message += "comes here by a MAC address or a group"
            report.add(
                f"{frame.at}.to", message, f"such a frame, or mac: on that port (line {line})"
            )


def _is_heard(
    index: Index, key: tuple[str, str], station: StationSection, own: PortSection
) -> bool:
    """Tell whether a frame of port *key* gets to port *own* whatever NetIDs stand for."""
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
            return True  # if this port asks
        try:
            destination = resolve(frame.to, sender[1], index)
        except ValueError:
            continue  # a finding of its own
        is_known = destination.kind is not DestinationKind.NET_ID or bool(own.mac)
        is_taken = group_of(destination) in {None, *joined} or frame in subscribed
        if is_known and is_taken and reaches(destination, sender, receiver):
            return True
    return False


def check_monitoring(
    report: FindingReport, frame: FrameSection, destination: Destination | None, uri: InterfaceUri
) -> None:
    """Report monitoring of what cannot be monitored, and addresses that are none.

    *destination* is None for frames to the requester.
    """
    spec = frame.spec(str(destination))
    if frame.monitor_ip and uri.scheme == "ethernet" and not _is_host(frame.monitor_ip):
        path = f"{frame.at}.monitor_ip"
        report.add(path, f"monitor_ip is {frame.monitor_ip!r}", "the IPv4 address of one host")
        spec = replace(spec, monitor_ip="")
    report.add_breaches(frame.at, rules.check_monitoring(spec, destination, uri))


def _is_host(text: str) -> bool:
    try:
        address = IPv4Address(text)
    except ValueError:
        return False
    return not (address.is_multicast or address.is_loopback or address.is_unspecified) and (
        text != "255.255.255.255"
    )
