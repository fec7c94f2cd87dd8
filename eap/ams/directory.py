"""Names and addresses of a plant: AMS addresses behind names, and hops as operators write them.

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
from typing import NamedTuple

from eap.ams.spec import DirectoryPort, DirectoryStation, HopSpec, TransportKind
from eap.codec.ams import AMS_TCP_PORT, DEVICE_PORT, SYSTEM_PORT
from eap.codec.ethercat import EAP_PORT
from eap.codec.secureads import AMS_TLS_PORT
from eap.ids import InterfaceUri, MacAddr, NetId, parse_host
from eap.od.profiles.router9000 import ROUTER
from eap.suggest import suggest

_MAX_PORT = 0xFFFF


class AmsAddress(NamedTuple):
    """Target of an ADS request."""

    net_id: NetId
    port: int

    def __str__(self) -> str:
        return f"{self.net_id}:{self.port}"


class Directory:
    """All stations of a plant, with their ports and slaves."""

    def __init__(self, stations: Sequence[DirectoryStation]) -> None:
        self.stations = {station.name: station for station in stations}
        self._build()

    def replace(self, station: DirectoryStation) -> None:
        """Have other ports and slaves for a station."""
        self.stations[station.name] = station
        self._build()

    def _build(self) -> None:
        stations = self.stations.values()
        self._names = {
            AmsAddress(station.net_id, SYSTEM_PORT): station.name for station in stations
        }
        self._net_ids = {station.net_id: station.name for station in stations}
        for station in stations:
            own = AmsAddress(station.net_id, DEVICE_PORT)
            self._names[own] = f"{station.name}/{ROUTER}"
            for port in station.ports:
                self._enter(f"{station.name}/{port.name}", port)

    def find(self, text: str) -> AmsAddress:
        """Return the address of ``STATION``, ``STATION/PORT[/SLAVE]`` or ``NETID[:PORT]``.

        A station stands for the system service of its router, ``STATION/router`` for the router's
        dictionary.

        Raises:
            ValueError: there is no such name here, or it is no name; the message says what is.
        """
        if text.count(".") == 5 and "/" not in text:
            return _parse(text)
        name, _, rest = text.partition("/")
        station = self.stations.get(name)
        if station is None:
            raise ValueError(f"no station {name!r} in this plant{suggest(name, self.stations)}")
        if not rest:
            return AmsAddress(station.net_id, SYSTEM_PORT)
        port_name, slash, slave = rest.partition("/")
        ports = {port.name: port for port in station.ports}
        port = ports.get(port_name)
        if port is None and rest == ROUTER:
            return AmsAddress(station.net_id, DEVICE_PORT)
        if port is None:
            hint = suggest(port_name, ports) or f"; it has {', '.join(ports) or 'none'}"
            raise ValueError(f"station {name} has no port {port_name!r}{hint}")
        number = _slave(f"{name}/{port_name}", port, slave) if slash else DEVICE_PORT
        return AmsAddress(port.net_id, number)

    def find_device(self, text: str) -> AmsAddress:
        """As :meth:`find`, but a station stands for its first EAP port, if it has one."""
        station = self.stations.get(text)
        ports = () if station is None else station.ports
        first = next((port for port in ports if not port.is_bus), None)
        return self.find(text if first is None else f"{text}/{first.name}")

    def name_of(self, net_id: NetId, port: int) -> str:
        """Return the name of the owner of an address; empty if unknown."""
        known = self._names.get(AmsAddress(net_id, port))
        if known is not None:
            return known
        owner = self._net_ids.get(net_id)
        return "" if owner is None else f"{owner}:{port}"

    def station_of(self, net_id: NetId) -> str:
        """Return the station that has a NetID, also one of its ports; empty if unknown."""
        return self._net_ids.get(net_id, "").partition("/")[0]

    def _enter(self, name: str, port: DirectoryPort) -> None:
        net_id = port.net_id
        self._net_ids.setdefault(net_id, name)
        self._names[AmsAddress(net_id, DEVICE_PORT)] = name
        for slave, number in port.slaves.items():
            self._names[AmsAddress(net_id, number)] = f"{name}/{slave}"


def _parse(text: str) -> AmsAddress:
    net_id, colon, port = text.partition(":")
    if not colon:
        return AmsAddress(NetId.parse(net_id), DEVICE_PORT)
    if not (port.isascii() and port.isdigit() and int(port) <= _MAX_PORT):
        raise ValueError(f"{port!r} in {text!r} is no AMS port (0 to {_MAX_PORT})")
    return AmsAddress(NetId.parse(net_id), int(port))


def _slave(owner: str, port: DirectoryPort, slave: str) -> int:
    if not port.is_bus:
        raise ValueError(f"{owner} is no bus port, so there are no slaves behind it")
    if slave in port.slaves:
        return port.slaves[slave]
    if slave.isascii() and slave.isdigit() and 0 < int(slave) < DEVICE_PORT:
        return int(slave)
    known = ", ".join(f"{name} ({number})" for name, number in port.slaves.items())
    hint = suggest(slave, port.slaves) or (f"; they are {known}" if known else "")
    raise ValueError(f"no slave {slave!r} behind {owner}{hint}")


FORMS = (
    "STATION/PORT, ams-tcp:HOST, ams-tls:HOST, udp:ADDRESS, tcp:ADDRESS, ethernet:MAC or"
    " mqtt:NETWORK"
)
_IP = ("udp", "tcp")
_ADDRESS = re.compile(r"\d+(\.\d+){3}(:\d+)?", re.ASCII)
_MAC = re.compile(r"[0-9A-Fa-f]{2}([:-][0-9A-Fa-f]{2}){5}")
_NET_ID_DOTS = 5


def parse_via(
    text: str, net_id: str, own: DirectoryStation, directory: Directory, *, port: str = ""
) -> HopSpec:
    """Return where packets go.

    Args:
        text: As an operator writes it.
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
    here, target = mine.interface, there.interface
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
    # An address of all interfaces is no target; a loopback address is reached on its host only.
    if other.is_unspecified or (not own.is_unspecified and own.is_loopback != other.is_loopback):
        return None
    kind = TransportKind.UDP if here.scheme == there.scheme == "udp" else TransportKind.TCP
    return HopSpec(kind, port, f"{there.host}:{there.port or EAP_PORT}")


@cache
def read_address(host: str) -> IPv4Address:
    """Read an address that is one of very many pairs in a large plant."""
    return IPv4Address(host)


def _complete(text: str) -> str:
    """Return *text* with the kind of its transport in front."""
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


def _by_ams_tls(rest: str, ports: Sequence[DirectoryPort]) -> HopSpec:
    del ports
    host, port = parse_host(rest, AMS_TLS_PORT)
    return HopSpec(TransportKind.AMS_TLS, "", f"{host}:{port}")


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
    TransportKind.AMS_TLS: _by_ams_tls,
    TransportKind.UDP: _by_udp,
    TransportKind.TCP: _by_tcp,
    TransportKind.ETHERNET: _by_ethernet,
}


def _first(ports: Sequence[DirectoryPort], schemes: tuple[str, ...]) -> str:
    for port in ports:
        if port.interface.scheme in schemes:
            return port.name
    names = ", ".join(f"{port.name} ({port.interface})" for port in ports)
    raise ValueError(f"no EAP port here is on {' or '.join(schemes)}: {names}")


def _ip_address(text: str) -> str:
    host, port = parse_host(text, EAP_PORT)
    try:
        return f"{IPv4Address(host)}:{port}"
    except AddressValueError as exc:
        raise ValueError(f"{host!r} is no IPv4 address: {exc}") from None
