"""Sessions of the page's clients.

A session is a signed cookie, so that it outlives a restart of this process and any number of them
takes no memory.  The signature covers the user's password hash: another password ends it.
"""

from __future__ import annotations

import hashlib
import hmac
from base64 import urlsafe_b64decode, urlsafe_b64encode
from collections import OrderedDict
from collections.abc import Mapping

import msgspec

from eap.config.users import AccountSection
from eap.runtime.logins import Principal

KEY_BYTES = 32
"""Length of the secret that signs sessions."""
SESSION_S = 12 * 3600
"""Time for which a login holds."""
_MAX_TOKEN = 1024
_MAX_ENDED = 10_000


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

    def __init__(self, key: bytes, users: Mapping[str, AccountSection]) -> None:
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
        except ValueError:
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
        """End a session before its time."""
        # Memory is bounded: of very many, the first ones are valid again until they expire. Only
        # users that can log in can end so many.
        self._ended[token] = None
        if len(self._ended) > _MAX_ENDED:
            self._ended.popitem(last=False)

    def csrf(self, token: str) -> str:
        """Return the token against forged requests that belongs to a session, or to none."""
        return hmac.new(self._key, b"csrf " + token.encode(), hashlib.sha256).hexdigest()

    def _sign(self, user: str, body: bytes) -> str:
        known = self._users.get(user)
        password = known.password.encode() if known else b""
        # A new password in the plant file ends the sessions of the old one.
        digest = hashlib.sha256(password).digest()
        return hmac.new(self._key, b"session " + digest + body, hashlib.sha256).hexdigest()
