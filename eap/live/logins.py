"""Logins by password, for the page and for bridges: users, lock-out after wrong passwords."""

from __future__ import annotations

import asyncio
import logging
import os
from collections import OrderedDict
from collections.abc import Iterable
from enum import Enum, auto
from time import monotonic
from typing import NamedTuple

from eap.config.passwords import MAX_PASSWORD, PasswordHash
from eap.config.users import AccountSection, Role

RANK = {Role.VIEWER: 0, Role.OPERATOR: 1, Role.ENGINEER: 2}


class Principal(NamedTuple):
    """User of a request; the name of one without login is empty."""

    name: str
    role: Role

    def may_act_as(self, role: Role) -> bool:
        """Return whether this user has the rights of *role*."""
        return RANK[self.role] >= RANK[role]


class LoginFailure(Enum):
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

logger = logging.getLogger(__name__)


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
        # One that no password has: an unknown user takes as long as a wrong password.
        self._nobody = PasswordHash(1 << 15, 8, 1, os.urandom(16), bytes(32))

    async def verify(self, user: str, password: str, host: str) -> Principal | RefusedLogin:
        """Return the user if the password is right, else the refusal."""
        now_s = monotonic()
        if locked_s := self._guard.locked_s(user, host, now_s):
            return RefusedLogin(LoginFailure.LOCKED, locked_s)
        if self._waiting >= _MAX_HASHING:
            return RefusedLogin(LoginFailure.BUSY, _BUSY_S)
        known = self._users.get(user)
        stored = PasswordHash.parse(known.password) if known and known.password else self._nobody
        self._waiting += 1
        try:
            # One at a time: each takes 32 MB and a tenth of a second of a core.
            async with self._hashing:
                is_right = await asyncio.to_thread(stored.matches, password)
        finally:
            self._waiting -= 1
        if known is not None and is_right and len(password.encode()) <= MAX_PASSWORD:
            self._guard.succeed(user, host)
            return Principal(known.name, known.role)
        number = self._guard.fail(user, host, monotonic())
        logger.warning("login of %r from %s refused (%d wrong passwords)", user[:40], host, number)
        return RefusedLogin(LoginFailure.WRONG, 0.0)
