"""Routes and connections in words, as the table and the terminal's view show them."""

from __future__ import annotations

from datetime import datetime

from eap.aoe.way import Way
from eap.appliance.control_routes import ConnectionRow, RequestRow, RouteRow, RouterRow, WayRow
from eap.cli import words

_UNITS = ("", "k", "M", "G", "T", "P", "E")


def short(number: int) -> str:
    """Return a count in at most five characters."""
    value, unit = float(number), 0
    while value >= 9999.5 and unit < len(_UNITS) - 1:
        value, unit = value / 1000, unit + 1
    return (
        f"{value:.0f}{_UNITS[unit]}"
        if unit == 0 or value >= 99.95
        else f"{value:.1f}{_UNITS[unit]}"
    )


def octets(row: WayRow) -> str:
    """Return all octets, both ways."""
    return short(row.octets_in + row.octets_out)


def door(row: WayRow) -> str:
    """Return the door; one to an address of its own is called by its kind."""
    return row.door.removesuffix(f":{row.address}")


def way(row: WayRow) -> str:
    """Return address and door."""
    return str(Way(row.door, row.address))


def round_trip(us: int | None) -> str:
    """Return a time, or nothing while it is not known."""
    return "" if us is None else words.duration(us)


def age(seconds: int) -> str:
    """Return for how long."""
    return f"{seconds} s" if seconds < 120 else words.duration(seconds * 1_000_000)


def route_kind(row: RouteRow) -> str:
    """Return where a route is from, and what is special about it."""
    marks = {
        "unidirectional": row.unidirectional,
        "not probed": not row.probed,
        f"real NetID {row.real}": bool(row.real),
        f"answers within {row.timeout_ms} ms": bool(row.timeout_ms),
    }
    ends = "" if row.expires_s is None else f"ends in {age(row.expires_s)}"
    return ", ".join(
        filter(None, [row.origin, ends, *(word for word, is_so in marks.items() if is_so)])
    )


def route_state(row: RouteRow) -> str:
    """Return the state of a route, and why, or how long its next hop takes."""
    rest = row.why or (f"round trip {round_trip(row.rtt_us)}" if row.rtt_us is not None else "")
    if row.why and row.next_name not in {"", row.name}:
        rest = f"{row.next_name}: {row.why}"
    if row.state == "unknown" and not rest:
        rest = "nothing was answered yet"
    return f"{row.state}: {rest}" if rest else row.state


def figures(row: WayRow) -> str:
    """Return all figures of a row in words."""
    return (
        f"{words.count(row.requests, 'request')}, {words.count(row.answers, 'answer')},"
        f" {words.count(row.errors, 'error')}; octets: {short(row.octets_out)} out,"
        f" {short(row.octets_in)} in"
    )


def request_line(row: RequestRow) -> str:
    """Return one request on one line: when, what, and what became of it."""
    at = datetime.fromtimestamp(row.at).astimezone().strftime("%H:%M:%S")
    if not row.service:
        return f"{at} {row.outcome}: {row.text}"
    outcome = row.text or (
        f"error 0x{row.error:x}" if row.error else round_trip(row.took_us) or "0"
    )
    if row.outcome != "answered":
        outcome = f"{row.outcome}: {outcome}"
    return f"{at} {row.service} {row.target} < {row.source}: {outcome}"


def belongs(request: RequestRow, row: RouteRow | ConnectionRow) -> bool:
    """Say whether a request went by a route, or came by a connection."""
    if isinstance(row, ConnectionRow):
        return request.came_by == way(row)
    prefix = row.pattern.partition("*")[0]
    is_target = not row.octets or request.target.startswith(prefix)
    return is_target and (request.door, request.address) == (row.door, row.address)


def summary(stations: list[RouterRow]) -> str:
    """Return how many routes and connections there are, and what is wrong with them."""
    routes = [route for each in stations for route in each.routes]
    total = sum(each.total for each in stations)
    down = sum(route.state == "down" for route in routes)
    connections = sum(len(each.connections) for each in stations)
    parts = [words.count(total, "route") + (f", {down} down" if down else "")]
    parts.append(words.count(connections, "connection"))
    if interrupted := sum(row.count for each in stations for row in each.interruptions):
        parts.append(f"{words.count(interrupted, 'subscription')} interrupted")
    if warnings := sum(len(each.warnings) for each in stations):
        parts.append(words.count(warnings, "warning"))
    return ", ".join(parts)
