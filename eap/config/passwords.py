"""Password hashes of the page's users: ``scrypt$N$R$P$SALT$KEY``, salt and key in base64."""

from __future__ import annotations

import hashlib
import hmac
from base64 import b64decode, b64encode
from typing import NamedTuple

FORM = "a hash that 'eapctl web --password NAME' prints (scrypt$N$R$P$SALT$KEY)"
MIN_PASSWORD = 8
"""Characters of the shortest password that a hash is made of (NIST SP 800-63B, 5.1.1.1)."""
MAX_PASSWORD = 256
"""Bytes of the longest password; a longer one would only cost time."""

_N, _R, _P = 1 << 15, 8, 1
# The memory that a hash takes is about 128 * N * R bytes: a hostile hash must not take all.
_MAX_MEMORY = 64 << 20
_MIN_N = 1 << 14
_MIN_SALT, _KEY = 16, 32


class PasswordHash(NamedTuple):
    """Parameters of scrypt (RFC 7914) and its result."""

    n: int
    r: int
    p: int
    salt: bytes
    key: bytes

    @classmethod
    def parse(cls, text: str) -> PasswordHash:
        """Read a hash; raise ValueError if *text* is none, or is too weak or too costly."""
        scheme, *rest = text.split("$")
        if scheme != "scrypt" or len(rest) != 5:
            raise ValueError("the password is no hash of scrypt")
        try:
            n, r, p = map(int, rest[:3])
            salt, key = (b64decode(each, validate=True) for each in rest[3:])
        except ValueError:
            raise ValueError("the password is no hash of scrypt") from None
        is_power = n > 0 and n & (n - 1) == 0
        if not is_power or n < _MIN_N or r < _R or len(salt) < _MIN_SALT or len(key) != _KEY:
            raise ValueError("the password's hash is too weak")
        if not 1 <= p <= 4 or 128 * n * r > _MAX_MEMORY:
            raise ValueError("the password's hash takes too much memory or time")
        return cls(n, r, p, salt, key)

    @classmethod
    def of(cls, password: str, salt: bytes) -> PasswordHash:
        """Return the hash of a password with a random *salt* of 16 bytes; takes about 0.1 s."""
        return cls(_N, _R, _P, salt, _derive(password, _N, _R, _P, salt))

    def matches(self, password: str) -> bool:
        """Return whether *password* is the one; takes about 0.1 s and 32 MB."""
        found = _derive(password, self.n, self.r, self.p, self.salt)
        return hmac.compare_digest(found, self.key)

    def __str__(self) -> str:
        salt, key = (b64encode(each).decode() for each in (self.salt, self.key))
        return f"scrypt${self.n}${self.r}${self.p}${salt}${key}"


def _derive(password: str, n: int, r: int, p: int, salt: bytes) -> bytes:
    data = password.encode()[: MAX_PASSWORD + 1]
    return hashlib.scrypt(data, salt=salt, n=n, r=r, p=p, maxmem=2 * _MAX_MEMORY, dklen=_KEY)
