"""Checks of mailbox gateways: whom their addresses stand for, and where they are served."""

from __future__ import annotations

from collections.abc import Iterator

from eap.codec.amstcp import AMS_TCP_PORT
from eap.codec.ethercat import EAP_PORT
from eap.config.finding import Report
from eap.config.gateways import (
    ADDRESS,
    gateway_port,
    hosts_of,
    parse_address,
    resolve,
    slaves_of,
)
from eap.config.index import Index
from eap.config.routes import MisfitError
from eap.config.structs import Port, Station
from eap.pd.spec import PortKind

_ANY = "0.0.0.0"  # noqa: S104  what a plant file may say
_BIT_15 = 0x8000


def check_gateways(index: Index, report: Report) -> None:
    """Report every gateway that cannot be as it is."""
    taken = list(_taken(index))
    for station in index.plant.stations:
        for port in station.ports:
            if port.kind is PortKind.BUS:
                _check_addresses(index, station, port, report)
                _check_place(index, station, port, taken, report)


def _check_addresses(index: Index, station: Station, port: Port, report: Report) -> None:
    path = f"{port.at}.gateway.addresses"
    first: dict[int, str] = {}
    stations = {slave.station for slave in slaves_of(index, station, port)}
    is_unread = port.name in index.unread_buses(station)
    for text, target in port.gateway.addresses.items():
        try:
            address = parse_address(text)
            if address in first:
                message = f"gateway address {text} is {first[address]} once more"
                report.add(f"{path}.{text}", message, "each address once")
                continue
            first[address] = text
            if address & _BIT_15 and address & ~_BIT_15 in stations:
                slave = address & ~_BIT_15
                message = f"gateway address {text} is that of slave {slave} with bit 15 set"
                report.add(f"{path}.{text}", message, f"{ADDRESS} that stands for nobody yet")
            resolve(index, station, port, address, target)
        except MisfitError as exc:
            if not is_unread:
                report.add(f"{path}.{text}", str(exc), exc.expected)
        except ValueError:
            continue  # a NetID that is a finding of its own


def _check_place(
    index: Index,
    station: Station,
    port: Port,
    taken: list[tuple[str, int, str, str]],
    report: Report,
) -> None:
    number = gateway_port(station, port)
    if not number:
        return
    path = f"{port.at}.gateway.port"
    if path not in report.lines:
        path = port.at
    for host in hosts_of(index, station):
        for other_host, other_number, what, at in taken:
            if other_number == number and (host == other_host or _ANY in {host, other_host}):
                line = report.line_of(at)
                message = (
                    f"the gateway to {port.name} is served at {host}, port {number}, which"
                    f" belongs to {what} (line {line})"
                )
                report.add(path, message, f"gateway: {{port: NUMBER}} that is free at {host}")
                return
        taken.append((host, number, f"the gateway to {station.name}/{port.name}", path))


def _taken(index: Index) -> Iterator[tuple[str, int, str, str]]:
    """Yield what the ports of the plant have: address, port number, whose, and its path."""
    for (station, name), uri in index.uris.items():
        port = index.ports[station, name]
        path = f"{port.at}.interface"
        if uri.scheme in {"udp", "tcp"}:
            yield uri.host, uri.port or EAP_PORT, f"{station}/{name}", path
            if port.kind is PortKind.EAP and port.ams:
                yield uri.host, AMS_TCP_PORT, f"AMS at {station}/{name}", path
                yield uri.host, AMS_TCP_PORT + 1, f"AMS at {station}/{name}", path
