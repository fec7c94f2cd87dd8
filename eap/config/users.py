"""Users of the page and of bridges, with their roles and passwords."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

from eap.config.finding import FindingReport
from eap.config.passwords import FORM, PasswordHash
from eap.config.structs import Section


class Role(StrEnum):
    """Rights of a user, each with those of the ones before."""

    VIEWER = "viewer"
    """Sees everything."""
    OPERATOR = "operator"
    """Sets the variables that the plant file lets operators set."""
    ENGINEER = "engineer"
    """Sets every variable of the application."""


class AccountSection(Section, frozen=True, kw_only=True):
    """Account of a user; *password* is a hash."""

    name: str
    role: Role = Role.VIEWER
    password: str = ""


def check_users(
    users: Iterable[AccountSection], report: FindingReport, *, needs_passwords: bool = True
) -> None:
    """Report users whose names or passwords are invalid, and those that are there twice."""
    names: set[str] = set()
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
