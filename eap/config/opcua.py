"""The key ``opcua`` of a plant file: checks, and what its server makes of keys that are missing."""

from __future__ import annotations

from pathlib import Path

from msgspec.structs import replace

from eap.ams.spec import Role
from eap.config.files import check_file, whole_path
from eap.config.finding import FindingReport, PlantFinding
from eap.config.index import Index
from eap.config.listen import parse_listen
from eap.config.opcua_sections import ChannelSecurity, OpcUaSection
from eap.config.selection import VariableNames, reason_not_settable
from eap.config.users import check_users

_LISTEN = "ADDRESS:PORT, such as 127.0.0.1:4840 or [::1]:4840"


def channel_securities(opcua: OpcUaSection) -> tuple[ChannelSecurity, ...]:
    """Return the security policies that the server offers: without the key, ``None`` here alone."""
    if opcua.security:
        return opcua.security
    is_local = parse_listen(opcua.listen).is_loopback
    return tuple(each for each in ChannelSecurity if is_local or each is not ChannelSecurity.NONE)


def resolved_opcua(opcua: OpcUaSection, folder: Path, operators: tuple[str, ...]) -> OpcUaSection:
    """Return *opcua*, which has no findings, with the paths of its files from *folder* on.

    *operators* are the variables of operators where it names none itself.
    """
    opcua = replace(opcua, operators=opcua.operators or operators)
    if not opcua.certificate:
        return opcua
    certificate, key = (whole_path(folder, each) for each in (opcua.certificate, opcua.key))
    return replace(opcua, certificate=certificate, key=key)


def check_opcua(index: Index, report: FindingReport, folder: Path) -> None:
    """Report every invalid key of ``opcua``; files are in *folder*."""
    opcua = index.plant.opcua
    if opcua is None:
        return
    _check_listen(opcua, report)
    check_users(opcua.users, report, shared=index.plant.users)
    names = VariableNames(index, report)
    for position, name in enumerate(opcua.variables):
        names.check_pattern(f"{opcua.at}.variables[{position}]", name)
    for position, name in enumerate(opcua.operators):
        path = f"{opcua.at}.operators[{position}]"
        if "*" in name:
            names.check_pattern(path, name)
        elif (found := names.find(path, name)) and (reason := reason_not_settable(index, *found)):
            message = f"variable {name} cannot be set: {reason}"
            report.add(path, message, "a variable without source and link")
    for name, limits in opcua.ranges.items():
        path = f"{opcua.at}.ranges.{name}"
        names.find(path, name)
        if not limits.low < limits.high:
            message = f"range of {name}: min {limits.low:g} is not below max {limits.high:g}"
            report.add(path, message, "a smaller min")
    if bool(opcua.certificate) is not bool(opcua.key):
        message = "certificate and key are not both there"
        report.add(opcua.at, message, "both, or none: the server makes its own")
    elif opcua.certificate:
        check_file(f"{opcua.at}.certificate", opcua.certificate, report, folder)
        check_file(f"{opcua.at}.key", opcua.key, report, folder)


def warn_of_open_channels(index: Index, report: FindingReport) -> list[PlantFinding]:
    """Return a warning if other hosts reach the server without security."""
    opcua = index.plant.opcua
    if opcua is None or parse_listen(opcua.listen).is_loopback:
        return []
    if ChannelSecurity.NONE not in opcua.security:
        return []
    path = f"{opcua.at}.security"
    message = "other hosts read the values, and whoever is in between changes them: security None"
    return [
        PlantFinding(report.file, report.line_of(path), path, message, "only policies with keys")
    ]


def _check_listen(opcua: OpcUaSection, report: FindingReport) -> None:
    try:
        listen = parse_listen(opcua.listen)
    except ValueError as exc:
        report.add(f"{opcua.at}.listen", f"listen: {exc}", _LISTEN)
        return
    if listen.is_loopback:
        return
    if not opcua.users and opcua.anonymous is None:
        message = f"listen: {opcua.listen} is reached by other hosts, and there are no users"
        expected = "users, anonymous: viewer, or an address of this host alone (127.0.0.1)"
        report.add(f"{opcua.at}.listen", message, expected)
    if opcua.anonymous not in {None, Role.VIEWER}:
        message = f"anonymous: every host would be {opcua.anonymous} without a password"
        report.add(f"{opcua.at}.anonymous", message, "viewer, or no such key")
