"""Rows and columns of the live view of routes.

The functions that make rows are pure: records in, texts out.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable, Sequence
from enum import StrEnum
from functools import partial
from typing import Any, NamedTuple, Protocol

from eap.cli import routes_view
from eap.cli.top_tui.grid import GridColumn
from eap.control.protocol import HELLO, AnswerT, Method, ParametersT
from eap.control.routes import (
    ROUTES_ADD,
    ROUTES_LIST,
    ROUTES_REMOVE,
    ROUTES_TEST,
    ConnectionRow,
    RouteRow,
    RouterRow,
    TestResult,
)
from eap.errors import ControlError, EapError
from eap.live.ads_connection import AdsConnection, RemoteHost
from eap.live.client import LiveClient
from eap.ops.client import connect_station
from eap.ops.routing import list_routes
from eap.quantities import duration

MOST = 500
"""Routes of a station that are shown; a filter finds the others."""
_REQUESTS = 256
_TEST_MS = 5000
_TEST_S = 10.0


class PlantRouter(NamedTuple):
    """The router of one station, and the plant of its appliance."""

    plant: str
    routes: RouterRow


class Snapshot(NamedTuple):
    """Content of the view; *problem* is the error of the last request."""

    routers: list[PlantRouter]
    problem: str = ""


class RouteRequests(Protocol):
    """Requests of the view; they block."""

    def fetch(self, match: str) -> Snapshot:
        """Return all routers, with those of their routes that *match*; never raises EapError."""

    def add(self, router: PlantRouter, params: dict[str, Any]) -> list[str]:
        """Add a route, and return the warnings; raise EapError if refused."""

    def remove(self, router: PlantRouter, route: str, transport: str, address: str) -> None:
        """Remove a route; raise EapError if refused."""

    def test(self, router: PlantRouter, target: str) -> TestResult:
        """Test the path to *target* within seconds; raise EapError if refused."""


class RouterClient:
    """The running appliances, or the one that runs *plant*."""

    def __init__(self, plant: str | None) -> None:
        self._plant = plant

    def fetch(self, match: str) -> Snapshot:
        """Return all routers, with those of their routes that *match*; never raises EapError."""
        try:
            found = list_routes(self._plant, None, match, requests=_REQUESTS, most=MOST)
        except EapError as exc:
            return Snapshot([], str(exc))
        return Snapshot([PlantRouter(each.plant, row) for each in found for row in each.stations])

    def add(self, router: PlantRouter, params: dict[str, Any]) -> list[str]:
        """Add a route, and return the warnings; raise EapError if refused."""
        return self._call(router, ROUTES_ADD, **params).warnings

    def remove(self, router: PlantRouter, route: str, transport: str, address: str) -> None:
        """Remove a route; raise EapError if refused."""
        self._call(router, ROUTES_REMOVE, route=route, transport=transport, address=address)

    def test(self, router: PlantRouter, target: str) -> TestResult:
        """Test the path to *target* within seconds; raise EapError if refused."""
        return self._call(router, ROUTES_TEST, target=target, timeout_ms=_TEST_MS)

    def _call(
        self, router: PlantRouter, method: Method[ParametersT, AnswerT], **params: Any
    ) -> AnswerT:
        station = router.routes.station
        with connect_station(station, router.plant) as client:
            return client.call(method, within_s=_TEST_S, station=station, **params)


class RemoteRouters:
    """Routers of other hosts, by ADS: they are shown, and changed on their hosts only.

    Args:
        hosts: ``HOST[:NETID]`` of each.
    """

    def __init__(self, hosts: Sequence[str]) -> None:
        self._hosts = [RemoteHost.parse(host) for host in hosts]

    def fetch(self, match: str) -> Snapshot:
        """Return all routers, with those of their routes that *match*; never raises EapError."""
        return asyncio.run(self._fetch(match))

    def add(self, router: PlantRouter, params: dict[str, Any]) -> list[str]:
        """Refuse with ControlError."""
        raise _elsewhere(router)

    def remove(self, router: PlantRouter, route: str, transport: str, address: str) -> None:
        """Refuse with ControlError."""
        raise _elsewhere(router)

    def test(self, router: PlantRouter, target: str) -> TestResult:
        """Refuse with ControlError."""
        raise _elsewhere(router)

    async def _fetch(self, match: str) -> Snapshot:
        found = await asyncio.gather(*(self._routers(host, match) for host in self._hosts))
        routers = {
            (each.plant, each.routes.station): each
            for snapshot in found
            for each in snapshot.routers
        }
        problems = "; ".join(snapshot.problem for snapshot in found if snapshot.problem)
        return Snapshot([*routers.values()], problems)

    async def _routers(self, host: RemoteHost, match: str) -> Snapshot:
        client = LiveClient(partial(AdsConnection.open, host))
        try:
            plant = (await client.call(HELLO)).plant
            rows = await client.call(ROUTES_LIST, match=match, count=MOST, requests=_REQUESTS)
        except EapError as exc:
            return Snapshot([], f"{host}: {exc}")
        finally:
            await client.close()
        return Snapshot([PlantRouter(plant, row) for row in rows])


def _elsewhere(router: PlantRouter) -> ControlError:
    return ControlError(f"{router.routes.station} runs on another host: use 'eapctl routes' there")


class View(StrEnum):
    """Content of the table."""

    ROUTES = "routes"
    CONNECTIONS = "connections"
    WARNINGS = "warnings"


class Line(NamedTuple):
    """A row of a table."""

    key: str
    router: PlantRouter
    row: RouteRow | ConnectionRow | None
    """None for a warning."""
    cells: tuple[str, ...]
    state: str
    """``up``, ``down``, ``unknown``, or empty: its style."""

    def style_of(self, number: int) -> str:
        """Return the style of a text, empty for none."""
        return STYLES[self.state] if number == _STATE and self.state else ""


_STATION = GridColumn("Station", 7, 14)
COLUMNS = {
    View.ROUTES: (
        _STATION,
        GridColumn("Route", 8, 20),
        GridColumn("NetID", 11, 23, rank=1),
        GridColumn("Transport", 9, 16, rank=3),
        GridColumn("State", 5, 7),
        GridColumn("RTT", 7, 8, is_number=True, rank=2),
        GridColumn("Reqs", 5, 5, is_number=True, rank=4),
        GridColumn("Bytes", 6, 6, is_number=True, rank=5),
        GridColumn("Errors", 6, 6, is_number=True),
        GridColumn("Address", 12, 21, rank=6),
        GridColumn("Origin", 7, 7, rank=7),
        GridColumn("Last error", 20, 0, rank=8),
    ),
    View.CONNECTIONS: (
        _STATION,
        GridColumn("Connection", 16, 26),
        GridColumn("Transport", 9, 16, rank=3),
        GridColumn("NetIDs", 12, 23, rank=1),
        GridColumn("For", 6, 8, is_number=True, rank=2),
        GridColumn("Reqs", 5, 5, is_number=True),
        GridColumn("Bytes", 6, 6, is_number=True, rank=4),
        GridColumn("Errors", 6, 6, is_number=True),
        GridColumn("Last error", 20, 0, rank=5),
    ),
    View.WARNINGS: (_STATION, GridColumn("Warning", 30, 0)),
}


_STATE = 4
"""Number of the column of a route's state."""


def columns_of(view: View, *, has_station: bool) -> dict[int, GridColumn]:
    """Return the columns of *view* by number."""
    return {
        number: column
        for number, column in enumerate(COLUMNS[view])
        if has_station or column is not _STATION
    }


def lines(view: View, routers: Iterable[PlantRouter], match: str) -> list[Line]:
    """Return the rows of *view*; routes are filtered by *match* already."""
    found = []
    for router in routers:
        if view is View.ROUTES:
            found += [_route_line(router, row) for row in router.routes.routes]
        elif view is View.CONNECTIONS:
            found += [_connection_line(router, row) for row in router.routes.connections]
        else:
            found += [
                Line(f"{router.plant}/{router.routes.station}/{text}", router, None,
                     (router.routes.station, text), "down")
                for text in router.routes.warnings
            ]  # fmt: skip
    if view is View.ROUTES:
        return found
    return [line for line in found if match.lower() in " ".join(line.cells).lower()]


def _route_line(router: PlantRouter, row: RouteRow) -> Line:
    station = router.routes.station
    key = f"{router.plant}/{station}/{row.net_id}/{row.transport}/{row.address}"
    cells = (
        station, row.name, row.pattern, routes_view.transport_of(row),
        "?" if row.state == "unknown" else row.state,
        duration(row.rtt_us), routes_view.short(row.requests),
        routes_view.octets_of(row), routes_view.short(row.errors), row.address, row.origin,
        row.last_error,
    )  # fmt: skip
    return Line(key, router, row, cells, row.state)


def _connection_line(router: PlantRouter, row: ConnectionRow) -> Line:
    station = router.routes.station
    key = f"{router.plant}/{station}/{row.transport}/{row.address}"
    cells = (
        station, row.address, routes_view.transport_of(row), " ".join(row.net_ids),
        routes_view.elapsed(row.since_s), routes_view.short(row.requests),
        routes_view.octets_of(row), routes_view.short(row.errors), row.last_error,
    )  # fmt: skip
    return Line(key, router, row, cells, "")


STYLES = {
    "up": "green",
    "down": "bold red",
    "unknown": "dim",
    "client": "dim",
    "bold": "bold",
    "": "",
}
"""Colours of texts, by their content."""


def detail(line: Line | None) -> list[tuple[str, str]]:
    """Return the details of a row: texts with their styles."""
    if line is None:
        return []
    row = line.row
    if row is None:
        return [(line.cells[1], "down")]
    if isinstance(row, RouteRow):
        texts = [
            (f"{row.name}  {row.pattern}  {routes_view.path_of(row)}", "bold"),
            (f"{routes_view.route_kind(row)}; {routes_view.route_state(row)}", row.state),
        ]
    else:
        clients = f"requests from {', '.join(row.net_ids)}" if row.net_ids else "no requests yet"
        texts = [(routes_view.path_of(row), "bold"), (clients, "")]
    texts.append((routes_view.figures(row), ""))
    if row.last_error:
        texts.append((routes_view.last_error(row), "down"))
    own = row.net_id if isinstance(row, RouteRow) else row.address
    texts += [(text, "down") for text in line.router.routes.warnings if own in text]
    requests = [each for each in line.router.routes.requests if routes_view.belongs(each, row)]
    texts += [
        (routes_view.request_line(each), "" if each.outcome == "answered" else "down")
        for each in reversed(requests)
    ]
    return texts
