"""Routes and connections of stations as tables.  Pure: records in, rich renderables out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from rich.console import RenderableType
from rich.text import Text

from eap.appliance.control_routes import (
    ImportRow,
    NeighbourRow,
    RouteRow,
    RouterRow,
    TestResult,
    interruption_text,
)
from eap.cli import routes_text
from eap.cli.table import Column, TextTable

_STYLES = {"up": "green", "down": "bold red", "unknown": "dim", "client": "dim"}


def routes_tables(stations: Sequence[RouterRow]) -> Iterator[RenderableType]:
    """Yield what to print for the routers of *stations*, top to bottom."""
    yield _routes(stations)
    if any(each.connections for each in stations):
        yield ""
        yield _connections(stations)
    remarks = [f"{each.station}: {text}" for each in stations for text in _remarks(each)]
    if remarks:
        yield ""
        yield Text("Worth a look", style="bold")
        yield from map(Text, remarks)


def result_table(results: Iterable[tuple[str, TestResult]]) -> RenderableType:
    """Return what came of questions to targets, by station."""
    table = TextTable(
        "Station", "Target", Column("Round trip", is_number=True), Column("Says", wraps=True)
    )
    for station, result in results:
        said = Text(result.text, style="" if result.ok else _STYLES["down"])
        if result.hint:
            said.append(f"\n{result.hint}", style="none")
        target = f"{result.name} {result.target}".strip()
        table.add_row(station, target, routes_text.round_trip(result.rtt_us), said)
    return table


def neighbour_table(rows: Iterable[NeighbourRow]) -> RenderableType:
    """Return the routers of other hosts, and by which route they are reached."""
    table = TextTable(
        "Station",
        "Found",
        "NetID",
        "Address",
        Column("Version", rank=1),
        Column("Route", wraps=True),
    )
    for row in rows:
        route = Text(row.route or "none", style=_STYLES["up" if row.route else "unknown"])
        if row.is_learned:
            route.append(" (learned)", style="none")
        table.add_row(row.station, row.name, row.net_id, row.address, row.version, route)
    return table


def import_table(rows: Iterable[ImportRow], *, is_done: bool) -> RenderableType:
    """Return the routes of a file, and what became of each."""
    outcome_heading = "Added" if is_done else "Would be added"
    table = TextTable("Route", "NetID", "Via", Column(outcome_heading, wraps=True))
    for row in rows:
        outcome = Text(row.reason or "yes", style=_STYLES["down" if row.reason else "up"])
        table.add_row(row.name, row.net_id, row.via, outcome)
    return table


def _routes(stations: Sequence[RouterRow]) -> RenderableType:
    table = TextTable(
        "Station",
        "Route",
        Column("NetID", rank=2),
        Column("Door", rank=3),
        Column("Address", rank=4),
        "State",
        Column("Trip", rank=1, is_number=True),
        Column("Requests", is_number=True),
        Column("Errors", is_number=True),
    )
    for station in stations:
        own = station.station
        for row in station.routes:
            state = Text(row.state, style=_STYLES[row.state])
            trip = routes_text.round_trip(row.rtt_us)
            errors = Text(str(row.errors), style="red" if row.errors else "")
            table.add_row(
                own, row.name, row.pattern, routes_text.door(row), row.address, state, trip,
                str(row.requests), errors,
            )  # fmt: skip
            own = ""
        if not station.routes:
            table.add_row(own, Text("none", style="dim"))
    return table


def _connections(stations: Sequence[RouterRow]) -> RenderableType:
    table = TextTable(
        "Station",
        "Connection",
        Column("Door", rank=3),
        Column("NetIDs", rank=1),
        Column("For", is_number=True),
        Column("Requests", is_number=True),
        Column("Octets", rank=2, is_number=True),
        Column("Errors", is_number=True),
    )
    for station in stations:
        own = station.station
        for row in station.connections:
            table.add_row(
                own, row.address, routes_text.door(row), "\n".join(row.net_ids),
                routes_text.age(row.since_s), str(row.requests),
                routes_text.octets(row), str(row.errors),
            )  # fmt: skip
            own = ""
    return table


def _remarks(station: RouterRow) -> Iterator[str]:
    for each in station.interruptions:
        yield f"{interruption_text(each)}, for {routes_text.age(each.since_s)}"
    yield from station.warnings
    yield from _dead_hops(station.routes)
    for row in station.routes:
        if row.last_error:
            yield f"{row.name}, last error: {row.last_error}"
    for connection in station.connections:
        if connection.last_error:
            yield f"{routes_text.way(connection)}, last error: {connection.last_error}"


def _dead_hops(routes: Sequence[RouteRow]) -> Iterator[str]:
    """Yield one remark for each next hop that is down, whatever number of routes lead by it."""
    by_hop: dict[tuple[str, str], list[RouteRow]] = {}
    for row in routes:
        if row.state == "down":
            by_hop.setdefault((row.door, row.address), []).append(row)
    for first, *others in by_hop.values():
        name = first.next_name or first.name
        beyond = dict.fromkeys(row.name for row in (first, *others) if row.name != name)
        text = f"; so are the routes by it: {', '.join(beyond)}" if beyond else ""
        yield f"{name} ({routes_text.way(first)}) is down: {first.why}{text}"
