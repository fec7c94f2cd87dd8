"""Stations, ports and slaves as lines for people, with what to paste.

Lines are as long as they have to be: a table that wraps them could not be pasted.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias

from eap.codec.ams import DEVICE_PORT, SYSTEM_PORT

Row: TypeAlias = dict[str, Any]


class _Line(NamedTuple):
    name: str
    what: str
    state: str
    client: str


def scan_lines(answer: Row) -> Iterator[str]:
    """Yield the lines of one plant: names as commands take them, and what connects pyads."""
    lines = [line for station in answer["stations"] for line in _lines(station, answer["via"])]
    widths = [max((len(line[column]) for line in lines), default=0) for column in range(3)]
    for line in lines:
        columns = (text.ljust(width) for text, width in zip(line, widths, strict=False))
        yield "  ".join((*columns, line.client)).rstrip()


def fault_lines(answer: Row) -> Iterator[str]:
    """Yield who did not say all, and why."""
    for station in answer["stations"]:
        if station["error"]:
            yield f"{station['name']}: {station['error']}"
        for port in station["ports"]:
            if port["error"]:
                yield f"{station['name']}/{port['name']}: {port['error']}"


def client_line(net_id: str, port: int, address: str) -> str:
    """Return what connects pyads to somebody; the AMS address alone without AMS/TCP."""
    if not address:
        return f"{net_id}:{port}"
    return f'pyads.Connection("{net_id}", {port}, "{address}")'


def _lines(station: Row, via: Row) -> Iterator[_Line]:
    def client(net_id: str, port: int) -> str:
        return client_line(net_id, port, via["address"])

    name = station["name"]
    yield _Line(name, "router", _state(station), client(station["net_id"], SYSTEM_PORT))
    for port in station["ports"]:
        place = f"{name}/{port['name']}"
        what = f"  {port['kind']} {port['interface']}".rstrip()
        yield _Line(place, what, _state(port), client(port["net_id"], DEVICE_PORT))
        for slave in port["slaves"]:
            number = slave["address"]
            yield _Line(
                f"{place}/{number}",
                f"    {slave['name']}",
                slave["state"] or "?",
                client(port["net_id"], number),
            )


def _state(place: Row) -> str:
    return "?" if place["error"] else ""
