"""Hosts of other systems as plant files name them, and files that are named beside the plant."""

from __future__ import annotations

from pathlib import Path

HOST = "an IPv4 address or a host name, and :PORT if it is not the usual one"


def why_unreadable(file: Path) -> str:
    """Return why *file* cannot be read as a whole; empty if it can."""
    try:
        if file.exists() and not file.is_file() and not file.is_dir():
            return "no regular file"  # a pipe would keep us waiting
        with file.open("rb") as opened:
            opened.read(1)
    except (OSError, ValueError) as exc:  # ValueError: a NUL in the path
        return f"{exc.strerror if isinstance(exc, OSError) else exc}"
    return ""
