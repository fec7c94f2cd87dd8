"""Access rules of a plant file: from names and texts to what services judge by."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Network

from eap.aoe.spec import AccessRule, AccessService, AccessTarget, ObjectRange
from eap.config.finding import one_of
from eap.config.index import Index
from eap.config.reach import WHOLE, net_ids_of
from eap.config.routes import MisfitError
from eap.config.structs import Access, Port, Station
from eap.ids import STATION_OCTETS, MacAddr, NetId, ObjectId
from eap.near import near
from eap.pd.spec import PortKind

ALL = "all"
SERVICES = (ALL, *map(str, AccessService))
TARGET = "STATION, STATION/PORT, STATION/PORT/SLAVE, or four to six numbers of a NetID and :PORT"
OBJECTS = "INDEX, INDEX:SUB or FIRST-LAST in hexadecimal, such as 0x8000:01"
_WRITES = tuple(each for each in AccessService if each is not AccessService.READ)
_TOP_PORT = 0xFFFF
_MAC_COLONS = 5


def access_rules(index: Index, station: Station, loose: set[str]) -> Iterator[AccessRule]:
    """Yield the rules of *station*; *loose* are its plant's stations without their own prefix.

    Raises:
        MisfitError: a rule says something that there is not.
    """
    for number, access in enumerate(station.access):
        yield AccessRule(
            name=rule_name(access, number),
            allow=bool(access.allow),
            networks=tuple(parse_sender(text) for text in access.networks if not _is_mac(text)),
            macs=tuple(parse_sender(text) for text in access.networks if _is_mac(text)),
            net_ids=tuple(
                net_id for text in access.net_ids for net_id in parse_source(index, text, loose)
            ),
            doors=access.doors,
            targets=tuple(
                target for text in access.to for target in parse_target(index, text, loose)
            ),
            services=parse_services(access.allow or access.deny),
            objects=tuple(parse_objects(text) for text in access.objects),
        )


def rule_name(access: Access, number: int) -> str:
    """Return how people call the rule; *number* is its place, from 0."""
    return access.name or str(number + 1)


def parse_services(texts: tuple[str, ...]) -> tuple[AccessService, ...]:
    """Return what a rule is about, nothing for everything; ``write`` is all that is no reading."""
    found: list[AccessService] = []
    for text in texts:
        if text == ALL:
            return ()
        if text not in SERVICES:
            raise MisfitError("", f"no access is called {text!r}{near(text, SERVICES)}", _SERVICES)
        found += _WRITES if text == AccessService.WRITE else [AccessService(text)]
    return tuple(dict.fromkeys(found))


_SERVICES = one_of(SERVICES)


def parse_sender(text: str) -> str:
    """Return an IPv4 network, or address, or a MAC address in its usual form."""
    try:
        return str(MacAddr.parse(text) if _is_mac(text) else IPv4Network(text, strict=False))
    except ValueError:
        message = f"{text!r} is no IPv4 network and no MAC address"
        raise MisfitError("", message, "a network such as 10.0.0.0/24, or an address") from None


def _is_mac(text: str) -> bool:
    return text.count(":") == _MAC_COLONS or text.count("-") == _MAC_COLONS


def parse_source(index: Index, text: str, loose: set[str]) -> list[str]:
    """Return the beginnings of NetIDs that *text*, a station or some numbers, stands for."""
    if (station := index.stations.get(text)) is not None:
        return _beginnings(station, loose)
    return [_net_id(text)]


def parse_target(index: Index, text: str, loose: set[str]) -> list[AccessTarget]:
    """Return what *text* names."""
    where, separator, number = text.partition(":")
    if not separator:
        return _targets(index, text, loose)
    if not number.isdecimal() or int(number) > _TOP_PORT:
        raise MisfitError("", f"{number!r} is no AMS port", TARGET)
    return [AccessTarget(each.net_id, int(number)) for each in _targets(index, where, loose)]


def parse_objects(text: str) -> ObjectRange:
    """Return the objects that *text* stands for."""
    first, dash, last = (part.strip() for part in text.partition("-"))
    if dash and ":" in text:
        raise MisfitError("", f"{text!r} names no objects", OBJECTS)
    try:
        low, high = ObjectId.parse(first), ObjectId.parse(last if dash else first)
    except ValueError:
        raise MisfitError("", f"{text!r} names no objects", OBJECTS) from None
    if low > high:
        raise MisfitError("", f"{text!r} ends before it begins", OBJECTS)
    if ":" in text:
        return ObjectRange(low.object_index, low.object_index, low.subindex, low.subindex)
    return ObjectRange(low.object_index, high.object_index)


def _parts(text: str) -> tuple[str, str, str]:
    station, _, rest = text.partition("/")
    port, _, slave = rest.partition("/")
    return station, port, slave


def _targets(index: Index, text: str, loose: set[str]) -> list[AccessTarget]:
    name, port_name, slave = _parts(text)
    station = index.stations.get(name)
    if station is None:
        if "/" not in text and text[:1].isdigit():
            return [AccessTarget(_net_id(text))]
        hint = near(name, index.stations)
        raise MisfitError("", f"no station {name!r} in this plant{hint}", TARGET)
    if not port_name:
        return [AccessTarget(net_id) for net_id in _beginnings(station, loose)]
    port = index.ports.get((name, port_name))
    if port is None:
        names = [each.name for each in station.ports]
        message = f"station {name} has no port {port_name!r}{near(port_name, names)}"
        raise MisfitError("", message, one_of(names))
    net_id = str(NetId.parse(port.net_id))
    if not slave:
        return [AccessTarget(net_id)]
    return [AccessTarget(net_id, _slave(index, station, port, slave))]


def _slave(index: Index, station: Station, port: Port, slave: str) -> int:
    """Return the station address of a slave; any number will do where nothing is expected."""
    bus = index.buses.get((station.name, port.name))
    known = {each.name: each.station for each in bus.slaves} if bus else {}
    if port.kind is not PortKind.BUS:
        raise MisfitError("", f"{station.name}/{port.name} has no slaves", "a bus port")
    if slave in known:
        return known[slave]
    if slave.isdecimal() and (int(slave) in known.values() or not known) and int(slave) < _TOP_PORT:
        return int(slave)
    message = f"bus {station.name}/{port.name} has no slave {slave!r}{near(slave, known)}"
    raise MisfitError("", message, one_of([*known, *map(str, known.values())]))


def _beginnings(station: Station, loose: set[str]) -> list[str]:
    return [".".join(net_id.split(".")[:octets]) for net_id, octets in net_ids_of(station, loose)]


def _net_id(text: str) -> str:
    numbers = text.split(".")
    if STATION_OCTETS <= len(numbers) <= WHOLE and all(
        each.isascii() and each.isdigit() and int(each) < 256 for each in numbers
    ):
        return ".".join(str(int(each)) for each in numbers)
    raise MisfitError("", f"{text!r} is no NetID, nor the first numbers of one", TARGET)
