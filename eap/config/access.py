"""Access rules of a plant file: specifications of rules, and checks of their sections."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from ipaddress import IPv4Network
from pathlib import Path
from typing import TypeVar

from eap.ams.spec import (
    IP_TRANSPORTS,
    NAMED_CLIENTS,
    AccessRule,
    AccessService,
    AccessTarget,
    ObjectRange,
    Role,
    TransportKind,
)
from eap.config.brokers import brokers_of
from eap.config.files import check_file
from eap.config.finding import FindingReport, one_of
from eap.config.index import Index
from eap.config.ports import check_names
from eap.config.routes import NET_ID_OCTETS, SectionError, net_ids_of, stations_without_prefix
from eap.config.structs import AccessSection, PortSection, StationSection, UserSection
from eap.ids import STATION_OCTETS, MacAddr, ObjectId
from eap.pd.spec import PortKind
from eap.suggest import suggest

ALL = "all"
SERVICES = (ALL, *map(str, AccessService))
TARGET = "STATION, STATION/PORT, STATION/PORT/SLAVE, or four to six numbers of a NetID and :PORT"
OBJECTS = "INDEX, INDEX:SUB or FIRST-LAST in hexadecimal, such as 0x8000:01"
# A service that is added later counts as a write, so no existing rule lets it through.
_WRITES = tuple(each for each in AccessService if each is not AccessService.READ)
_TOP_PORT = 0xFFFF
_CLIENT = f"{TransportKind.AMS_TLS}:"
"""Prefix of a client by Secure ADS."""
_MAC_COLONS = 5


def access_rules(index: Index, station: StationSection, shared: set[str]) -> Iterator[AccessRule]:
    """Yield the rules of *station*; *shared* are the stations without a NetID prefix of their own.

    Raises:
        SectionError: a rule names something that does not exist.
    """
    for number, access in enumerate(station.access):
        yield AccessRule(
            name=rule_name(access, number),
            allow=bool(access.allow),
            networks=tuple(parse_sender(text) for text in access.networks if not _is_mac(text)),
            macs=tuple(parse_sender(text) for text in access.networks if _is_mac(text)),
            net_ids=tuple(
                net_id for text in access.net_ids for net_id in parse_source(index, text, shared)
            ),
            transports=access.transports or access.doors,
            targets=tuple(
                target for text in access.to for target in parse_target(index, text, shared)
            ),
            services=parse_services(access.allow or access.deny, allows=bool(access.allow)),
            objects=tuple(parse_objects(text) for text in access.objects),
            roles=access.roles,
            members=tuple(
                parse_member(text)
                for user in index.plant.users
                if user.role in access.roles
                for text in user.networks
            ),
        )


def rule_name(access: AccessSection, number: int) -> str:
    """Return the name of a rule in messages; *number* is its position, from 0."""
    return access.name or str(number + 1)


def parse_services(texts: tuple[str, ...], *, allows: bool) -> tuple[AccessService, ...]:
    """Return the services of a rule, none for all; ``write`` is every service but reading.

    A rule that *allows* writing does not allow to configure, which changes the rules, too.
    """
    found: list[AccessService] = []
    for text in texts:
        if text == ALL:
            return ()
        if text not in SERVICES:
            raise SectionError("", f"unknown access {text!r}{suggest(text, SERVICES)}", _SERVICES)
        if text == AccessService.WRITE:
            found += [each for each in _WRITES if each is not AccessService.CONFIGURE or not allows]
        else:
            found.append(AccessService(text))
    return tuple(dict.fromkeys(found))


_SERVICES = one_of(SERVICES)


def parse_sender(text: str) -> str:
    """Return an IPv4 network, or address, or a MAC address in its usual form."""
    try:
        return str(MacAddr.parse(text) if _is_mac(text) else IPv4Network(text, strict=False))
    except ValueError:
        message = f"{text!r} is no IPv4 network and no MAC address"
        raise SectionError("", message, "a network such as 10.0.0.0/24, or an address") from None


def parse_member(text: str) -> str:
    """Return an address of a user as :func:`parse_sender`, or the transport of its clients."""
    if text.startswith(NAMED_CLIENTS) and not text.endswith(":"):
        return text
    return parse_sender(text)


def _is_mac(text: str) -> bool:
    return text.count(":") == _MAC_COLONS or text.count("-") == _MAC_COLONS


def parse_source(index: Index, text: str, shared: set[str]) -> list[str]:
    """Return the NetID prefixes that *text*, a station or some numbers, stands for."""
    if (station := index.stations.get(text)) is not None:
        return _net_id_prefixes(station, shared)
    return [_net_id(text)]


def parse_target(index: Index, text: str, shared: set[str]) -> list[AccessTarget]:
    """Return the targets that *text* names: a station, a port, a slave, or a NetID."""
    where, separator, number = text.partition(":")
    if not separator:
        return _targets(index, text, shared)
    if not number.isdecimal() or int(number) > _TOP_PORT:
        raise SectionError("", f"{number!r} is no AMS port", TARGET)
    return [AccessTarget(each.net_id, int(number)) for each in _targets(index, where, shared)]


def parse_objects(text: str) -> ObjectRange:
    """Return the objects that *text* stands for."""
    first, dash, last = (part.strip() for part in text.partition("-"))
    if dash and ":" in text:
        raise SectionError("", f"{text!r} names no objects", OBJECTS)
    try:
        low, high = ObjectId.parse(first), ObjectId.parse(last if dash else first)
    except ValueError:
        raise SectionError("", f"{text!r} names no objects", OBJECTS) from None
    if low > high:
        raise SectionError("", f"{text!r} ends before it begins", OBJECTS)
    if ":" in text:
        return ObjectRange(low.object_index, low.object_index, low.subindex, low.subindex)
    return ObjectRange(low.object_index, high.object_index)


def _parts(text: str) -> tuple[str, str, str]:
    station, _, rest = text.partition("/")
    port, _, slave = rest.partition("/")
    return station, port, slave


def _targets(index: Index, text: str, shared: set[str]) -> list[AccessTarget]:
    name, port_name, slave = _parts(text)
    station = index.stations.get(name)
    if station is None:
        if "/" not in text and text[:1].isdigit():
            return [AccessTarget(_net_id(text))]
        hint = suggest(name, index.stations)
        raise SectionError("", f"no station {name!r} in this plant{hint}", TARGET)
    if not port_name:
        return [AccessTarget(net_id) for net_id in _net_id_prefixes(station, shared)]
    port = index.ports.get((name, port_name))
    if port is None:
        names = [each.name for each in station.ports]
        message = f"station {name} has no port {port_name!r}{suggest(port_name, names)}"
        raise SectionError("", message, one_of(names))
    net_id = str(port.net_id)
    if not slave:
        return [AccessTarget(net_id)]
    # The AMS port of a slave is its station address (ADS to the master's NetID).
    return [AccessTarget(net_id, _slave(index, station, port, slave))]


def _slave(index: Index, station: StationSection, port: PortSection, slave: str) -> int:
    """Return the station address of a slave; without a bus file any number is valid."""
    # Without a bus file any slave may be there, and any station address is accepted.
    known = {each.name: each.station for each in index.slaves(station, port.name)}
    if port.kind is not PortKind.BUS:
        raise SectionError("", f"{station.name}/{port.name} has no slaves", "a bus port")
    if slave in known:
        return known[slave]
    if slave.isdecimal() and (int(slave) in known.values() or not known) and int(slave) < _TOP_PORT:
        return int(slave)
    message = f"bus {station.name}/{port.name} has no slave {slave!r}{suggest(slave, known)}"
    raise SectionError("", message, one_of([*known, *map(str, known.values())]))


def _net_id_prefixes(station: StationSection, shared: set[str]) -> list[str]:
    return [".".join(net_id.split(".")[:octets]) for net_id, octets in net_ids_of(station, shared)]


def _net_id(text: str) -> str:
    numbers = text.split(".")
    if STATION_OCTETS <= len(numbers) <= NET_ID_OCTETS and all(
        each.isascii() and each.isdigit() and int(each) < 256 for each in numbers
    ):
        return ".".join(str(int(each)) for each in numbers)
    raise SectionError("", f"{text!r} is no NetID, nor the first numbers of one", TARGET)


T = TypeVar("T")

_OBJECT_SERVICES = {AccessService.READ, AccessService.WRITE}


def check_access(index: Index, report: FindingReport, folder: Path) -> None:
    """Report every invalid rule and user; files are in *folder*."""
    shared = stations_without_prefix(index)
    for station in index.plant.stations:
        named = ((each.at, each.name) for each in station.access if each.name)
        check_names(named, "access rule", report)
        fine = [_check_rule(index, station, each, shared, report) for each in station.access]
        # Only as a whole: a rule with errors, once it is corrected, may cover another one.
        if all(fine):
            _check_order(index, station, shared, report)
        check_names(((user.at, user.name) for user in station.users), "user", report)
        for user in station.users:
            _check_route_user(index, user, report, folder)


def _check_route_user(index: Index, user: UserSection, report: FindingReport, folder: Path) -> None:
    """Report a user that may add routes and has neither a file nor a password in the plant."""
    if user.password_file:
        check_file(f"{user.at}.password_file", user.password_file, report, folder)
        return
    known = {each.name: each for each in index.plant.users}
    found = known.get(user.name)
    expected = "password_file, or an engineer of the plant's users with a password"
    if found is None:
        message = f"user {user.name} is none of the plant's users{suggest(user.name, known)}"
        report.add(user.at, message, expected)
    elif found.role is not Role.ENGINEER or not found.password:
        lack = "no password" if found.role is Role.ENGINEER else f"the role {found.role}"
        report.add(user.at, f"user {user.name} has {lack}", expected)


def _check_rule(
    index: Index,
    station: StationSection,
    access: AccessSection,
    shared: set[str],
    report: FindingReport,
) -> bool:
    """Report the errors of a rule; return whether it can be compared with other rules."""
    is_fine = True

    def try_all(key: str, texts: tuple[str, ...], parse: Callable[[str], object]) -> None:
        nonlocal is_fine
        for position, text in enumerate(texts):
            try:
                parse(text)
            except SectionError as exc:
                report.add(f"{access.at}.{key}[{position}]", f"{key}: {exc}", exc.expected)
                is_fine = False
            except ValueError:
                is_fine = False  # a NetID that is a finding of its own

    if report.has(f"{access.at}.allow") or report.has(f"{access.at}.deny"):
        is_fine = False
    elif bool(access.allow) == bool(access.deny):
        message = (
            "access rule has both allow and deny"
            if access.allow
            else "access rule has neither allow nor deny"
        )
        report.add(access.at, message, "allow or deny with what it is about, such as allow: [read]")
        is_fine = False
    key = "allow" if access.allow else "deny"
    allows = bool(access.allow)
    texts = access.allow or access.deny
    try_all(key, texts, lambda text: parse_services((text,), allows=allows))
    try_all("from", access.networks, parse_sender)
    try_all("net_ids", access.net_ids, lambda text: parse_source(index, text, shared))
    try_all("to", access.to, lambda text: parse_target(index, text, shared))
    try_all("objects", access.objects, parse_objects)
    if access.roles and not index.plant.users:
        message = "roles: the plant has no users"
        report.add(f"{access.at}.roles", message, "users at the top level, or no such key")
        is_fine = False
    known = _transports(station)
    if access.transports and access.doors:
        message = "access rule has both transports and doors"
        report.add(access.at, message, "transports alone; doors is its former name")
        is_fine = False
    key = "transports" if access.transports else "doors"
    try_all(key, access.transports or access.doors, lambda text: _check_transport(text, known))
    return is_fine


def _transports(station: StationSection) -> list[str]:
    """Return all that ``transports`` may name at *station*."""
    found = [*map(str, TransportKind)]
    transports = [
        f"{kind}:{name}" for name in station.eap_ports for kind in ("udp", "tcp", "ethernet")
    ]
    return [*found, *transports, *(f"mqtt:{route.network}" for route in brokers_of(station))]


def _check_transport(text: str, known: list[str]) -> None:
    # Any certificate of an authority that the station trusts may name its client.
    is_client = text.startswith(_CLIENT) and text != _CLIENT
    if text not in known and not is_client:
        expected = (
            f"{one_of(TransportKind)}, or one transport such as udp:PORT, mqtt:NETWORK or"
            " ams-tls:CLIENT"
        )
        raise SectionError("", f"no transport {text!r}{suggest(text, known)}", expected)


def _check_order(
    index: Index, station: StationSection, shared: set[str], report: FindingReport
) -> None:
    """Report rules that never match a request."""
    before: list[tuple[AccessSection, AccessRule]] = []
    try:
        rules = list(access_rules(index, station, shared))
    except ValueError:
        return  # a finding of its own
    for access, rule in zip(station.access, rules, strict=True):
        if reason := _reason_never_matching(rule):
            report.add(access.at, f"access rule never matches: {reason}", "a rule that can match")
        # The first rule that matches decides, so a rule inside an earlier one has no effect.
        for earlier, other in before:
            if _covers(other, rule):
                line = report.line_of(earlier.at)
                message = f"access rule never applies: the rule in line {line} matches before it"
                report.add(access.at, message, "this rule before that one, or no such rule")
                break
        before.append((access, rule))


def _reason_never_matching(rule: AccessRule) -> str:
    # Only IP transports know the network of a client, and only Ethernet its MAC address.
    kinds = {_kind(transport) for transport in rule.transports}
    is_known = kinds.isdisjoint(IP_TRANSPORTS) if rule.networks else bool(rule.macs)
    if kinds and is_known and not (rule.macs and TransportKind.ETHERNET in kinds):
        return f"clients of {', '.join(rule.transports)} have no such address"
    if rule.objects and rule.services and _OBJECT_SERVICES.isdisjoint(rule.services):
        return f"{', '.join(rule.services)} does not access objects"
    return ""


def _covers(one: AccessRule, other: AccessRule) -> bool:
    """Return whether *one* matches every request that *other* matches."""
    return (
        _covers_senders(one, other)
        and _all_in(one.roles, other.roles, lambda outer, inner: outer is inner)
        and _all_in(one.net_ids, other.net_ids, _is_prefix)
        and _all_in(
            one.transports, other.transports, lambda outer, inner: outer in {inner, _kind(inner)}
        )
        and _all_in(
            one.targets,
            other.targets,
            lambda outer, inner: (
                _is_prefix(outer.net_id, inner.net_id) and outer.port in {None, inner.port}
            ),
        )
        and _all_in(one.services, other.services, lambda outer, inner: outer == inner)
        and _all_in(one.objects, other.objects, ObjectRange.contains)
    )


def _covers_senders(one: AccessRule, other: AccessRule) -> bool:
    if not (one.networks or one.macs):
        return True
    by_address = not other.networks or _within(one.networks, other.networks, _in_network)
    is_any = not (other.networks or other.macs)
    return not is_any and by_address and set(other.macs) <= set(one.macs)


def _within(outer: tuple[T, ...], inner: tuple[T, ...], is_in: Callable[[T, T], bool]) -> bool:
    return all(any(is_in(each, item) for each in outer) for item in inner)


def _all_in(outer: tuple[T, ...], inner: tuple[T, ...], is_in: Callable[[T, T], bool]) -> bool:
    """Return whether each of *inner* is in one of *outer*; an empty list stands for everything."""
    if not outer:
        return True
    # An empty inner list matches everything, so no list that names something can cover it.
    return bool(inner) and _within(outer, inner, is_in)


def _in_network(outer: str, inner: str) -> bool:
    return IPv4Network(inner).subnet_of(IPv4Network(outer))


def _is_prefix(outer: str, inner: str) -> bool:
    # With the final dot: 5.23.91.2 is no prefix of 5.23.91.23.
    return f"{inner}.".startswith(f"{outer}.")


def _kind(transport: str) -> str:
    return transport.partition(":")[0]
