"""A password in a file: its first line, read without ever waiting for a pipe."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from eap.errors import EnvironmentalError

_MAX_SIZE = 4096


def read_password(file: Path) -> bytes:
    """Return the first line of *file* without its end, as far as 4096 octets.

    Raises:
        EnvironmentalError: it cannot be read, or is no regular file.
    """
    try:
        # A pipe would keep whoever opens it waiting for somebody who writes.
        with os.fdopen(os.open(file, os.O_RDONLY | os.O_NONBLOCK), "rb") as opened:
            if not stat.S_ISREG(os.fstat(opened.fileno()).st_mode):
                raise EnvironmentalError(f"{file}: a password is kept in a regular file")
            return opened.readline(_MAX_SIZE).rstrip(b"\r\n")
    except OSError as exc:
        raise EnvironmentalError(f"{file}: {exc.strerror or exc}") from None


def read_password_text(file: Path) -> str:
    """Return the same as text; raises EnvironmentalError also if it is not UTF-8."""
    try:
        return read_password(file).decode()
    except UnicodeDecodeError:
        raise EnvironmentalError(f"{file}: its first line is not UTF-8") from None
