"""Sessions, logins and rates of the page's clients.

A session is a signed cookie, so that it outlives a restart of this process and any number of them
takes no memory.  The signature covers the user's password hash: another password ends it.
"""

from __future__ import annotations

import hashlib
import hmac
from base64 import urlsafe_b64decode, urlsafe_b64encode
from collections import OrderedDict
from collections.abc import Mapping
from typing import NamedTuple

import msgspec

from eap.config.web_sections import Role, WebUser

KEY_BYTES = 32
"""Length of the secret that signs sessions."""
SESSION_S = 12 * 3600
"""Time for which a login holds."""
_MAX_TOKEN = 1024
_MAX_ENDED = 10_000

RANK = {Role.VIEWER: 0, Role.OPERATOR: 1, Role.ENGINEER: 2}


class Principal(NamedTuple):
    """User of a request; the name of one without login is empty."""

    name: str
    role: Role

    def may_act_as(self, role: Role) -> bool:
        """Return whether this user has the rights of *role*."""
        return RANK[self.role] >= RANK[role]


class _PageSession(msgspec.Struct, frozen=True):
    user: str
    until_s: int
    nonce: str


class Sessions:
    """Sessions of users.

    Args:
        key: Secret of this plant's page, 32 random bytes.
        users: The users by name.
    """

    def __init__(self, key: bytes, users: Mapping[str, WebUser]) -> None:
        self._key = key
        self._users = users
        self._ended: OrderedDict[str, None] = OrderedDict()

    def begin(self, user: str, nonce: str, now_s: float) -> str:
        """Return the token of a new session of a user whose password was right."""
        body = msgspec.json.encode(_PageSession(user, int(now_s) + SESSION_S, nonce))
        return f"{urlsafe_b64encode(body).decode()}.{self._sign(user, body)}"

    def find(self, token: str, now_s: float) -> Principal | None:
        """Return the user of a session, None if there is no such session."""
        if len(token) > _MAX_TOKEN or token in self._ended:
            return None
        encoded, _, signature = token.partition(".")
        try:
            body = urlsafe_b64decode(encoded)
            session = msgspec.json.decode(body, type=_PageSession)
        except (ValueError, msgspec.MsgspecError):
            return None
        user = self._users.get(session.user)
        # Another encoding of the same body would be another token, which could not be ended.
        is_exact = urlsafe_b64encode(body).decode() == encoded
        is_signed = hmac.compare_digest(
            self._sign(session.user, body).encode(), signature.encode("utf-8", "replace")
        )
        if user is None or not is_exact or not is_signed or session.until_s <= now_s:
            return None
        return Principal(user.name, user.role)

    def end(self, token: str) -> None:
        """End a session; of very many the first ones are forgotten."""
        self._ended[token] = None
        if len(self._ended) > _MAX_ENDED:
            self._ended.popitem(last=False)

    def csrf(self, token: str) -> str:
        """Return the token against forged requests that belongs to a session, or to none."""
        return hmac.new(self._key, b"csrf " + token.encode(), hashlib.sha256).hexdigest()

    def _sign(self, user: str, body: bytes) -> str:
        known = self._users.get(user)
        password = known.password.encode() if known else b""
        digest = hashlib.sha256(password).digest()
        return hmac.new(self._key, b"session " + digest + body, hashlib.sha256).hexdigest()


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
