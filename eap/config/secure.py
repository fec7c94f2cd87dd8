"""Secure ADS of a plant file: specifications of stations and routes, and their checks."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

from eap.ams.spec import PskSpec, SecureAdsSpec, SecurePeer, SecureRouteSpec
from eap.codec.tlshandshake import parse_fingerprint
from eap.config.files import check_file, whole_path
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.structs import RouteSection, SecureAdsSection, StationSection, TlsSection

_FINGERPRINT = "that of 'openssl x509 -in FILE -noout -fingerprint -sha256'"
_NAME = "a name of up to 64 characters without colons"
_MAX_NAME = 64
_PSK_FROM = (3, 13)
PSK_MISSING = "this Python ({}.{}) has no pre-shared keys"


def secure_ads_spec(section: SecureAdsSection | None, folder: Path) -> SecureAdsSpec | None:
    """Return Secure ADS of a station without findings; its files are in *folder*."""
    if section is None:
        return None
    return SecureAdsSpec(
        certificate=whole_path(folder, section.certificate),
        key=whole_path(folder, section.key),
        ca=whole_path(folder, section.ca),
        peers=tuple(
            SecurePeer(name, parse_fingerprint(text)) for name, text in section.peers.items()
        ),
        psk=tuple(PskSpec(name, whole_path(folder, file)) for name, file in section.psk.items()),
        port=section.port,
    )


def secure_route_spec(tls: TlsSection | None, folder: Path) -> SecureRouteSpec | None:
    """Return TLS of a route without findings; its files are in *folder*."""
    if tls is None:
        return None
    return SecureRouteSpec(
        fingerprint=parse_fingerprint(tls.fingerprint) if tls.fingerprint else "",
        psk=PskSpec(tls.identity, whole_path(folder, tls.password_file)) if tls.identity else None,
        ca=whole_path(folder, tls.ca),
        certificate=whole_path(folder, tls.certificate),
        key=whole_path(folder, tls.key),
        check_name=tls.check_name,
    )


def check_secure_ads(index: Index, report: FindingReport, folder: Path) -> None:
    """Report what is invalid about Secure ADS of stations and routes; files are in *folder*."""
    for station in index.plant.stations:
        if station.secure_ads is not None:
            _check_station(station.secure_ads, report, folder)
        for route in station.routes:
            if route.tls is not None and not route.mqtt:
                _check_route(station, route, route.tls, report, folder)
    _check_addresses(index, report)


def _check_station(section: SecureAdsSection, report: FindingReport, folder: Path) -> None:
    at = section.at
    for key, file in (("certificate", section.certificate), ("key", section.key)):
        if not file:
            report.add(f"{at}.{key}", f"{key} is empty", "a PEM file")
    _check_files(at, section, report, folder)
    for name, text in section.peers.items():
        path = f"{at}.peers.{name}"
        if not _is_name(name):
            report.add(path, f"peer {name!r}", _NAME)
        _check_fingerprint(path, text, report)
    for name, file in section.psk.items():
        path = f"{at}.psk.{name}"
        if not _is_name(name):
            report.add(path, f"identity {name!r}", _NAME)
        elif name in section.peers:
            report.add(path, f"{name!r} is a peer with a fingerprint already", "another identity")
        check_file(path, file, report, folder)
    if section.psk:
        _check_psk(f"{at}.psk", report)


def _check_files(
    at: str, section: SecureAdsSection | TlsSection, report: FindingReport, folder: Path
) -> None:
    for key, file in (
        ("ca", section.ca),
        ("certificate", section.certificate),
        ("key", section.key),
    ):
        check_file(f"{at}.{key}", file, report, folder)


def _check_fingerprint(path: str, text: str, report: FindingReport) -> None:
    try:
        parse_fingerprint(text)
    except ValueError as exc:
        report.add(path, str(exc), _FINGERPRINT)


def _check_psk(path: str, report: FindingReport) -> None:
    if sys.version_info < _PSK_FROM:
        message = PSK_MISSING.format(*sys.version_info)
        report.add(path, message, "Python 3.13 or newer, or certificates")


def _is_name(text: str) -> bool:
    return 0 < len(text) <= _MAX_NAME and text.isprintable() and ":" not in text


def _check_route(
    station: StationSection,
    route: RouteSection,
    tls: TlsSection,
    report: FindingReport,
    folder: Path,
) -> None:
    at = f"{route.at}.tls"
    if not route.ams_tcp:
        report.add(at, f"route {route.to!r} has tls without ams_tcp", "ams_tcp: HOST as well")
    _check_files(at, tls, report, folder)
    check_file(f"{at}.password_file", tls.password_file, report, folder)
    if tls.fingerprint:
        _check_fingerprint(f"{at}.fingerprint", tls.fingerprint, report)
    if bool(tls.identity) != bool(tls.password_file):
        report.add(at, "identity and password_file belong together", "both of them")
    if tls.identity:
        _check_psk(f"{at}.identity", report)
        if tls.fingerprint:
            report.add(at, "tls has identity and fingerprint", "one of the two")
        return
    own = station.secure_ads
    if bool(tls.certificate) != bool(tls.key):
        report.add(at, "certificate and key belong together", "both of them")
    elif not tls.certificate and own is None:
        message = f"route {route.to!r} shows no certificate, which the far end wants"
        report.add(at, message, "certificate and key, or secure_ads of the station")
    if not (tls.fingerprint or tls.ca or (own is not None and own.ca)):
        message = f"route {route.to!r} trusts nobody"
        report.add(at, message, "fingerprint, ca or identity; or ca in secure_ads of the station")


def _check_addresses(index: Index, report: FindingReport) -> None:
    """Report stations that would listen at one address and port."""
    first: dict[tuple[str, int], StationSection] = {}
    for station, section, address in _listeners(index):
        key = address, section.port
        other = first.setdefault(key, station)
        if other is not station and not index.are_apart(station.name, other.name):
            message = (
                f"Secure ADS of {station.name} and {other.name} is at {address}:{section.port}"
            )
            report.add(section.at, message, "port: a number of its own for each of them")


def _listeners(index: Index) -> Iterator[tuple[StationSection, SecureAdsSection, str]]:
    for station in index.plant.stations:
        section = station.secure_ads
        if section is None or not section.port:
            continue
        for port in station.ports:
            uri = index.uris.get((station.name, port.name))
            if uri is not None and port.ams and uri.scheme in {"udp", "tcp"}:
                yield station, section, uri.host
