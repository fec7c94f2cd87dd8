"""Files with the keys of authenticated process data.

Each line is the number of a key (1 to 65535) and 64 hexadecimal digits.  The first signs, all are
accepted; text behind ``#`` is a comment.  The file belongs to its user alone.
"""

from __future__ import annotations

import hashlib
import os
import stat
from pathlib import Path

from eap.config.finding import FindingReport
from eap.config.index import Index
from eap.errors import EnvironmentalError
from eap.pd.authentication import KEY_SIZE, Keys

MAX_KEY_NUMBER = 0xFFFF
MAX_KEYS = 64
"""Limit of keys in one file; a change needs two."""
_MAX_BYTES = 1 << 16


def read_keys(path: Path) -> Keys:
    """Read the keys in a file.

    Raises:
        EnvironmentalError: it cannot be read, is no such file, or other users may read it.
    """
    try:
        # Not blocking: a pipe in its place must not hold the caller up.
        descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except (OSError, ValueError) as exc:
        reason = exc.strerror if isinstance(exc, OSError) else exc
        raise EnvironmentalError(f"{path}: {reason}") from None
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            raise EnvironmentalError(f"{path}: no regular file")
        if status.st_mode & 0o077:
            raise EnvironmentalError(f"{path}: others may read its keys: chmod 600 {path}")
        data = file.read(_MAX_BYTES + 1)
    try:
        return parse_keys(data)
    except ValueError as exc:
        raise EnvironmentalError(f"{path}: {exc}") from None


def parse_keys(data: bytes) -> Keys:
    """Return the keys in the content of a file.

    Raises:
        ValueError: it is none; the message has the line, and nothing of a key.
    """
    if len(data) > _MAX_BYTES:
        raise ValueError(f"more than {_MAX_BYTES} bytes, which is no file of keys")
    found: dict[int, bytes] = {}
    for number, line in enumerate(data.decode("ascii", "replace").splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        key_number, key = _parse_line(words, number)
        if key_number in found:
            raise ValueError(f"line {number}: key {key_number} is there already")
        found[key_number] = key
    if not found:
        raise ValueError("no key in it: 'eapctl keys new' adds one")
    if len(found) > MAX_KEYS:
        raise ValueError(f"{len(found)} keys, at most {MAX_KEYS}")
    return Keys(found, next(iter(found)))


def format_keys(keys: Keys) -> str:
    """Return the content of a file of *keys*, the signing one first."""
    order = sorted(keys.by_number, key=lambda number: (number != keys.signing, number))
    lines = [f"{number} {keys.by_number[number].hex()}\n" for number in order]
    return "# Keys of authenticated process data. The first signs, all are accepted.\n" + "".join(
        lines
    )


def check_key_files(index: Index, report: FindingReport, folder: Path) -> None:
    """Report files of keys that cannot be read, once each."""
    places = {index.plant.defaults.pd_keys: f"{index.plant.defaults.at}.pd_keys"}
    places |= {each.pd_keys: f"{each.at}.pd_keys" for each in index.plant.stations}
    for name, at in places.items():
        if name:
            try:
                read_keys(folder / name)
            except EnvironmentalError as exc:
                report.add(at, str(exc), "a file that 'eapctl keys new' makes")


def fingerprint(key: bytes) -> str:
    """Return digits by which people compare a key on two hosts, and which do not tell it."""
    return hashlib.sha256(b"eap pd key " + key).hexdigest()[:16]


def _parse_line(words: list[str], line: int) -> tuple[int, bytes]:
    try:
        text, digits = words
        number, key = int(text), bytes.fromhex(digits)
    except ValueError:
        raise ValueError(f"line {line}: no number and {2 * KEY_SIZE} hexadecimal digits") from None
    if not 1 <= number <= MAX_KEY_NUMBER:
        raise ValueError(f"line {line}: key {number}, expected 1 to {MAX_KEY_NUMBER}")
    if len(key) != KEY_SIZE:
        raise ValueError(f"line {line}: key of {len(key)} bytes, expected {KEY_SIZE}")
    return number, key
