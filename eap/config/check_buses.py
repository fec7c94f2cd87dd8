"""Checks of bus ports: what their keys may be, and the bus files that describe them."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Address
from pathlib import Path

from eap.config.bus import BusDescription, DescribeBus
from eap.config.finding import Report
from eap.config.structs import PlantFile, Port, Station
from eap.ids import InterfaceUri
from eap.pd.spec import PortKind

SCHEMES = ("sim", "ethernet", "udp")
INTERFACE = "sim:// and a bus file, ethernet://NAME or udp://ADDRESS"
_FILE = "a bus file, its path from the plant file on"
_SLAVE_NAME = "a text without spaces and slashes, by which a plant can address it"


def check_bus_port(port: Port, uri: InterfaceUri, report: Report) -> None:
    """Report what no bus port on *uri* can have."""
    path = f"{port.at}.interface"
    if uri.scheme not in SCHEMES:
        report.add(path, f"{uri.scheme}:// is no interface of a bus port", INTERFACE)
        return
    if uri.options:
        report.add(path, f"{uri.scheme}:// takes no options", f"{uri.scheme}://{uri.host}")
    if uri.scheme == "udp":
        address = IPv4Address(uri.host)
        if address.is_multicast or address.is_unspecified or uri.host == "255.255.255.255":
            report.add(path, f"{uri.host} is no address of a bus", "the address of one segment")
    if uri.scheme == "sim" and port.bus and Path(port.bus) != Path(uri.host):
        message = f"port {port.name} simulates {uri.host}, but is described by {port.bus}"
        report.add(f"{port.at}.bus", message, "no key bus: the simulated file is the description")


def describe_buses(
    plant: PlantFile, folder: Path, describe: DescribeBus, report: Report
) -> dict[tuple[str, str], BusDescription | None]:
    """Return what is known of the bus at each (station, port); None where its file is no bus file.

    What is wrong with the files goes to *report*.
    """
    found: dict[tuple[str, str], BusDescription | None] = {}
    known: dict[Path, BusDescription | None] = {}
    for station, port in _bus_ports(plant):
        path, file = bus_file(port, folder)
        if file is None:
            description: BusDescription | None = BusDescription()
        elif reason := _unusable(file):
            report.add(path, f"bus file {file} {reason}", _FILE)
            description = None
        else:
            if file not in known:
                known[file] = _describe(file, describe, report)
            description = known[file]
        if description is not None and not _has_names(path, port, description, report):
            description = None
        found.setdefault((station.name, port.name), description)
    return found


def bus_file(port: Port, folder: Path) -> tuple[str, Path | None]:
    """Return where *port* names its bus file (a path in the plant file), and the file, if any."""
    try:
        uri = InterfaceUri.parse(port.interface)
    except ValueError:
        uri = None
    if uri is not None and uri.scheme == "sim":
        return f"{port.at}.interface", folder / uri.host
    return f"{port.at}.bus", folder / port.bus if port.bus else None


def _unusable(file: Path) -> str:
    """Return why there is nothing to read at *file*; empty if there is."""
    try:
        if file.is_file():
            return ""
        return "is no regular file" if file.exists() else "does not exist"
    except OSError as exc:
        return f"cannot be read: {exc.strerror}"


def _bus_ports(plant: PlantFile) -> Iterator[tuple[Station, Port]]:
    for station in plant.stations:
        for port in station.ports:
            if port.kind is PortKind.BUS:
                yield station, port


def _describe(file: Path, describe: DescribeBus, report: Report) -> BusDescription | None:
    description = describe(file)
    if isinstance(description, BusDescription):
        return description
    report.adopt(description)
    return None


def _has_names(path: str, port: Port, description: BusDescription, report: Report) -> bool:
    """Tell whether all slaves can be addressed, after reporting those that cannot."""
    wrong = [
        slave.name
        for slave in description.slaves
        if not slave.name or any(each.isspace() or each == "/" for each in slave.name)
    ]
    for name in wrong:
        report.add(path, f"port {port.name} has a slave {name!r}", _SLAVE_NAME)
    return not wrong
