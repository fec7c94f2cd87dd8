"""Checks of access rules and of the users who may add routes."""

from __future__ import annotations

from collections.abc import Callable
from ipaddress import IPv4Network
from pathlib import Path
from typing import TypeVar

from eap.aoe.spec import IP_DOORS, AccessRule, AccessService, DoorKind, ObjectRange
from eap.config.brokers import brokers_of
from eap.config.check_brokers import check_file
from eap.config.check_ports import check_names
from eap.config.finding import Report, one_of
from eap.config.index import Index
from eap.config.reach import without_prefix
from eap.config.routes import MisfitError
from eap.config.rules import (
    access_rules,
    parse_objects,
    parse_sender,
    parse_services,
    parse_source,
    parse_target,
)
from eap.config.structs import Access, Station
from eap.near import near
from eap.pd.spec import PortKind

T = TypeVar("T")

_OBJECT_SERVICES = {AccessService.READ, AccessService.WRITE}


def check_access(index: Index, report: Report, folder: Path) -> None:
    """Report every rule and user that cannot be as they are; files are in *folder*."""
    loose = without_prefix(index)
    for station in index.plant.stations:
        named = ((each.at, each.name) for each in station.access if each.name)
        check_names(named, "access rule", report)
        fine = [_check_rule(index, station, each, loose, report) for each in station.access]
        if all(fine):
            _check_order(index, station, loose, report)
        check_names(((user.at, user.name) for user in station.users), "user", report)
        for user in station.users:
            check_file(f"{user.at}.password_file", user.password_file, report, folder)


def _check_rule(
    index: Index, station: Station, access: Access, loose: set[str], report: Report
) -> bool:
    """Report what is wrong with a rule; return whether it can be compared with others."""
    is_fine = True

    def try_all(key: str, texts: tuple[str, ...], parse: Callable[[str], object]) -> None:
        nonlocal is_fine
        for position, text in enumerate(texts):
            try:
                parse(text)
            except MisfitError as exc:
                report.add(f"{access.at}.{key}[{position}]", f"{key}: {exc}", exc.expected)
                is_fine = False
            except ValueError:
                is_fine = False  # a NetID that is a finding of its own

    if report.has(f"{access.at}.allow") or report.has(f"{access.at}.deny"):
        is_fine = False
    elif bool(access.allow) == bool(access.deny):
        message = "access rule has both allow and deny" if access.allow else "nothing is said"
        report.add(access.at, message, "allow or deny with what it is about, such as allow: [read]")
        is_fine = False
    key = "allow" if access.allow else "deny"
    try_all(key, access.allow or access.deny, lambda text: parse_services((text,)))
    try_all("from", access.networks, parse_sender)
    try_all("net_ids", access.net_ids, lambda text: parse_source(index, text, loose))
    try_all("to", access.to, lambda text: parse_target(index, text, loose))
    try_all("objects", access.objects, parse_objects)
    known = _doors(station)
    try_all("doors", access.doors, lambda text: _check_door(text, known))
    return is_fine


def _doors(station: Station) -> list[str]:
    """Return all that ``doors`` may name at *station*."""
    found = [*map(str, DoorKind)]
    names = [port.name for port in station.ports if port.kind is PortKind.EAP]
    doors = [f"{kind}:{name}" for name in names for kind in ("udp", "tcp", "ethernet")]
    return [*found, *doors, *(f"mqtt:{route.network}" for route in brokers_of(station))]


def _check_door(text: str, known: list[str]) -> None:
    if text not in known:
        expected = f"{one_of(DoorKind)}, or one door such as udp:PORT or mqtt:NETWORK"
        raise MisfitError("", f"no door {text!r}{near(text, known)}", expected)


def _check_order(index: Index, station: Station, loose: set[str], report: Report) -> None:
    """Report rules that never decide anything."""
    before: list[tuple[Access, AccessRule]] = []
    try:
        rules = list(access_rules(index, station, loose))
    except ValueError:
        return  # a finding of its own
    for access, rule in zip(station.access, rules, strict=True):
        if reason := _why_never(rule):
            report.add(access.at, f"access rule can never fit: {reason}", "a rule that can")
        for earlier, other in before:
            if _covers(other, rule):
                line = report.line_of(earlier.at)
                message = f"access rule is never asked: the one of line {line} fits before it"
                report.add(access.at, message, "it before that one, or not at all")
                break
        before.append((access, rule))


def _why_never(rule: AccessRule) -> str:
    kinds = {_kind(door) for door in rule.doors}
    is_known = kinds.isdisjoint(IP_DOORS) if rule.networks else bool(rule.macs)
    if kinds and is_known and not (rule.macs and DoorKind.ETHERNET in kinds):
        return f"who comes by {', '.join(rule.doors)} has no such address"
    if rule.objects and rule.services and _OBJECT_SERVICES.isdisjoint(rule.services):
        return f"{', '.join(rule.services)} is not about objects"
    return ""


def _covers(one: AccessRule, other: AccessRule) -> bool:
    """Tell whether *one* fits whenever *other* does."""
    return (
        _covers_senders(one, other)
        and _all_in(one.net_ids, other.net_ids, _begins)
        and _all_in(one.doors, other.doors, lambda outer, inner: outer in {inner, _kind(inner)})
        and _all_in(
            one.targets,
            other.targets,
            lambda outer, inner: (
                _begins(outer.net_id, inner.net_id) and outer.port in {None, inner.port}
            ),
        )
        and _all_in(one.services, other.services, lambda outer, inner: outer == inner)
        and _all_in(one.objects, other.objects, ObjectRange.contains)
    )


def _covers_senders(one: AccessRule, other: AccessRule) -> bool:
    if not (one.networks or one.macs):
        return True
    by_address = not other.networks or _within(one.networks, other.networks, _in_network)
    is_any = not (other.networks or other.macs)
    return not is_any and by_address and set(other.macs) <= set(one.macs)


def _within(outer: tuple[T, ...], inner: tuple[T, ...], is_in: Callable[[T, T], bool]) -> bool:
    return all(any(is_in(each, item) for each in outer) for item in inner)


def _all_in(outer: tuple[T, ...], inner: tuple[T, ...], is_in: Callable[[T, T], bool]) -> bool:
    """Tell whether each of *inner* is in one of *outer*; nothing given stands for everything."""
    if not outer:
        return True
    return bool(inner) and _within(outer, inner, is_in)


def _in_network(outer: str, inner: str) -> bool:
    return IPv4Network(inner).subnet_of(IPv4Network(outer))


def _begins(outer: str, inner: str) -> bool:
    return f"{inner}.".startswith(f"{outer}.")


def _kind(door: str) -> str:
    return door.partition(":")[0]
