"""Hosts of other systems, by name or IPv4 address, and files that are named beside the plant."""

from __future__ import annotations

import re
from ipaddress import IPv4Address
from pathlib import Path

HOST = "an IPv4 address or a host name, and :PORT if it is not the usual one"
_LABEL = re.compile(r"(?!-)[A-Za-z0-9_-]{1,63}(?<!-)")
_MAX_NAME = 253


def parse_host(text: str, usual_port: int) -> tuple[str, int]:
    """Return host and port of ``HOST[:PORT]``; raise ValueError if it is none.

    Whether the name of a host is known is seen when it is needed.
    """
    host, separator, number = text.partition(":")
    if separator and not (number.isdigit() and 0 < int(number) < 65536):
        raise ValueError(f"{number!r} is not a port (1 to 65535)")
    labels = host.rstrip(".").split(".")
    if all(each.isdigit() for each in labels):
        if not _is_host(host):
            raise ValueError(f"{host!r} is not the IPv4 address of a host")
    elif len(host) > _MAX_NAME or not all(map(_LABEL.fullmatch, labels)):
        raise ValueError(f"{host!r} is no name of a host")
    return host, int(number) if separator else usual_port


def why_unreadable(file: Path) -> str:
    """Return why *file* cannot be read; empty if it can."""
    try:
        with file.open("rb") as opened:
            opened.read(1)
    except (OSError, ValueError) as exc:  # ValueError: a NUL in the path
        return f"{exc.strerror if isinstance(exc, OSError) else exc}"
    return ""


def _is_host(text: str) -> bool:
    try:
        address = IPv4Address(text)
    except ValueError:
        return False
    return not (address.is_multicast or address.is_unspecified or text == "255.255.255.255")
