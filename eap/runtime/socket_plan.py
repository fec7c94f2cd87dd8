"""Plan of the shared sockets of an appliance, from the specifications of its stations.

The supervisor opens what the plan names, services follows it while ports come and go, and the
engine finds the sockets of a port by it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from msgspec.structs import replace

from eap.codec.ethercat import EAP_PORT
from eap.errors import ConfigError
from eap.pd.spec import BusPortSpec, PortKind, PortSpec, StationSpec
from eap.runtime.handover import BusSocket, PortName, SharedSocket, SocketKind

BROADCAST = "255.255.255.255"
EVERY_ADDRESS = "0.0.0.0"  # noqa: S104  what a plant file may say
_ORDER = tuple(SocketKind)


def plan_sockets(stations: Iterable[StationSpec]) -> tuple[SharedSocket, ...]:
    """Return the sockets to open for *stations*, each once, in fixed order."""
    stations = tuple(stations)
    owners: dict[SharedSocket, list[PortName]] = {}
    ports = [(station.name, port) for station in stations for port in station.ports]
    ports = [(station, port) for station, port in ports if port.kind is PortKind.EAP]
    for each in stations:
        for name, wanted in _gateway_sockets(each):
            owners.setdefault(wanted, []).append(name)
    for station, port in ports:
        for wanted in sockets_of(port):
            owners.setdefault(wanted, []).append(PortName(station, port.name))
    ams = [(PortName(station, port.name), _ams_address(port)) for station, port in ports]
    # A socket on 0.0.0.0 occupies the port at every address, so all stations share it.
    every = any(address == EVERY_ADDRESS for _, address in ams)
    for name, address in ams:
        if address:
            for wanted in _ams_sockets(EVERY_ADDRESS if every else address):
                owners.setdefault(wanted, []).append(name)
    planned = [replace(wanted, owners=tuple(names)) for wanted, names in owners.items()]
    return tuple(sorted(planned, key=lambda item: _ORDER.index(item.kind)))


def sockets_of(port: PortSpec) -> Iterator[SharedSocket]:
    """Yield the sockets for the frames of an EAP port, without owners."""
    uri = port.interface
    number = uri.port or EAP_PORT
    if uri.scheme == "ethernet":
        yield SharedSocket(SocketKind.PACKET, uri.host)
        yield SharedSocket(SocketKind.ARP, uri.host, vlan_id=port.vlan_id)
    if uri.scheme == "udp":
        yield SharedSocket(SocketKind.UDP, uri.host, number)
        for group in port.join:
            yield SharedSocket(SocketKind.GROUP, uri.host, number, group=group)
        if port.broadcast:
            yield SharedSocket(SocketKind.GROUP, uri.host, number, group=BROADCAST)
    if uri.scheme in {"udp", "tcp"}:
        # Beside UDP too: gateway requests and published frames may come by TCP to the same port
        # (ETG.8200 has TCP as an option).
        yield SharedSocket(SocketKind.TCP, uri.host, number)


def _ams_sockets(address: str) -> Iterator[SharedSocket]:
    yield SharedSocket(SocketKind.AMS_TCP, address)
    yield SharedSocket(SocketKind.AMS_UDP, address)
    if address != EVERY_ADDRESS:  # which broadcasts arrive at too
        yield SharedSocket(SocketKind.AMS_BROADCAST, address)
        yield SharedSocket(SocketKind.AMS_BROADCAST, address, group=BROADCAST)


def _gateway_sockets(station: StationSpec) -> Iterator[tuple[PortName, SharedSocket]]:
    """Yield what gateways have to themselves, at each address of their station."""
    uris = [port.interface for port in station.ports if port.bus is None]
    hosts = dict.fromkeys(uri.host for uri in uris if uri.scheme in {"udp", "tcp"})
    for port in station.ports:
        if port.gateway is not None and port.gateway.port:
            name = PortName(station.name, port.name)
            for host in hosts:
                yield name, SharedSocket(SocketKind.GATEWAY_UDP, host, port.gateway.port)
                yield name, SharedSocket(SocketKind.GATEWAY_TCP, host, port.gateway.port)


def _ams_address(port: PortSpec) -> str:
    """Return where AMS routers listen for *port*, nothing if nowhere."""
    uri = port.interface
    return uri.host if port.ams and uri.scheme in {"udp", "tcp"} else ""


def plan_buses(stations: Iterable[StationSpec]) -> tuple[BusSocket, ...]:
    """Return the buses to open for *stations*, in the order of their ports."""
    return tuple(
        bus_of(station.name, port)
        for station in stations
        for port in station.ports
        if port.kind is PortKind.BUS
    )


def bus_of(station: str, port: PortSpec) -> BusSocket:
    """Return the bus at a bus port, without number and descriptors."""
    bus = port.bus or BusPortSpec()
    return BusSocket(
        PortName(station, port.name),
        interface=str(port.interface),
        redundant=bus.redundant,
        simulated=bus.simulated,
    )


def require_own_buses(stations: Iterable[StationSpec]) -> None:
    """Check that no two *stations* of this host need one Ethernet interface for a bus.

    A plant file may well name the same interface for stations that run on hosts of their own.

    Raises:
        ConfigError: the bus of one of *stations* is on the interface of another one.
    """
    buses: dict[str, str] = {}
    others: dict[str, str] = {}
    for station in stations:
        for port in station.ports:
            uri = port.interface
            if uri.scheme != "ethernet":
                continue
            label = f"{station.name}/{port.name}"
            is_bus = port.kind is PortKind.BUS
            # EAP ports may share an interface; a bus may share it with nothing.
            taken = buses.get(uri.host) or (others.get(uri.host) if is_bus else None)
            if taken is not None:
                raise ConfigError(
                    f"{uri} is the interface of {taken} and of {label}, expected an interface of"
                    " its own for a bus, or stations that run on different hosts (--station)"
                )
            (buses if is_bus else others)[uri.host] = label
