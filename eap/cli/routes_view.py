"""Text views of routes and connections, for tables and for the terminal's live view."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime

from eap.cli.output import Column, Styled, TextTable
from eap.control.routes import (
    ConnectionRow,
    EndpointRow,
    ImportRow,
    NeighbourRow,
    RequestRow,
    RouteRow,
    RouterRow,
    interruption_text,
)
from eap.ids import Endpoint
from eap.ops.routing import RouterList, TestedTarget
from eap.quantities import count, duration

_UNITS = ("", "k", "M", "G", "T", "P", "E")
_STYLES = {"up": "green", "down": "bold red", "unknown": "dim", "client": "dim"}


def routes_view(found: RouterList) -> Iterator[TextTable | Styled | str]:
    """Yield routes, connections and remarks."""
    stations = found.stations
    yield _routes(stations)
    if any(each.connections for each in stations):
        yield ""
        yield _connections(stations)
    remarks = [f"{each.station}: {text}" for each in stations for text in _remarks(each)]
    if remarks:
        yield ""
        yield Styled("Warnings", style="bold")
        yield from remarks


def result_table(results: Iterable[TestedTarget]) -> Iterator[TextTable]:
    """Yield the results of tests, by station."""
    table = TextTable(
        "Station", "Target", Column("Round trip", is_number=True), Column("Result", wraps=True)
    )
    for result in results:
        text = Styled(result.text, style="" if result.ok else _STYLES["down"])
        if result.hint:
            text.append(f"\n{result.hint}", style="none")
        target = f"{result.name} {result.target}".strip()
        table.add_row(result.station, target, duration(result.rtt_us), text)
    yield table


def neighbour_table(rows: Iterable[NeighbourRow]) -> Iterator[TextTable]:
    """Yield the routers of other hosts, and the routes to them."""
    table = TextTable(
        "Station",
        "Found",
        "NetID",
        "Address",
        Column("Version", rank=1),
        Column("Route", wraps=True),
    )
    for row in rows:
        route = Styled(row.route or "none", style=_STYLES["up" if row.route else "unknown"])
        if row.is_learned:
            route.append(" (auto-discovered)", style="none")
        table.add_row(row.station, row.name, row.net_id, row.address, row.version, route)
    yield table


def import_table(rows: Iterable[ImportRow], *, is_done: bool) -> Iterator[TextTable]:
    """Yield the routes of a file, and the outcome of each."""
    outcome_heading = "Added" if is_done else "Would be added"
    table = TextTable("Route", "NetID", "Via", Column(outcome_heading, wraps=True))
    for row in rows:
        text = row.reason or ("yes" if not row.note else f"yes; {row.note}")
        outcome = Styled(text, style=_STYLES["down" if row.reason else "up"])
        table.add_row(row.name, row.net_id, row.via, outcome)
    yield table


def _routes(stations: Sequence[RouterRow]) -> TextTable:
    table = TextTable(
        "Station",
        "Route",
        Column("NetID", rank=2),
        Column("Transport", rank=3),
        Column("Address", rank=4),
        "State",
        Column("RTT", rank=1, is_number=True),
        Column("Requests", is_number=True),
        Column("Errors", is_number=True),
    )
    for station in stations:
        own = station.station
        for row in station.routes:
            state = Styled(row.state, style=_STYLES[row.state])
            trip = duration(row.rtt_us)
            errors = Styled(str(row.errors), style="red" if row.errors else "")
            table.add_row(
                own, row.name, row.pattern, transport_of(row), row.address, state, trip,
                str(row.requests), errors,
            )  # fmt: skip
            own = ""
        if not station.routes:
            table.add_row(own, Styled("none", style="dim"))
    return table


def _connections(stations: Sequence[RouterRow]) -> TextTable:
    table = TextTable(
        "Station",
        "Connection",
        Column("Transport", rank=3),
        Column("NetIDs", rank=1),
        Column("Open", is_number=True),
        Column("Requests", is_number=True),
        Column("Bytes", rank=2, is_number=True),
        Column("Errors", is_number=True),
    )
    for station in stations:
        own = station.station
        for row in station.connections:
            table.add_row(
                own, row.address, transport_of(row), "\n".join(row.net_ids),
                elapsed(row.since_s), str(row.requests),
                octets_of(row), str(row.errors),
            )  # fmt: skip
            own = ""
    return table


def _remarks(station: RouterRow) -> Iterator[str]:
    for each in station.interruptions:
        yield f"{interruption_text(each)}, for {elapsed(each.since_s)}"
    yield from station.warnings
    yield from _dead_hops(station.routes)
    for row in station.routes:
        if row.last_error:
            yield f"{row.name}, {last_error(row)}"
    for connection in station.connections:
        if connection.last_error:
            yield f"{path_of(connection)}, {last_error(connection)}"


def _dead_hops(routes: Sequence[RouteRow]) -> Iterator[str]:
    """Yield one remark for each next hop that is down, however many routes lead by it."""
    by_hop: dict[tuple[str, str], list[RouteRow]] = {}
    for row in routes:
        if row.state == "down":
            by_hop.setdefault((row.transport, row.address), []).append(row)
    for first, *others in by_hop.values():
        name = first.next_name or first.name
        beyond = dict.fromkeys(row.name for row in (first, *others) if row.name != name)
        text = f"; so are the routes through it: {', '.join(beyond)}" if beyond else ""
        yield f"{name} ({path_of(first)}) is down: {first.why}{text}"


def short(number: int) -> str:
    """Return a count in at most five characters."""
    value, unit = float(number), 0
    # 9999.5 would be shown rounded, as 10000, which has five digits and a unit behind it.
    while value >= 9999.5 and unit < len(_UNITS) - 1:
        value, unit = value / 1000, unit + 1
    return (
        f"{value:.0f}{_UNITS[unit]}"
        if unit == 0 or value >= 99.95
        else f"{value:.1f}{_UNITS[unit]}"
    )


def octets_of(row: EndpointRow) -> str:
    """Return all bytes, in both directions."""
    return short(row.octets_in + row.octets_out)


def transport_of(row: EndpointRow) -> str:
    """Return the transport; one to a fixed address is shown by its kind."""
    return row.transport.removesuffix(f":{row.address}")


def path_of(row: EndpointRow) -> str:
    """Return address and transport."""
    return str(Endpoint(row.transport, row.address))


def last_error(row: EndpointRow) -> str:
    """Return the latest error with its age."""
    ago = "" if row.last_error_s is None else f", {elapsed(row.last_error_s)} ago"
    return f"last error{ago}: {row.last_error}"


def elapsed(seconds: int) -> str:
    """Return a time in whole seconds, or in the unit that keeps it short."""
    return f"{seconds} s" if seconds < 120 else duration(seconds * 1_000_000)


def route_kind(row: RouteRow) -> str:
    """Return the origin of a route, and its special settings."""
    marks = {
        "unidirectional": row.unidirectional,
        "not probed": not row.probed,
        f"real NetID {row.real}": bool(row.real),
        f"answers within {row.timeout_ms} ms": bool(row.timeout_ms),
    }
    ends = "" if row.expires_s is None else f"ends in {elapsed(row.expires_s)}"
    return ", ".join(
        filter(None, [row.origin, ends, *(word for word, is_so in marks.items() if is_so)])
    )


def route_state(row: RouteRow) -> str:
    """Return the state of a route with its cause or the round-trip time of its next hop."""
    rest = row.why or (f"round trip {duration(row.rtt_us)}" if row.rtt_us is not None else "")
    if row.why and row.next_name not in {"", row.name}:
        rest = f"{row.next_name}: {row.why}"
    if row.state == "unknown" and not rest:
        rest = "no request answered yet"
    return f"{row.state}: {rest}" if rest else row.state


def figures(row: EndpointRow) -> str:
    """Return all figures of a row in words."""
    return (
        f"{count(row.requests, 'request')}, {count(row.answers, 'answer')},"
        f" {count(row.errors, 'error')}; bytes: {short(row.octets_out)} out,"
        f" {short(row.octets_in)} in"
    )


def request_line(row: RequestRow) -> str:
    """Return one request on one line: time, service, and outcome."""
    at = datetime.fromtimestamp(row.at).astimezone().strftime("%H:%M:%S")
    if not row.service:
        return f"{at} {row.outcome}: {row.text}"
    outcome = row.text or (f"error 0x{row.error:x}" if row.error else duration(row.took_us) or "0")
    if row.outcome != "answered":
        outcome = f"{row.outcome}: {outcome}"
    return f"{at} {row.service} {row.target} < {row.source}: {outcome}"


def belongs(request: RequestRow, row: RouteRow | ConnectionRow) -> bool:
    """Return whether a request used a route or a connection."""
    if isinstance(row, ConnectionRow):
        return request.came_by == path_of(row)
    # The pattern ends with * where fewer than six bytes of the NetID have to match.
    prefix = row.pattern.partition("*")[0]
    is_target = not row.octets or request.target.startswith(prefix)
    return is_target and (request.transport, request.address) == (row.transport, row.address)


def summary(stations: list[RouterRow]) -> str:
    """Return the numbers of routes, connections and faults."""
    routes = [route for each in stations for route in each.routes]
    total = sum(each.total for each in stations)
    down = sum(route.state == "down" for route in routes)
    connections = sum(len(each.connections) for each in stations)
    parts = [count(total, "route") + (f", {down} down" if down else "")]
    parts.append(count(connections, "connection"))
    if interrupted := sum(row.count for each in stations for row in each.interruptions):
        parts.append(f"{count(interrupted, 'subscription')} interrupted")
    if warnings := sum(len(each.warnings) for each in stations):
        parts.append(count(warnings, "warning"))
    return ", ".join(parts)
