"""Places that a plant file leaves open to other hosts, for ``eapctl check --security``.

Each rule is one generator: it yields places that are reachable from other hosts and that nothing in
the file protects.  A plant that only loopback addresses serve has nothing to report but its audit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from ipaddress import IPv4Address
from pathlib import Path

import msgspec

from eap.ams.spec import AccessService, TransportKind
from eap.config.access import ALL, parse_services, rule_name
from eap.config.bridge_sections import FieldServerSection, ModbusSection, MqttSection, S7Section
from eap.config.brokers import brokers_of, parse_url
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.listen import parse_listen
from eap.config.opcua_sections import ChannelSecurity, ClientTrust
from eap.config.structs import (
    ANY_SOURCE,
    AccessSection,
    AuditMode,
    PortSection,
    RouteSection,
    StationSection,
)
from eap.ids import InterfaceUri
from eap.pd.spec import Authentication, PortKind


class Exposure(msgspec.Struct, frozen=True):
    """Place that is open to other hosts, and its remedy; *requirement* is of IEC 62443-4-2."""

    file: str
    line: int
    """From 1; 0 for what the file does not say."""
    requirement: str
    message: str
    remedy: str

    def __str__(self) -> str:
        place = f"{self.file}:{self.line}" if self.line else self.file
        return f"{place}: {self.message}; {self.remedy} ({self.requirement})"


_FORGEABLE = {TransportKind.UDP, TransportKind.ETHERNET}

Found = tuple[str, str, str, str]
"""Path in the file, requirement, message and remedy."""


def find_exposures(index: Index, report: FindingReport, folder: Path) -> tuple[Exposure, ...]:
    """Return what a valid plant leaves open, in the order of the file."""
    found = [
        Exposure(report.file, report.line_of(path), requirement, message, remedy)
        for rule in _RULES
        for path, requirement, message, remedy in rule(index)
    ]
    found += [
        Exposure(report.file, report.line_of(path), "CR 1.5", message, "chmod 600")
        for path, message in _readable_files(index, folder)
    ]
    # Several rules may find the same place: it is shown once.
    return tuple(sorted(dict.fromkeys(found), key=lambda each: each.line))


def _audit(index: Index) -> Iterator[Found]:
    if index.plant.access.audit is not AuditMode.REQUIRED:
        yield (
            "access.audit",
            "CR 2.10",
            "changes that cannot be recorded are made all the same",
            "access: {audit: required}",
        )


def _reading(index: Index) -> Iterator[Found]:
    """Other hosts read everything unless a rule denies it."""
    for station in index.plant.stations:
        ports = [port.name for port in station.ports if port.ams and _is_reached(port)]
        if ports and not any(_denies_the_rest(rule) for rule in station.access):
            yield (
                f"{station.at}.access",
                "CR 2.1",
                (
                    f"{station.name} lets every host that reaches {', '.join(ports)} read all"
                    " variables, objects and files"
                ),
                "end its access rules with {deny: [all], transports: [...]}, and allow before it",
            )


def _writing(index: Index) -> Iterator[Found]:
    """Rules that let hosts write by what any sender can claim."""
    for station in index.plant.stations:
        for number, rule in enumerate(station.access):
            # A rule that denies lets nothing through.
            services = set(parse_services(rule.allow, allows=True)) if rule.allow else set()
            writes = ALL in rule.allow or services - {AccessService.READ}
            if rule.allow and writes and not (rule.networks or rule.roles):
                by = "of every host" if not rule.net_ids else "by its source NetID alone"
                yield (
                    rule.at,
                    "CR 2.1",
                    (
                        f"rule {rule_name(rule, number)} of {station.name} lets writing requests"
                        f" through {by}"
                    ),
                    "from: the hosts that write",
                )


def _datagrams(index: Index) -> Iterator[Found]:
    """Rules that let hosts write by datagrams and frames, which prove no sender."""
    for station in index.plant.stations:
        if not any(_is_reached(port) for port in station.ports):
            continue
        for number, rule in enumerate(station.access):
            allowed = parse_services(rule.allow, allows=True) if rule.allow else ()
            writes = ALL in rule.allow or set(allowed) - {AccessService.READ}
            kinds = {each.partition(":")[0] for each in rule.transports or rule.doors}
            is_known = bool(rule.networks or rule.roles)
            if writes and is_known and (not kinds or kinds & _FORGEABLE):
                yield (
                    rule.at,
                    "CR 2.1",
                    (
                        f"rule {rule_name(rule, number)} of {station.name} lets writing requests"
                        " through by datagrams: any host can send them with another's address"
                    ),
                    "transports: [ams-tcp, tcp], or a network in which no host forges addresses",
                )


def _gateways(index: Index) -> Iterator[Found]:
    for station in index.plant.stations:
        is_reached = any(_is_reached(port) for port in station.ports if port.kind is PortKind.EAP)
        for port in station.ports:
            is_open = port.kind is PortKind.BUS and port.gateway.enabled and is_reached
            if is_open and not any(_denies_the_rest(rule) for rule in station.access):
                yield (
                    f"{port.at}.gateway",
                    "CR 2.1",
                    (
                        f"the mailbox gateway of {station.name}/{port.name} lets every host read"
                        " objects and files of its slaves"
                    ),
                    "a deny rule, or gateway: {enabled: false}",
                )


def _signatures(index: Index) -> Iterator[Found]:
    for station in index.plant.stations:
        ports = {port.name for port in station.ports if _is_reached(port)}
        received = [each for each in station.subscribe if each.port in ports]
        for subscription in received:
            if subscription.sender == ANY_SOURCE:
                yield (
                    f"{subscription.at}.source",
                    "CR 3.1",
                    f"{station.name} takes {subscription.name} from any address",
                    "source: the address of its publisher",
                )
        unsigned = [each for each in received if each.auth is not Authentication.REQUIRED]
        if unsigned:
            names = ", ".join(each.name for each in unsigned[:3])
            more = f" and {len(unsigned) - 3} more" if len(unsigned) > 3 else ""
            yield (
                unsigned[0].at,
                "CR 3.1 RE 1",
                (
                    f"{station.name} takes {names}{more} without a signature: a sender that forges"
                    " the publisher's address is believed"
                ),
                (
                    "auth: required, where the publisher is one of this software; else a network of"
                    " their own, MACsec or WireGuard"
                ),
            )


def _routes(index: Index) -> Iterator[Found]:
    for station in index.plant.stations:
        is_reached = any(port.ams and _is_reached(port) for port in station.ports)
        if station.learn is True and (is_reached or list(brokers_of(station))):
            yield (
                f"{station.at}.learn",
                "CR 1.2",
                f"{station.name} learns routes from every router that answers or announces itself",
                "learn: false, or learn: the networks to learn from",
            )
        if station.users and is_reached:
            yield (
                f"{station.at}.users",
                "CR 1.5",
                (
                    f"other hosts add routes to {station.name} by a password that crosses the"
                    " network unencrypted (UDP 48899)"
                ),
                "remove users, and write the routes into the plant file",
            )


def _interfaces(index: Index) -> Iterator[Found]:
    for station in index.plant.stations:
        for port in station.ports:
            uri = index.uris.get((station.name, port.name))
            if uri and uri.scheme in {"udp", "tcp"} and IPv4Address(uri.host).is_unspecified:
                yield (
                    f"{port.at}.interface",
                    "CR 5.1",
                    f"{station.name}/{port.name} serves all networks of the host",
                    "an interface with the address of one of them",
                )


def _brokers(index: Index) -> Iterator[Found]:
    for station in index.plant.stations:
        for route in brokers_of(station):
            what = f"{station.name}'s broker {route.mqtt}"
            yield from _broker(what, f"{route.at}.mqtt", route, route.mqtt)
    mqtt = index.plant.mqtt
    if mqtt is not None and "://" in mqtt.broker:
        what = f"the broker of values {mqtt.broker}"
        yield from _broker(what, f"{mqtt.at}.broker", mqtt, mqtt.broker)


def _broker(what: str, at: str, client: RouteSection | MqttSection, url: str) -> Iterator[Found]:
    tls = client.tls
    if not client.user and (tls is None or not tls.certificate):
        yield at, "CR 1.2", f"{what} requires no login", "user and password_file, or a certificate"
    broker = parse_url(url)
    if tls is None and not broker.needs_tls and not _is_loopback(broker.host):
        yield at, "CR 4.1", f"{what} is reached without encryption", "tls: {ca: ...}"


def _servers(index: Index) -> Iterator[Found]:
    opcua = index.plant.opcua
    if opcua is not None and not parse_listen(opcua.listen).is_loopback:
        if ChannelSecurity.NONE in opcua.security:
            yield (
                f"{opcua.at}.security",
                "CR 4.1",
                "the OPC UA server takes channels that are neither signed nor encrypted",
                "remove None from security",
            )
        if opcua.anonymous is not None:
            yield (
                f"{opcua.at}.anonymous",
                "CR 1.1",
                f"OPC UA clients without a login are {opcua.anonymous}",
                "remove anonymous, and give them users",
            )
        if opcua.clients is ClientTrust.ANY:
            yield (
                f"{opcua.at}.clients",
                "CR 1.9",
                "OPC UA clients need no certificate that is known",
                "clients: trusted",
            )
    for section in (index.plant.web, index.plant.metrics):
        if section is None or parse_listen(section.listen).is_loopback:
            continue
        if section.anonymous is not None:
            yield (
                f"{section.at}.anonymous",
                "CR 1.1",
                f"browsers without a login are {section.anonymous}",
                "remove anonymous, and give them users",
            )
    yield from _field_servers(index)


def _field_servers(index: Index) -> Iterator[Found]:
    sections: tuple[S7Section | ModbusSection | None, ...] = (index.plant.s7, index.plant.modbus)
    for section, name in zip(sections, ("S7", "Modbus"), strict=True):
        server: FieldServerSection | None = None if section is None else section.server
        if server is not None and not parse_listen(server.listen).is_loopback:
            yield (
                server.at,
                "CR 1.1",
                (
                    f"the {name} server is reached by every host: the protocol has neither login"
                    " nor encryption"
                ),
                "a firewall that lets the panels through, or listen: 127.0.0.1",
            )


_RULES: tuple[Callable[[Index], Iterable[Found]], ...] = (
    _audit,
    _reading,
    _writing,
    _datagrams,
    _gateways,
    _signatures,
    _routes,
    _interfaces,
    _brokers,
    _servers,
)


def _readable_files(index: Index, folder: Path) -> Iterator[tuple[str, str]]:
    """Yield the files with passwords and keys that other users of the host may read."""
    for path, name in _secret_files(index):
        if not name:
            continue
        try:
            mode = (folder / name).stat().st_mode
        except (OSError, ValueError):
            continue  # an error of the file, or of another host
        if mode & 0o077:
            yield path, f"others of this host may read {name}"


def _secret_files(index: Index) -> Iterator[tuple[str, str]]:
    for station in index.plant.stations:
        yield from _station_secrets(station)
    mqtt = index.plant.mqtt
    if mqtt is not None and mqtt.password_file:
        yield f"{mqtt.at}.password_file", mqtt.password_file
    for section in (index.plant.web, index.plant.metrics):
        if section is not None and section.tls is not None:
            yield f"{section.at}.tls.key", section.tls.key


def _station_secrets(station: StationSection) -> Iterator[tuple[str, str]]:
    """Yield the files with secrets of a station; some have no name."""
    for user in station.users:
        yield f"{user.at}.password_file", user.password_file
    secure = station.secure_ads
    if secure is not None:
        yield f"{secure.at}.key", secure.key
        yield from ((f"{secure.at}.psk.{name}", file) for name, file in secure.psk.items())
    for route in station.routes:
        yield f"{route.at}.password_file", route.password_file
        if route.tls is not None:
            yield f"{route.at}.tls.key", route.tls.key
            yield f"{route.at}.tls.password_file", route.tls.password_file


def _is_reached(port: PortSection) -> bool:
    """Return whether other hosts reach an EAP port."""
    if port.kind is not PortKind.EAP:
        return False
    try:
        uri = InterfaceUri.parse(port.interface)
    except ValueError:
        return False
    return uri.scheme != "loop" and (uri.scheme == "ethernet" or not _is_loopback(uri.host))


def _is_loopback(host: str) -> bool:
    try:
        return IPv4Address(host).is_loopback
    except ValueError:
        return host in {"localhost", "::1"}


def _denies_the_rest(rule: AccessSection) -> bool:
    """Return whether a rule denies everything to all that no rule before it let through."""
    # Only a rule for every client is the last word.
    is_general = not (rule.networks or rule.net_ids or rule.to or rule.objects or rule.roles)
    return is_general and ALL in rule.deny
