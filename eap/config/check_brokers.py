"""Checks of MQTT brokers: their addresses, the networks they carry, and the files they need."""

from __future__ import annotations

from pathlib import Path

from eap.aoe.mqtt_topics import check_network
from eap.config.brokers import URL, Broker, brokers_of, parse_url
from eap.config.finding import Report
from eap.config.hosts import why_unreadable
from eap.config.index import Index
from eap.config.structs import Route, Station

_NETWORK = "one level of a topic: up to 128 characters, no spaces, no / + #, and no $ in front"
_FILE = "a file, its path from the plant file on"
_MAX_CLIENT_ID = 65_535


def check_brokers(index: Index, report: Report, folder: Path) -> None:
    """Report every broker that cannot be as it is; files are in *folder*."""
    client_ids: dict[tuple[Broker, str], Route] = {}
    for station in index.plant.stations:
        _check_networks(station, report)
        for route in brokers_of(station):
            broker = _check_url(route, report)
            _check_secrets(route, report, folder)
            if broker is not None and route.client_id:
                first = client_ids.setdefault((broker, route.client_id), route)
                if first is not route:
                    line = report.line_of(f"{first.at}.client_id")
                    message = f"client_id {route.client_id!r} is used twice (first in line {line})"
                    expected = "one of its own: a broker drops who had it before, or none"
                    report.add(f"{route.at}.client_id", message, expected)


def _check_url(route: Route, report: Report) -> Broker | None:
    path = f"{route.at}.mqtt"
    try:
        broker = parse_url(route.mqtt)
    except ValueError as exc:
        report.add(path, f"mqtt: {exc}", URL)
        return None
    if len(route.client_id.encode()) > _MAX_CLIENT_ID:
        message = "client_id is too long"
        report.add(f"{route.at}.client_id", message, f"at most {_MAX_CLIENT_ID} octets")
    return broker


def _check_networks(station: Station, report: Report) -> None:
    first: dict[str, Route] = {}
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


def _check_secrets(route: Route, report: Report, folder: Path) -> None:
    if route.password_file and not route.user:
        report.add(f"{route.at}.password_file", "a password without a user", "user: as well")
    check_file(f"{route.at}.password_file", route.password_file, report, folder)
    if route.tls is None:
        return
    at = f"{route.at}.tls"
    for key, file in (
        ("ca", route.tls.ca),
        ("certificate", route.tls.certificate),
        ("key", route.tls.key),
    ):
        check_file(f"{at}.{key}", file, report, folder)
    if route.tls.key and not route.tls.certificate:
        report.add(f"{at}.key", "a key without a certificate", "certificate: as well")


def check_file(path: str, file: str, report: Report, folder: Path) -> None:
    """Report *file*, named at *path*, if it is given and cannot be read."""
    if file and (reason := why_unreadable(folder / file)):
        report.add(path, f"{file}: {reason}", _FILE)
