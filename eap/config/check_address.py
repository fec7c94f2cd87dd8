"""Checks of where frames go: will a NetID ever have an address, and who can be monitored."""

from __future__ import annotations

from ipaddress import IPv4Address

from msgspec.structs import replace

from eap.config.destination import find_net_id, group_of, reaches, resolve
from eap.config.finding import Report
from eap.config.index import Index
from eap.config.structs import Frame, Port, Station
from eap.ids import Destination, DestinationKind, InterfaceUri, MacAddr
from eap.pd import rules
from eap.pd.spec import REQUESTER


def check_address(
    index: Index, report: Report, sent: tuple[Station, Frame], destination: Destination | None
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


def _is_heard(index: Index, key: tuple[str, str], station: Station, own: Port) -> bool:
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
    report: Report, frame: Frame, destination: Destination | None, uri: InterfaceUri
) -> None:
    """Report monitoring of what cannot be monitored, and addresses that are none.

    *destination* is None for frames to who asks.
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
