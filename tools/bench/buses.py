"""Bus files of any size: slaves alike, which share a number of octets of process data."""

from __future__ import annotations

from typing import Any

import msgspec

FILE = "firmware.bin"
FILE_SIZE = 1 << 20
FILE_MAILBOX = 1024
MAILBOX = 256
_ENTRY = 16
"""Octets of the largest entry; a mapping takes no more than 31."""


def bus(slaves: int, octets: int) -> dict[str, Any]:
    """Return a bus file: *octets* of process data in all, half of them outputs.

    Each slave has CoE and a mailbox of *MAILBOX* octets; the first also has FoE with a file that
    holds *FILE_SIZE*, and a mailbox of *FILE_MAILBOX*.
    """
    size = octets // slaves // 2
    return {
        "bus": f"bench-{slaves}",
        "slaves": [
            {
                "name": f"slave-{number}",
                "kind": "generic",
                "product": 7,
                "mailbox": {"size": FILE_MAILBOX, "foe": True}
                if number == 1
                else {"size": MAILBOX},
                "files": [{"name": FILE, "max_size": FILE_SIZE}] if number == 1 else [],
                "inputs": _channels("in", size),
                "outputs": _channels("out", size),
            }
            for number in range(1, slaves + 1)
        ],
    }


def encode(content: dict[str, Any]) -> bytes:
    """Return a file's octets: JSON is YAML, too."""
    return msgspec.json.format(msgspec.json.encode(content))


def _channels(name: str, size: int) -> list[dict[str, Any]]:
    sizes = [_ENTRY] * (size // _ENTRY) + [size % _ENTRY] * (size % _ENTRY > 0)
    return [{"name": f"{name}{n}", "type": f"BLOCK({each})"} for n, each in enumerate(sizes, 1)]
