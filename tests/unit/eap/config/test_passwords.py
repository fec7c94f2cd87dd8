from __future__ import annotations

from base64 import b64encode

import pytest

from eap.config.passwords import PasswordHash

SALT = bytes(range(16))
# RFC 7914 section 12 has N = 16384 with another length of key; these are of hashlib's OpenSSL.
TEXT = "scrypt$16384$8$1$AAECAwQFBgcICQoLDA0ODw==$"


def test_hash_is_read_again_and_matches_its_password_only():
    made = PasswordHash.of("geheim ü", SALT)
    read = PasswordHash.parse(str(made))
    assert read == made
    assert str(made).startswith("scrypt$32768$8$1$")
    assert read.matches("geheim ü")
    assert not read.matches("geheim u")
    assert not read.matches("")


def test_long_passwords_differ_in_their_ends():
    made = PasswordHash.of("x" * 256, SALT)
    assert made.matches("x" * 256)
    assert not made.matches("x" * 257)


def key(octets: int) -> str:
    return b64encode(bytes(octets)).decode()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is no hash"),
        ("secret", "is no hash"),
        ("bcrypt$16384$8$1$a$b", "is no hash"),
        (TEXT + "!", "is no hash"),
        ("scrypt$x$8$1$$", "is no hash"),
        (TEXT, "too weak"),
        (TEXT + key(16), "too weak"),
        (f"scrypt$1024$8$1${key(16)}${key(32)}", "too weak"),
        (f"scrypt$16385$8$1${key(16)}${key(32)}", "too weak"),
        (f"scrypt$-16384$8$1${key(16)}${key(32)}", "too weak"),
        (f"scrypt$16384$7$1${key(16)}${key(32)}", "too weak"),
        (f"scrypt$16384$8$1${key(8)}${key(32)}", "too weak"),
        (f"scrypt$1048576$8$1${key(16)}${key(32)}", "too much"),
        (f"scrypt$16384$8$100${key(16)}${key(32)}", "too much"),
        (f"scrypt${'9' * 30}$8$1${key(16)}${key(32)}", "too weak"),
    ],
)
def test_other_texts_are_refused(text, reason):
    with pytest.raises(ValueError, match=reason):
        PasswordHash.parse(text)
