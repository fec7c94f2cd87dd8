"""EoE of the bus ports of a plant file: TAP interface, IP settings of slaves, and their checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from ipaddress import IPv4Address, IPv4Interface

from eap.codec.eoe import NAME_SIZE
from eap.config.bus import find_slave
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.routes import SectionError
from eap.config.structs import EoeSection, EoeSlaveSection, PortSection, StationSection
from eap.ids import INTERFACE_NAME_SIZE, MacAddr
from eap.pd.spec import EoeSlaveSpec, EoeSpec, PortKind

_INTERFACE = "1 to 15 characters without spaces, slashes, colons and percent signs"
_WITH_NETWORK = "an IPv4 address with the length of its network, such as 192.168.7.10/24"
_ADDRESS = "an IPv4 address"
_MAC = "a MAC address of one device, such as 02:01:05:30:03:e9"
_GROUP = 0x01


def eoe_spec(port: PortSection) -> EoeSpec | None:
    """Return the specification of EoE at a bus port; the checks have passed it."""
    slaves = dict(_slaves_of(port))
    if port.eoe is None and not slaves:
        return None
    section = port.eoe or EoeSection()
    return EoeSpec(
        interface=section.interface or default_interface(port),
        address=section.address,
        slaves=tuple(
            EoeSlaveSpec(slave, each.ip, each.gateway, each.dns, each.name, each.mac)
            for slave, each in slaves.items()
        ),
        connects_all=port.eoe is not None and not port.eoe.slaves,
    )


def default_interface(port: PortSection) -> str:
    """Return the name of the TAP interface of a port that names none."""
    return f"eoe-{port.name}"


def _slaves_of(port: PortSection) -> Iterator[tuple[str, EoeSlaveSection]]:
    """Yield the slaves that are connected: those of the port's key, and by keys of their own."""
    if port.eoe is not None:
        yield from port.eoe.slaves.items()
    for name, slave in port.slaves.items():
        if slave.eoe is not None:
            yield name, slave.eoe


def check_eoe(index: Index, report: FindingReport) -> None:
    """Report every invalid key of EoE."""
    for station in index.plant.stations:
        for port in station.ports:
            if port.kind is not PortKind.BUS:
                continue
            if port.eoe is not None:
                _check_port(index, station, port, port.eoe, report)
            elif eoe_spec(port) is not None:
                _check_interface(port, port.at, report)
            _check_slaves(port, report)


def _check_port(
    index: Index,
    station: StationSection,
    port: PortSection,
    section: EoeSection,
    report: FindingReport,
) -> None:
    path = f"{section.at}.interface"
    _check_interface(port, path if path in report.lines else section.at, report)
    if section.address:
        _check(f"{section.at}.address", section.address, _parse_interface, report)
    for name, settings in section.slaves.items():
        try:
            find_slave(index, station, port, name)
        except SectionError as exc:
            if port.name not in index.unread_buses(station):
                report.add(settings.at, str(exc), "a slave of this bus, by name or address")


def _check_slaves(port: PortSection, report: FindingReport) -> None:
    """Check the settings of all slaves, and that none has them, or an address, twice."""
    addresses: dict[str, str] = {}
    names: dict[str, str] = {}
    if port.eoe is not None and port.eoe.address:
        addresses[port.eoe.address.partition("/")[0]] = f"{port.eoe.at}.address"
    for name, settings in _slaves_of(port):
        _check_settings(settings, report)
        if name in names:
            line = report.line_of(names[name])
            message = f"slave {name} has eoe already (line {line})"
            report.add(settings.at, message, "one of the two")
        names.setdefault(name, settings.at)
        address, path = settings.ip.partition("/")[0], f"{settings.at}.ip"
        if address in addresses:
            line = report.line_of(addresses[address])
            message = f"{address} is used twice (first in line {line})"
            report.add(path, message, "an address of its own")
        if address:
            addresses.setdefault(address, path)


def _check_interface(port: PortSection, path: str, report: FindingReport) -> None:
    name = (port.eoe.interface if port.eoe is not None else "") or default_interface(port)
    is_valid = len(name.encode()) <= INTERFACE_NAME_SIZE and name not in {".", ".."}
    if not is_valid or any(each.isspace() or each in "/:%" for each in name):
        report.add(path, f"TAP interface {name!r}", f"interface: {_INTERFACE}")


def _check_settings(settings: EoeSlaveSection, report: FindingReport) -> None:
    parsers: dict[str, Callable[[str], str]] = {
        "ip": _parse_interface,
        "gateway": _parse_address,
        "dns": _parse_address,
        "name": _parse_name,
        "mac": _parse_mac,
    }
    for key, parse in parsers.items():
        text = getattr(settings, key)
        if not text:
            continue
        _check(f"{settings.at}.{key}", text, parse, report)
        if not settings.ip:
            message = f"{key} is given, but no ip: settings are written together with an address"
            report.add(f"{settings.at}.{key}", message, f"ip: {_WITH_NETWORK}")


def _check(path: str, text: str, parse: Callable[[str], str], report: FindingReport) -> None:
    if expected := parse(text):
        report.add(path, f"{path.rpartition('.')[2]} {text!r}", expected)


def _parse_interface(text: str) -> str:
    """Return the form that is expected; empty if *text* has it."""
    try:
        interface = IPv4Interface(text)
    except ValueError:
        return _WITH_NETWORK
    is_one = "/" in text and 0 < interface.network.prefixlen < 32
    return "" if is_one and not interface.ip.is_multicast else _WITH_NETWORK


def _parse_address(text: str) -> str:
    try:
        IPv4Address(text)
    except ValueError:
        return _ADDRESS
    return ""


def _parse_name(text: str) -> str:
    return "" if len(text.encode()) <= NAME_SIZE else f"at most {NAME_SIZE} bytes"


def _parse_mac(text: str) -> str:
    try:
        mac = MacAddr.parse(text)
    except ValueError:
        return _MAC
    return _MAC if bytes(mac)[0] & _GROUP else ""
