"""Logins of requests for routes (UDP 48899): users with a file, and engineers of the plant."""

from __future__ import annotations

import hmac
import logging
from collections.abc import Iterable, Sequence
from pathlib import Path

from eap.ams.spec import AmsUser, Role
from eap.config.users import AccountSection
from eap.errors import EnvironmentalError
from eap.net.host import read_password
from eap.runtime.logins import LoginFailure, Logins, Principal
from eap.services.limited_log import caused_by

_SHOWN = 80

logger = logging.getLogger(__name__)


class RouteLogins:
    """Logins of requests for routes, with the lock-out of all logins.

    Args:
        users: Users of the plant.

    Attributes:
        logins: Counts the refused ones.
    """

    def __init__(self, users: Iterable[AccountSection] = ()) -> None:
        self.logins = Logins(each for each in users if each.role is Role.ENGINEER)

    async def refusals(
        self, stations: Sequence[Sequence[AmsUser]], user: str, password: bytes, sender: str
    ) -> list[str]:
        """Return why a user may not add a route, for each station by its users; empty if it may."""
        wrong = f"user {user[:_SHOWN]!r} or the password is wrong"
        answers: list[str] = []

        async def match() -> Principal | None:
            is_engineer = await self._is_engineer(stations, user, password)
            for users in stations:
                is_known = _is_known(users, user, password, is_engineer=is_engineer)
                answers.append("" if is_known else wrong)
            return None if any(answers) else Principal(user, Role.ENGINEER)

        found = await self.logins.attempt(user, sender, match)
        if answers or isinstance(found, Principal):
            return answers
        busy = found.why is LoginFailure.BUSY
        why = "too many logins at once" if busy else f"locked after wrong passwords: user {user!r}"
        return [f"{why}, for {found.wait_s:.0f} s"] * len(stations)

    async def _is_engineer(
        self, stations: Sequence[Sequence[AmsUser]], user: str, password: bytes
    ) -> bool:
        if all(each.password_file for users in stations for each in users):
            return False
        return await self.logins.match(user, password.decode("utf-8", "replace")) is not None


def _is_known(users: Iterable[AmsUser], name: str, given: bytes, *, is_engineer: bool) -> bool:
    is_known = False
    for user in users:  # all of them: the time must not reveal whether a user exists
        if user.password_file:
            password = _password(user)
            is_right = password is not None and hmac.compare_digest(password, given)
        else:
            is_right = is_engineer
        is_known |= is_right and hmac.compare_digest(user.name.encode(), name.encode())
    return is_known


def _password(user: AmsUser) -> bytes | None:
    """Return the password of *user*; log a warning and return None without one."""
    try:
        password = read_password(Path(user.password_file))
        reason = "" if password else f"{user.password_file}: its first line is empty"
    except EnvironmentalError as exc:
        password, reason = b"", str(exc)
    if reason:
        cause = caused_by((user.name, reason), f"user {user.name}")
        logger.warning("password of user %s: %s", user.name, reason, extra=cause)
    return password or None
