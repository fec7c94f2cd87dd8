"""From where the routers of a plant learn routes: the key ``learn`` of a station."""

from __future__ import annotations

from ipaddress import IPv4Network

from eap.aoe.spec import DoorKind
from eap.config.brokers import brokers_of, find_network
from eap.config.finding import Finding, Report
from eap.config.index import Index
from eap.config.structs import Route, Station
from eap.near import near

_MQTT = f"{DoorKind.MQTT}:"
_SOURCES = "mqtt:NETWORK of a broker of the station, or an IPv4 address or network"


def learn_sources(station: Station) -> bool | tuple[str, ...]:
    """Return from where *station*, which has no findings, learns routes."""
    if isinstance(station.learn, bool):
        return station.learn
    return tuple(_parse(station, text) for text in station.learn)


def check_learning(index: Index, report: Report) -> None:
    """Report every source of learned routes that is none."""
    for station in index.plant.stations:
        if isinstance(station.learn, bool):
            continue
        for position, text in enumerate(station.learn):
            try:
                _parse(station, text)
            except ValueError as exc:
                report.add(f"{station.at}.learn[{position}]", f"learn: {exc}", _SOURCES)


def warn_of_open_brokers(index: Index, report: Report) -> tuple[Finding, ...]:
    """Return a warning for each broker that teaches routes without knowing its clients.

    A station that names the network in ``learn`` wants that.
    """
    found = []
    for station in index.plant.stations:
        for route in brokers_of(station) if station.learn is True else ():
            if _is_anonymous(route):
                message = (
                    f"station {station.name} learns routes from anybody at {route.mqtt}: the"
                    " broker asks for no user"
                )
                expected = f"learn: [mqtt:{route.network}] if that is meant, else learn: false"
                line = report.line_of(f"{route.at}.mqtt")
                found.append(Finding(report.file, line, route.at, message, expected))
    return tuple(found)


def _is_anonymous(route: Route) -> bool:
    """Say whether a station shows its broker neither a user nor a certificate."""
    return not route.user and (route.tls is None or not route.tls.certificate)


def _parse(station: Station, text: str) -> str:
    """Return a source in its usual form; raise ValueError if it is none."""
    if not text.startswith(_MQTT):
        try:
            return str(IPv4Network(text, strict=False))
        except ValueError:
            raise ValueError(f"{text!r} is no network of a broker and no IPv4 network") from None
    network = text.removeprefix(_MQTT)
    if find_network(station, network) is None:
        known = [route.network for route in brokers_of(station)]
        raise ValueError(f"the station is in no network {network!r}{near(network, known)}")
    return text
