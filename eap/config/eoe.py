"""EoE of the bus ports of a plant file: TAP interface, IP settings of slaves, and their checks."""

from __future__ import annotations

from collections.abc import Callable
from ipaddress import IPv4Address, IPv4Interface

from eap.codec.eoe import NAME_SIZE
from eap.config.bus import find_slave
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.routes import SectionError
from eap.config.structs import EoeSlaveSection, PortSection
from eap.ids import MacAddr
from eap.pd.spec import EoeSlaveSpec, EoeSpec, PortKind

NAME_LIMIT = 15
"""Bytes of the longest name of an interface in Linux."""
_INTERFACE = "1 to 15 characters without spaces, slashes, colons and percent signs"
_WITH_NETWORK = "an IPv4 address with the length of its network, such as 192.168.7.10/24"
_ADDRESS = "an IPv4 address"
_MAC = "a MAC address of one device, such as 02:01:05:30:03:e9"
_GROUP = 0x01


def eoe_spec(port: PortSection) -> EoeSpec | None:
    """Return the specification of EoE at a bus port; the checks have passed it."""
    section = port.eoe
    if section is None:
        return None
    return EoeSpec(
        interface=section.interface or default_interface(port),
        address=section.address,
        slaves=tuple(
            EoeSlaveSpec(slave, each.ip, each.gateway, each.dns, each.name, each.mac)
            for slave, each in section.slaves.items()
        ),
    )


def default_interface(port: PortSection) -> str:
    """Return the name of the TAP interface of a port that names none."""
    return f"eoe-{port.name}"


def check_eoe(index: Index, report: FindingReport) -> None:
    """Report every invalid key of EoE."""
    for station in index.plant.stations:
        for port in station.ports:
            if port.kind is not PortKind.BUS or port.eoe is None:
                continue
            _check_interface(port, report)
            if port.eoe.address:
                _check(f"{port.eoe.at}.address", port.eoe.address, _parse_interface, report)
            first: dict[str, str] = {}
            for name, settings in port.eoe.slaves.items():
                try:
                    find_slave(index, station, port, name)
                except SectionError as exc:
                    if port.name not in index.unread_buses(station):
                        report.add(settings.at, str(exc), "a slave of this bus, by name or address")
                _check_settings(settings, report)
                _check_address_once(port, settings, first, report)


def _check_interface(port: PortSection, report: FindingReport) -> None:
    assert port.eoe is not None  # noqa: S101  the caller has looked
    name = port.eoe.interface or default_interface(port)
    is_valid = len(name.encode()) <= NAME_LIMIT and name not in {".", ".."}
    if is_valid and not any(each.isspace() or each in "/:%" for each in name):
        return
    path = f"{port.eoe.at}.interface"
    if path not in report.lines:
        path = port.eoe.at
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


def _check_address_once(
    port: PortSection, settings: EoeSlaveSection, first: dict[str, str], report: FindingReport
) -> None:
    assert port.eoe is not None  # noqa: S101  the caller has looked
    if port.eoe.address:
        first.setdefault(port.eoe.address.partition("/")[0], f"{port.eoe.at}.address")
    address = settings.ip.partition("/")[0]
    if not address:
        return
    path = f"{settings.at}.ip"
    if address in first:
        message = f"{address} is used twice (first in line {report.line_of(first[address])})"
        report.add(path, message, "an address of its own")
    first.setdefault(address, path)


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
