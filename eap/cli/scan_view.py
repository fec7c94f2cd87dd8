"""Stations, ports and slaves as lines for people, with what to paste.

On a terminal without room for the lines that connect pyads these are left out: a line that wraps
could not be pasted.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

from eap.cli.table import Column, TextTable
from eap.codec.ams import DEVICE_PORT, SYSTEM_PORT

Row: TypeAlias = dict[str, Any]


class _Line(NamedTuple):
    name: str
    kind: str
    state: str
    address: str
    client: str


def scan_table(answer: Row) -> TextTable:
    """Return the table of one plant: names as commands take them, AMS addresses, lines of pyads."""
    table = TextTable(
        "Name", Column("What", rank=1), "State", "AMS address", Column("To paste", rank=2)
    )
    for station in answer["stations"]:
        for line in _lines(station, answer["via"]):
            table.add_row(*line)
    return table


def fault_lines(answer: Row) -> Iterator[str]:
    """Yield who did not say all, and why."""
    for station in answer["stations"]:
        if station["error"]:
            yield f"{station['name']}: {station['error']}"
        for port in station["ports"]:
            if port["error"]:
                yield f"{station['name']}/{port['name']}: {port['error']}"


def client_line(net_id: str, port: int, address: str) -> str:
    """Return the Python line that connects pyads to a device; empty without AMS/TCP."""
    if not address:
        return ""
    return f'pyads.Connection("{net_id}", {port}, "{address}")'


def _lines(station: Row, via: Row) -> Iterator[_Line]:
    def client(net_id: str, port: int) -> tuple[str, str]:
        return f"{net_id}:{port}", client_line(net_id, port, via["address"])

    name = station["name"]
    yield _Line(name, "router", _state(station), *client(station["net_id"], SYSTEM_PORT))
    for port in station["ports"]:
        place = f"{name}/{port['name']}"
        what = f"  {port['kind']} {port['interface']}".rstrip()
        yield _Line(place, what, _state(port), *client(port["net_id"], DEVICE_PORT))
        for slave in port["slaves"]:
            number = slave["address"]
            yield _Line(
                f"{place}/{number}",
                f"    {slave['name']}",
                slave["state"] or "?",
                *client(port["net_id"], number),
            )


def _state(place: Row) -> str:
    return "?" if place["error"] else ""
