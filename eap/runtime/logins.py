"""Logins by password: users, lock-out after wrong passwords, and the report of refused logins."""

from __future__ import annotations

import asyncio
import logging
import os
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Iterable
from enum import StrEnum, auto
from time import monotonic
from typing import NamedTuple

import msgspec

from eap.ams.spec import Role
from eap.config.passwords import MAX_PASSWORD, PasswordHash
from eap.config.users import AccountSection
from eap.errors import EapError

RANK = {Role.VIEWER: 0, Role.OPERATOR: 1, Role.ENGINEER: 2}


class Principal(NamedTuple):
    """User of a request; the name of one without login is empty."""

    name: str
    role: Role

    @property
    def role_in_rules(self) -> Role | None:
        """Role for access rules; None without login."""
        return self.role if self.name else None

    def may_act_as(self, role: Role) -> bool:
        """Return whether this user has the rights of *role*."""
        return RANK[self.role] >= RANK[role]


class LoginFailure(StrEnum):
    """Reason that a login is refused."""

    WRONG = auto()
    """Unknown user or wrong password."""
    LOCKED = auto()
    """Too many wrong passwords before."""
    BUSY = auto()
    """Too many logins at once."""


class RefusedLogin(NamedTuple):
    """Refusal of a login; it may be tried again after *wait_s*."""

    why: LoginFailure
    wait_s: float


class _Failures(NamedTuple):
    number: int
    until_s: float
    """Time until which no password is tried."""


FREE_FAILURES = 5
"""Wrong passwords of a user from one host before it has to wait."""
_FREE_OF_HOST, _FREE_OF_USER = 20, 100
_FIRST_LOCK_S, _LONGEST_LOCK_S = 30.0, 900.0
_FORGOTTEN_S = 3600.0
_MAX_KEYS = 4096


class LoginGuard:
    """Lock-out after wrong passwords.

    A user is locked for the host that tried wrong ones, not for others: nobody can lock out a user
    elsewhere, until very many hosts try.
    """

    def __init__(self) -> None:
        self._failures: OrderedDict[tuple[str, str], _Failures] = OrderedDict()

    def locked_s(self, user: str, host: str, now_s: float) -> float:
        """Return the seconds for which a login has to wait, 0 if it may try."""
        untils = (self._get(key, now_s).until_s for key in self._keys(user, host))
        return max(0.0, max(untils) - now_s)

    def fail(self, user: str, host: str, now_s: float) -> int:
        """Note a wrong password; return the number of those of this user from this host."""
        for key, free in self._keys(user, host).items():
            number = self._get(key, now_s).number + 1
            over = number - free
            lock_s = min(_FIRST_LOCK_S * 2 ** min(over, 8), _LONGEST_LOCK_S) if over >= 0 else 0.0
            self._failures[key] = _Failures(number, now_s + lock_s)
            self._failures.move_to_end(key)
        while len(self._failures) > _MAX_KEYS:
            self._failures.popitem(last=False)
        return self._get((user, host), now_s).number

    def succeed(self, user: str, host: str) -> None:
        """Forget the wrong passwords of a user from a host."""
        self._failures.pop((user, host), None)

    def _keys(self, user: str, host: str) -> dict[tuple[str, str], int]:
        return {(user, host): FREE_FAILURES, ("", host): _FREE_OF_HOST, (user, ""): _FREE_OF_USER}

    def _get(self, key: tuple[str, str], now_s: float) -> _Failures:
        found = self._failures.get(key, _Failures(0, 0.0))
        return _Failures(0, 0.0) if found.until_s + _FORGOTTEN_S < now_s else found


_MAX_HASHING = 8
"""Logins that wait for their password to be hashed."""
_BUSY_S = 2.0
_REPORT_S = 1.0
_SHOWN = 40
_MAX_REFUSALS = 200
"""Different refusals that one report has; further ones are counted without user and host."""

logger = logging.getLogger(__name__)


class LoginRefusals(msgspec.Struct, frozen=True):
    """Refused logins of a user from a host since the last report."""

    user: str
    host: str
    why: LoginFailure
    count: int


class Logins:
    """Check of passwords, with lock-out.

    Args:
        users: The users; those without a password cannot log in.
    """

    def __init__(self, users: Iterable[AccountSection]) -> None:
        self._users = {user.name: user for user in users}
        self._guard = LoginGuard()
        self._hashing = asyncio.Semaphore(1)
        self._waiting = 0
        self._refusals: dict[tuple[str, str, LoginFailure], int] = {}
        # One that no password has: an unknown user takes as long as a wrong password.
        self._nobody = PasswordHash(1 << 15, 8, 1, os.urandom(16), bytes(32))

    async def verify(self, user: str, password: str, host: str) -> Principal | RefusedLogin:
        """Return the user if the password is right, else the refusal."""
        return await self.attempt(user, host, lambda: self.match(user, password))

    async def attempt(
        self, user: str, host: str, match: Callable[[], Awaitable[Principal | None]]
    ) -> Principal | RefusedLogin:
        """Return the user that *match* finds; not tried while user or host are locked."""
        now_s = monotonic()
        if locked_s := self._guard.locked_s(user, host, now_s):
            return self._refuse(user, host, LoginFailure.LOCKED, locked_s)
        if self._waiting >= _MAX_HASHING:
            return self._refuse(user, host, LoginFailure.BUSY, _BUSY_S)
        self._waiting += 1
        try:
            found = await match()
        finally:
            self._waiting -= 1
        if found is not None:
            self._guard.succeed(user, host)
            return found
        number = self._guard.fail(user, host, monotonic())
        logger.warning(
            "login of %r from %s refused (%d wrong passwords)", user[:_SHOWN], host, number
        )
        return self._refuse(user, host, LoginFailure.WRONG, 0.0)

    async def match(self, user: str, password: str) -> Principal | None:
        """Return the user with this password, None if there is none; takes a tenth of a second."""
        known = self._users.get(user)
        stored = PasswordHash.parse(known.password) if known and known.password else self._nobody
        # One at a time: each takes 32 MB and a tenth of a second of a core.
        async with self._hashing:
            is_right = await asyncio.to_thread(stored.matches, password)
        if known is None or not is_right or len(password.encode()) > MAX_PASSWORD:
            return None
        return Principal(known.name, known.role)

    async def report(self, send: Callable[[list[LoginRefusals]], Awaitable[None]]) -> None:
        """Send the refused logins once a second, until cancelled; kept while *send* fails."""
        while True:
            await asyncio.sleep(_REPORT_S)
            refused, self._refusals = self._refusals, {}
            try:
                if refused:
                    await send([LoginRefusals(*key, count) for key, count in refused.items()])
            except EapError:
                for key, count in refused.items():
                    self._note(*key, count)

    def _refuse(self, user: str, host: str, why: LoginFailure, wait_s: float) -> RefusedLogin:
        self._note(user[:_SHOWN], host, why, 1)
        return RefusedLogin(why, wait_s)

    def _note(self, user: str, host: str, why: LoginFailure, count: int) -> None:
        key = user, host, why
        if key not in self._refusals and len(self._refusals) >= _MAX_REFUSALS:
            key = "", "", why
        self._refusals[key] = self._refusals.get(key, 0) + count
