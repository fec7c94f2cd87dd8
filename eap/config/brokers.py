"""MQTT brokers of a plant file, auto-discovery of routes, and their checks."""

from __future__ import annotations

from ipaddress import IPv4Network
from pathlib import Path
from typing import NamedTuple

from eap.ams.mqtt.messages import check_network
from eap.ams.spec import MqttSpec, TlsSpec, TransportKind
from eap.config.bridge_sections import MqttSection
from eap.config.files import check_file, whole_path
from eap.config.finding import FindingReport, PlantFinding
from eap.config.index import Index
from eap.config.structs import RouteSection, StationSection, TlsSection
from eap.ids import parse_host
from eap.suggest import suggest

URL = "mqtt://HOST[:PORT], or mqtts:// with TLS"
_PORTS = {"mqtt": 1883, "mqtts": 8883}


class Broker(NamedTuple):
    """Address of a broker."""

    host: str
    port: int
    needs_tls: bool
    """True if the URL requires TLS, with or without a ``tls`` section."""


def parse_url(text: str) -> Broker:
    """Read the URL of a broker; raise ValueError if it is invalid."""
    # A user in the URL is refused below: passwords stay in files of their own.
    scheme, separator, rest = text.partition("://")
    if not separator or scheme not in _PORTS:
        raise ValueError(f"{text!r} is no broker")
    if "@" in rest or "/" in rest:
        raise ValueError(f"{text!r} has more than a host and a port")
    host, port = parse_host(rest, _PORTS[scheme])
    return Broker(host, port, scheme == "mqtts")


def brokers_of(station: StationSection) -> list[RouteSection]:
    """Return the entries of *station* that name a broker."""
    return [route for route in station.routes if route.mqtt]


def find_network(station: StationSection, network: str) -> RouteSection | None:
    """Return the entry by which *station* is in *network*."""
    return next((each for each in brokers_of(station) if each.network == network), None)


def shared_network(station: StationSection, other: StationSection) -> str:
    """Return the network by which two stations reach each other, empty if there is none.

    A network is the same if its name is: stations may know a broker, or the brokers of a cluster,
    by different addresses.
    """
    for each in brokers_of(station):
        if each.network and find_network(other, each.network) is not None:
            return each.network
    return ""


def broker_spec(route: RouteSection, folder: Path) -> MqttSpec:
    """Return the specification of the broker of *route* for services; its files are in *folder*."""
    broker = parse_url(route.mqtt)
    # mqtts:// alone means TLS with the certificate authorities of this host.
    tls = route.tls or (TlsSection() if broker.needs_tls else None)
    return MqttSpec(
        network=route.network,
        host=broker.host,
        port=broker.port,
        user=route.user,
        password_file=whole_path(folder, route.password_file),
        tls=None if tls is None else _tls(tls, folder),
        client_id=route.client_id,
        no_retain=route.no_retain,
        is_unidirectional=route.unidirectional,
        qos=route.qos,
        is_prefixed=route.prefix,
    )


def _tls(tls: TlsSection, folder: Path) -> TlsSpec:
    return TlsSpec(
        ca=whole_path(folder, tls.ca),
        certificate=whole_path(folder, tls.certificate),
        key=whole_path(folder, tls.key),
        check_name=tls.check_name,
    )


_NETWORK = "one level of a topic: up to 128 characters, no spaces, no / + #, and no $ in front"
_MAX_CLIENT_ID = 65_535


def check_brokers(index: Index, report: FindingReport, folder: Path) -> None:
    """Report every invalid broker; files are in *folder*."""
    client_ids: dict[tuple[Broker, str], RouteSection] = {}
    for station in index.plant.stations:
        _check_networks(station, report)
        for route in brokers_of(station):
            broker = _check_url(route, report)
            check_credentials(route, report, folder)
            if broker is not None and route.client_id:
                first = client_ids.setdefault((broker, route.client_id), route)
                if first is not route:
                    line = report.line_of(f"{first.at}.client_id")
                    message = f"client_id {route.client_id!r} is used twice (first in line {line})"
                    expected = (
                        "one of its own, or none: a broker disconnects the first client with it"
                    )
                    report.add(f"{route.at}.client_id", message, expected)


def _check_url(route: RouteSection, report: FindingReport) -> Broker | None:
    path = f"{route.at}.mqtt"
    try:
        broker = parse_url(route.mqtt)
    except ValueError as exc:
        report.add(path, f"mqtt: {exc}", URL)
        return None
    if len(route.client_id.encode()) > _MAX_CLIENT_ID:
        message = "client_id is too long"
        report.add(f"{route.at}.client_id", message, f"at most {_MAX_CLIENT_ID} bytes")
    return broker


def _check_networks(station: StationSection, report: FindingReport) -> None:
    first: dict[str, RouteSection] = {}
    for route in brokers_of(station):
        path = f"{route.at}.network"
        if not route.network:
            report.add(route.at, f"broker {route.mqtt} has no network", _NETWORK)
        elif not _is_network(route.network):
            report.add(path, f"network {route.network!r}", _NETWORK)
        elif route.network in first:
            line = report.line_of(f"{first[route.network].at}.network")
            message = f"station {station.name} is in network {route.network!r} already"
            report.add(path, f"{message} (line {line})", "each network once")
        else:
            first[route.network] = route


def _is_network(name: str) -> bool:
    try:
        check_network(name)
    except ValueError:
        return False
    return not any(each == "/" or each.isspace() for each in name)


def check_credentials(
    route: RouteSection | MqttSection, report: FindingReport, folder: Path
) -> None:
    """Report an invalid login or TLS section of a client of a broker; files are in *folder*."""
    if route.password_file and not route.user:
        report.add(f"{route.at}.password_file", "a password without a user", "user: as well")
    check_file(f"{route.at}.password_file", route.password_file, report, folder)
    if route.tls is None:
        return
    at = f"{route.at}.tls"
    for name in TlsSection.ROUTE_KEYS:
        if getattr(route.tls, name):
            report.add(f"{at}.{name}", f"{name} does not belong to a broker", "ca, and certificate")
    for key, file in (
        ("ca", route.tls.ca),
        ("certificate", route.tls.certificate),
        ("key", route.tls.key),
    ):
        check_file(f"{at}.{key}", file, report, folder)
    if route.tls.key and not route.tls.certificate:
        report.add(f"{at}.key", "a key without a certificate", "certificate: as well")


HOST = "an IPv4 address or a host name, and :PORT if it is not the usual one"


_MQTT = f"{TransportKind.MQTT}:"
_SOURCES = "mqtt:NETWORK of a broker of the station, or an IPv4 address or network"


def discovery_sources(station: StationSection) -> bool | tuple[str, ...]:
    """Return the sources of auto-discovered routes of *station*, which has no findings."""
    if isinstance(station.learn, bool):
        return station.learn
    return tuple(_parse(station, text) for text in station.learn)


def check_discovery(index: Index, report: FindingReport) -> None:
    """Report every invalid source of auto-discovered routes."""
    for station in index.plant.stations:
        if isinstance(station.learn, bool):
            continue
        for position, text in enumerate(station.learn):
            try:
                _parse(station, text)
            except ValueError as exc:
                report.add(f"{station.at}.learn[{position}]", f"learn: {exc}", _SOURCES)


def warn_of_open_brokers(index: Index, report: FindingReport) -> tuple[PlantFinding, ...]:
    """Return a warning for each broker that announces routes without authenticating its clients.

    There is none for a station that names the network in ``learn``.
    """
    found = []
    for station in index.plant.stations:
        # Naming the network in `learn` says that its clients are trusted, and silences the warning.
        for route in brokers_of(station) if station.learn is True else ():
            if _is_anonymous(route):
                message = (
                    f"station {station.name} learns routes from any client of {route.mqtt}: the"
                    " broker requires no user"
                )
                expected = f"learn: [mqtt:{route.network}] if that is meant, else learn: false"
                line = report.line_of(f"{route.at}.mqtt")
                found.append(PlantFinding(report.file, line, route.at, message, expected))
    return tuple(found)


def _is_anonymous(route: RouteSection) -> bool:
    """Return whether a station connects to its broker with neither a user nor a certificate."""
    return not route.user and (route.tls is None or not route.tls.certificate)


def _parse(station: StationSection, text: str) -> str:
    """Return a source in its usual form; raise ValueError if it is invalid."""
    if not text.startswith(_MQTT):
        try:
            return str(IPv4Network(text, strict=False))
        except ValueError:
            raise ValueError(f"{text!r} is no network of a broker and no IPv4 network") from None
    network = text.removeprefix(_MQTT)
    if find_network(station, network) is None:
        known = [route.network for route in brokers_of(station)]
        raise ValueError(f"the station is in no network {network!r}{suggest(network, known)}")
    return text
