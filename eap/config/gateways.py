"""What a plant file says of the mailbox gateways of its bus ports, and what follows from it."""

from __future__ import annotations

from collections.abc import Iterator

from eap.codec.ethercat import EAP_PORT
from eap.config.index import Index
from eap.config.routes import MisfitError
from eap.config.structs import Plain, Port, Station
from eap.ids import NetId
from eap.near import near
from eap.pd.spec import BusSlaveSpec, GatewayAddress, GatewaySpec, PortKind

MASTER_PORT = 0xFFFF
ADDRESS = "a mailbox address from 1 to 0xFFFE"
TARGET = (
    "a station address or the name of a slave, STATION/PORT/SLAVE, or a list of these addresses"
)
_MEMBER = "station addresses, names of slaves of this bus, and virtual addresses"
_LAST = 0xFFFE


def gateway_spec(index: Index, station: Station, port: Port) -> GatewaySpec:
    """Return what the gateway of a bus port is told; the checks have passed it."""
    said = port.gateway
    return GatewaySpec(
        enabled=said.enabled,
        port=gateway_port(station, port),
        answer_ms=said.answer_ms,
        silent=said.silent,
        full=said.full,
        padded=said.padded,
        addresses=tuple(
            resolve(index, station, port, parse_address(text), target)
            for text, target in said.addresses.items()
        ),
        in_flight=said.limits.in_flight,
        rate=said.limits.rate,
        clients=said.limits.clients,
    )


def gateway_port(station: Station, port: Port) -> int:
    """Return the port number that a gateway has to itself, 0 for none.

    The one to the first bus is served where the station takes all frames.
    """
    buses = [each.name for each in station.ports if each.kind is PortKind.BUS]
    number = buses.index(port.name)
    return port.gateway.port or (EAP_PORT + number if number else 0)


def hosts_of(index: Index, station: Station) -> Iterator[str]:
    """Yield the IP addresses of a station, each once."""
    uris = (index.uris.get((station.name, each.name)) for each in _eap_ports(station))
    found = (uri.host for uri in uris if uri is not None and uri.scheme in {"udp", "tcp"})
    yield from dict.fromkeys(found)


def parse_address(text: str) -> int:
    """Return a virtual address as a plant file has it; raise MisfitError if it is none."""
    try:
        address = int(text, 0)
    except ValueError:
        address = 0
    if not 0 < address <= _LAST:
        raise MisfitError(text, f"gateway address {text!r}", ADDRESS)
    return address


def resolve(
    index: Index, station: Station, port: Port, address: int, target: Plain
) -> GatewayAddress:
    """Return whom *address* stands for; raise MisfitError if there is no such one."""
    if isinstance(target, list):
        known = _virtual(port)
        members = tuple(_member(index, station, port, each, known) for each in target)
        if not members:
            raise MisfitError("", "a group of nobody", _MEMBER)
        return GatewayAddress(address, members=members)
    names = str(target).split("/")
    if len(names) == 1:
        return GatewayAddress(address, station=_slave(index, station, port, target))
    other = index.stations.get(names[0])
    there = index.ports.get((names[0], names[1]))
    if other is None or there is None or there.kind is not PortKind.BUS or len(names) > 3:
        buses = [f"{at}/{name}" for (at, name), each in index.ports.items() if _is_bus(each)]
        hint = near("/".join(names[:2]), buses)
        raise MisfitError("", f"there is no bus port for {target!r}{hint}", TARGET)
    number = _slave(index, other, there, names[2]) if len(names) == 3 else MASTER_PORT
    if there is port and number != MASTER_PORT:
        return GatewayAddress(address, station=number)
    return GatewayAddress(address, net_id=str(NetId.parse(there.net_id)), port=number)


def _member(
    index: Index, station: Station, port: Port, member: object, known: dict[int, Plain]
) -> int:
    text = str(member)
    if text.lower().startswith("0x") or isinstance(member, int):
        number = int(text, 0)
        if number in known:
            if isinstance(known[number], list):
                raise MisfitError("", f"0x{number:04X} is a group itself", _MEMBER)
            return number
    return _slave(index, station, port, member)


def _slave(index: Index, station: Station, port: Port, slave: object) -> int:
    """Return the station address of a slave that is named by it, or by its name."""
    slaves = slaves_of(index, station, port)
    for each in slaves:
        if slave in {each.name, each.station} or str(slave) == str(each.station):
            return each.station
    name = f"{station.name}/{port.name}"
    text = str(slave)
    if text.isdecimal() or isinstance(slave, int):
        number = int(text, 0)
        if not slaves and 0 < number <= _LAST:
            return number  # nothing describes the bus: anybody may be there
        last = f"; its last one is {slaves[-1].station}" if slaves else ""
        raise MisfitError("", f"{name} has no slave {number}{last}", TARGET)
    hint = near(text, [each.name for each in slaves])
    raise MisfitError("", f"{name} has no slave {text!r}{hint}", TARGET)


def slaves_of(index: Index, station: Station, port: Port) -> tuple[BusSlaveSpec, ...]:
    """Return the slaves that a bus is known to have, none where nothing describes it."""
    bus = index.buses.get((station.name, port.name))
    return bus.slaves if bus else ()


def _virtual(port: Port) -> dict[int, Plain]:
    found: dict[int, Plain] = {}
    for text, target in port.gateway.addresses.items():
        try:
            found[parse_address(text)] = target
        except MisfitError:
            continue  # a finding of its own
    return found


def _eap_ports(station: Station) -> Iterator[Port]:
    return (port for port in station.ports if port.kind is PortKind.EAP)


def _is_bus(port: Port) -> bool:
    return port.kind is PortKind.BUS
