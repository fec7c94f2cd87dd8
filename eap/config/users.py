"""Users of a plant: their roles, and how programs recognize them."""

from __future__ import annotations

from collections.abc import Iterable

import msgspec

from eap.ams.spec import Role
from eap.config.finding import FindingReport
from eap.config.passwords import FORM, PasswordHash
from eap.config.structs import Section


class AccountSection(Section, frozen=True, kw_only=True):
    """Account of a user; *password* is a hash."""

    name: str
    role: Role = Role.VIEWER
    password: str = ""


class PlantUserSection(AccountSection, frozen=True, kw_only=True):
    """User of the whole plant.

    *unix* are users of the operating system and *groups* its groups, for the control socket;
    *networks* are IPv4 networks, MAC addresses, ``mqtt:NETWORK`` and ``ams-tls:CLIENT`` that have
    the role in rules.
    """

    unix: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    networks: tuple[str, ...] = msgspec.field(name="from", default=())


def check_users(
    users: Iterable[AccountSection],
    report: FindingReport,
    *,
    needs_passwords: bool = True,
    shared: Iterable[AccountSection] = (),
) -> None:
    """Report users whose names or passwords are invalid, and those that are there twice.

    *shared* are the users of the plant: a server that has them reports nothing of its own.
    """
    names: set[str] = set()
    if users is shared:
        return
    for user in users:
        if not user.name.strip() or not user.name.isprintable() or ":" in user.name:
            report.add(f"{user.at}.name", f"user {user.name!r}", "a name without colons")
        if user.name in names:
            report.add(f"{user.at}.name", f"user {user.name} is there twice", "each user once")
        names.add(user.name)
        if not user.password and not needs_passwords:
            continue
        try:
            PasswordHash.parse(user.password)
        except ValueError as exc:
            where = f"{user.at}.password" if user.password else user.at
            report.add(where, f"user {user.name}: {exc}", FORM)
