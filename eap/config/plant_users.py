"""The keys ``users`` and ``access.operators`` of a plant file."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Network
from itertools import combinations
from typing import TypeVar

from msgspec.structs import replace

from eap.ams.spec import Role
from eap.config.access import parse_member
from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.config.opcua_sections import OpcUaSection
from eap.config.plant_sections import PlantFile
from eap.config.routes import SectionError
from eap.config.selection import VariableNames
from eap.config.users import PlantUserSection, check_users
from eap.config.web_sections import ServerSection

_EVERYWHERE = "0.0.0.0/0"

ServerT = TypeVar("ServerT", bound=ServerSection | OpcUaSection)


def with_shared_users(plant: PlantFile) -> PlantFile:
    """Return *plant* whose servers without users of their own have those of the plant."""
    if not plant.users:
        return plant

    def shared(section: ServerT | None) -> ServerT | None:
        if section is None or section.users:
            return section
        return replace(section, users=plant.users)

    return replace(
        plant, web=shared(plant.web), metrics=shared(plant.metrics), opcua=shared(plant.opcua)
    )


def check_plant_users(index: Index, report: FindingReport) -> None:
    """Report every invalid user of the plant, and patterns of operators that fit no variable."""
    plant = index.plant
    check_users(plant.users, report, needs_passwords=False)
    has_proxy = any(each and each.proxy for each in (plant.web, plant.metrics))
    for user in plant.users:
        if not (user.password or user.unix or user.groups or user.networks or has_proxy):
            message = f"user {user.name}: nothing identifies it"
            report.add(user.at, message, "password, unix, groups or from")
    placed = [each for user in plant.users for each in _places(user, report)]
    for (one, place), (other, further) in combinations(placed, 2):
        if one.role is not other.role and _overlap(place, further):
            message = f"{further} is {other.role}, and {one.role} as {place} of {one.name}"
            report.add(f"{other.at}.from", message, "one role for each address")
    names = VariableNames(index, report)
    for position, name in enumerate(plant.access.operators):
        names.check_pattern(f"{plant.access.at}.operators[{position}]", name)
    if plant.access.operators and not plant.users:
        message = "operators without users: programs of this host set every variable"
        report.add(f"{plant.access.at}.operators", message, "users, or no such key")


def _places(
    user: PlantUserSection, report: FindingReport
) -> Iterator[tuple[PlantUserSection, str]]:
    """Yield the valid addresses of a user, after reporting the others."""
    for position, text in enumerate(user.networks):
        at = f"{user.at}.from[{position}]"
        try:
            place = parse_member(text)
        except SectionError as exc:
            report.add(at, f"from: {exc}", exc.expected)
            continue
        if place == _EVERYWHERE and user.role is not Role.VIEWER:
            message = f"from: {text}: every host would be {user.role} without a password"
            report.add(at, message, "the addresses of this user")
        yield user, place


def _overlap(one: str, other: str) -> bool:
    if ":" in one + other:
        return one == other
    return IPv4Network(one).overlaps(IPv4Network(other))
