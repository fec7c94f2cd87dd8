"""Operations on files with the keys of signed process data."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from msgspec import Struct

from eap.config.pd_keys import MAX_KEY_NUMBER, fingerprint, format_keys, read_keys
from eap.errors import EnvironmentalError
from eap.pd.authentication import KEY_SIZE, Keys
from eap.runtime.durable import whole_file


class KeyInfo(Struct, frozen=True):
    """A key, without telling it."""

    number: int
    fingerprint: str
    signs: bool


def list_keys(path: Path) -> list[KeyInfo]:
    """Return the keys of a file, the signing one first.

    Raises:
        EnvironmentalError: it cannot be read, or is no such file.
    """
    return _described(read_keys(path))


def add_key(path: Path) -> list[KeyInfo]:
    """Add a new random key, which is accepted and does not sign unless it is the only one.

    Raises:
        EnvironmentalError: the file cannot be read or written.
    """
    keys = read_keys(path) if path.exists() else Keys()
    numbers = range(1, MAX_KEY_NUMBER + 1)
    number = max(keys.by_number, default=0) + 1
    if number not in numbers:
        number = next(each for each in numbers if each not in keys.by_number)
    content = {**keys.by_number, number: secrets.token_bytes(KEY_SIZE)}
    return _write(path, Keys(content, keys.signing or number))


def sign_with(path: Path, number: int) -> list[KeyInfo]:
    """Have a key sign.

    Raises:
        EnvironmentalError: the file has no such key, or cannot be read or written.
    """
    keys = read_keys(path)
    _find(path, keys, number)
    return _write(path, keys._replace(signing=number))


def remove_key(path: Path, number: int) -> list[KeyInfo]:
    """Remove a key that does not sign.

    Raises:
        EnvironmentalError: the file has no such key, it signs, or the file cannot be written.
    """
    keys = read_keys(path)
    _find(path, keys, number)
    if number == keys.signing:
        advice = f"let another one sign first: 'eapctl keys use {path} NUMBER'"
        raise EnvironmentalError(f"{path}: key {number} signs; {advice}")
    rest = {each: key for each, key in keys.by_number.items() if each != number}
    return _write(path, keys._replace(by_number=rest))


def _find(path: Path, keys: Keys, number: int) -> None:
    if number not in keys.by_number:
        known = ", ".join(map(str, sorted(keys.by_number)))
        raise EnvironmentalError(f"{path}: there is no key {number}; it has {known}")


def _write(path: Path, keys: Keys) -> list[KeyInfo]:
    with whole_file(path) as file:
        # Before a byte of a key is in it.
        os.fchmod(file.fileno(), 0o600)
        file.write(format_keys(keys).encode())
    return _described(keys)


def _described(keys: Keys) -> list[KeyInfo]:
    rows = [
        KeyInfo(number, fingerprint(key), number == keys.signing)
        for number, key in keys.by_number.items()
    ]
    return sorted(rows, key=lambda row: (not row.signs, row.number))
