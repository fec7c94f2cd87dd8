"""Bus files of any size, slaves alike that share process data, and a plant with such a bus."""

from __future__ import annotations

from typing import Any

import msgspec

STATION, PORT = "master", "bus0"
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


def plain_bus(slaves: int, octets: int) -> dict[str, Any]:
    """Return the same without mailboxes: only process data is exchanged in a cycle."""
    content = bus(slaves, octets)
    for slave in content["slaves"]:
        del slave["files"]
        slave["mailbox"] = None
    return content


def plant(interface: str, cycle_us: int, **more: str) -> dict[str, Any]:
    """Return a plant file of one station, STATION, with one bus port, PORT, at *interface*."""
    port = {"name": PORT, "kind": "bus", "interface": interface, "net_id": "10.134.164.1.3.1"}
    station = {
        "name": STATION,
        "net_id": "10.134.164.1.1.1",
        "cycle_us": cycle_us,
        "ports": [port | more],
    }
    return {"plant": "bench-bus", "stations": [station]}


def encode(content: dict[str, Any]) -> bytes:
    """Return a file's octets: JSON is YAML, too."""
    return msgspec.json.format(msgspec.json.encode(content))


def _channels(name: str, size: int) -> list[dict[str, Any]]:
    sizes = [_ENTRY] * (size // _ENTRY) + [size % _ENTRY] * (size % _ENTRY > 0)
    return [{"name": f"{name}{n}", "type": f"BLOCK({each})"} for n, each in enumerate(sizes, 1)]
