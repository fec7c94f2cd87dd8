"""Where packets of an added route go, as people write it: a port of the plant, or an address.

    island-02/eap0        ams-tcp:192.168.1.5        udp:10.0.0.5        mqtt:line

As in a plant file ``10.0.0.5`` stands for UDP too, and a MAC address or a NetID for Ethernet.
Type 5 leaves by an EAP port of the station's own that can reach the address: by UDP, TCP or an
Ethernet interface, as the two interfaces say.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from functools import cache
from ipaddress import AddressValueError, IPv4Address

from eap.ams.directory import Directory
from eap.ams.spec import DirectoryPort, DirectoryStation, HopSpec, TransportKind
from eap.codec.amstcp import AMS_TCP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.ids import InterfaceUri, MacAddr, NetId, parse_host

FORMS = "STATION/PORT, ams-tcp:HOST, udp:ADDRESS, tcp:ADDRESS, ethernet:MAC or mqtt:NETWORK"
_IP = ("udp", "tcp")
_ADDRESS = re.compile(r"\d+(\.\d+){3}(:\d+)?", re.ASCII)
_MAC = re.compile(r"[0-9A-Fa-f]{2}([:-][0-9A-Fa-f]{2}){5}")
_NET_ID_DOTS = 5


def parse_via(
    text: str, net_id: str, own: DirectoryStation, directory: Directory, *, port: str = ""
) -> HopSpec:
    """Return where packets go.

    Args:
        text: As people write it.
        net_id: Of the station that the route leads to; at a broker it is the address.
        own: The station that they leave.
        directory: All of its plant.
        port: EAP port of *own* that they leave by; empty for the first that can.

    Raises:
        ValueError: that is nowhere; the message says what is expected.
    """
    kind, colon, rest = _complete(text).partition(":")
    if kind == TransportKind.MQTT and rest:
        return _by_mqtt(rest, net_id, directory)
    if colon and rest and kind in _READERS:
        return _READERS[kind](rest, _ports(own, port))
    name, _, other = text.partition("/")
    if name not in directory.stations:
        raise ValueError(f"via {text!r} is neither a station of the plant nor one of {FORMS}")
    if name == own.name:
        raise ValueError(f"via {text!r} is this station itself")
    theirs = _ports(directory.stations[name], other)
    for mine in _ports(own, port):
        for there in theirs:
            if (hop := _hop(mine, there)) is not None:
                return hop
    raise ValueError(
        f"via {text!r}: no port of {own.name}{f' but {port}' * bool(port)} shares an interface with"
        f" it; name the address, one of {FORMS}"
    )


def _ports(station: DirectoryStation, name: str) -> Sequence[DirectoryPort]:
    """Return the EAP ports of a station, or the one called *name*."""
    ports = [port for port in station.ports if not port.is_bus]
    found = [port for port in ports if name in {"", port.name}]
    if not found:
        known = ", ".join(port.name for port in ports) or "none"
        raise ValueError(f"station {station.name} has no EAP port {name!r}; it has {known}")
    return found


def _hop(mine: DirectoryPort, there: DirectoryPort) -> HopSpec | None:
    here, target = InterfaceUri.parse(mine.interface), InterfaceUri.parse(there.interface)
    if here.scheme in _IP and target.scheme in _IP:
        return ip_hop(mine.name, here, target)
    if here.scheme == target.scheme == "ethernet" and here.host == target.host:
        return HopSpec(TransportKind.ETHERNET, mine.name, str(there.net_id))
    return None


def ip_hop(port: str, here: InterfaceUri, there: InterfaceUri) -> HopSpec | None:
    """Return the hop by the EAP port *port*, at *here*, to another one at *there*.

    Both are of IP.  None says that they cannot reach each other: one of them is on its host only.
    """
    own, other = read_address(here.host), read_address(there.host)
    if other.is_unspecified or (not own.is_unspecified and own.is_loopback != other.is_loopback):
        return None
    kind = TransportKind.UDP if here.scheme == there.scheme == "udp" else TransportKind.TCP
    return HopSpec(kind, port, f"{there.host}:{there.port or EAP_PORT}")


@cache
def read_address(host: str) -> IPv4Address:
    """Read an address that is one of very many pairs in a large plant."""
    return IPv4Address(host)


def _complete(text: str) -> str:
    """Return *text* with the kind of its door in front."""
    kind, colon, rest = text.partition("://")
    if colon:
        return f"{kind}:{rest}"
    if "/" in text or text.partition(":")[0] in _READERS:
        return text
    if text.count(".") == _NET_ID_DOTS or _MAC.fullmatch(text):
        return f"{TransportKind.ETHERNET}:{text}"
    return f"{TransportKind.UDP}:{text}" if _ADDRESS.fullmatch(text) else text


def _by_ams_tcp(rest: str, ports: Sequence[DirectoryPort]) -> HopSpec:
    del ports
    host, port = parse_host(rest, AMS_TCP_PORT)
    return HopSpec(TransportKind.AMS_TCP, "", f"{host}:{port}")


def _by_udp(rest: str, ports: Sequence[DirectoryPort]) -> HopSpec:
    return HopSpec(TransportKind.UDP, _first(ports, ("udp",)), _ip_address(rest))


def _by_tcp(rest: str, ports: Sequence[DirectoryPort]) -> HopSpec:
    return HopSpec(TransportKind.TCP, _first(ports, _IP), _ip_address(rest))


def _by_ethernet(rest: str, ports: Sequence[DirectoryPort]) -> HopSpec:
    name = _first(ports, ("ethernet",))
    try:
        address = NetId.parse(rest) if rest.count(".") else MacAddr.parse(rest)
    except ValueError as exc:
        raise ValueError(f"via ethernet: {exc}") from None
    return HopSpec(TransportKind.ETHERNET, name, str(address))


def _by_mqtt(rest: str, net_id: str, directory: Directory) -> HopSpec:
    network, _, router = rest.partition("/")
    known = directory.stations.get(router)
    if known:
        return HopSpec(TransportKind.MQTT, network, str(known.net_id))
    return HopSpec(TransportKind.MQTT, network, str(NetId.parse(router or net_id)))


_READERS: dict[str, Callable[[str, Sequence[DirectoryPort]], HopSpec]] = {
    TransportKind.AMS_TCP: _by_ams_tcp,
    TransportKind.UDP: _by_udp,
    TransportKind.TCP: _by_tcp,
    TransportKind.ETHERNET: _by_ethernet,
}


def _first(ports: Sequence[DirectoryPort], schemes: tuple[str, ...]) -> str:
    for port in ports:
        if InterfaceUri.parse(port.interface).scheme in schemes:
            return port.name
    names = ", ".join(f"{port.name} ({port.interface})" for port in ports)
    raise ValueError(f"no EAP port here is on {' or '.join(schemes)}: {names}")


def _ip_address(text: str) -> str:
    host, port = parse_host(text, EAP_PORT)
    try:
        return f"{IPv4Address(host)}:{port}"
    except AddressValueError as exc:
        raise ValueError(f"{host!r} is no IPv4 address: {exc}") from None
