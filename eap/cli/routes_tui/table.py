"""Rows and columns of the live view's table, and its widget, which keeps the cursor.

The functions that make rows are pure: records in, texts out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

from rich.text import Text
from textual.widgets import DataTable

from eap.cli import routes_view
from eap.control.protocol import AnswerT, Method, ParametersT
from eap.control.routes import (
    ROUTES_ADD,
    ROUTES_REMOVE,
    ROUTES_TEST,
    ConnectionRow,
    RouteRow,
    RouterRow,
    TestResult,
)
from eap.errors import EapError
from eap.ops.client import connect_station
from eap.ops.routing import list_routes

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


_GAP = 1
_EXTRA = 6
"""Columns from this rank on are shown only where no text has to be cut for them."""
_READABLE = 12
"""A text is not cut to less than that while another column can be left out."""


class View(StrEnum):
    """Content of the table."""

    ROUTES = "routes"
    CONNECTIONS = "connections"
    WARNINGS = "warnings"


class GridColumn(NamedTuple):
    """A column.

    Attributes:
        heading: Above it.
        least: Minimum width.
        most: Maximum width; 0 uses the rest.
        is_number: It is aligned to the right.
        rank: 0 is always shown; a narrow screen omits the highest rank first.
    """

    heading: str
    least: int
    most: int
    is_number: bool = False
    rank: int = 0


class Line(NamedTuple):
    """A row of a table."""

    key: str
    router: PlantRouter
    row: RouteRow | ConnectionRow | None
    """None for a warning."""
    cells: tuple[str, ...]
    state: str
    """``up``, ``down``, ``unknown``, or empty: its style."""


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


def fit(
    view: View, found: Sequence[Line], width: int, *, has_station: bool
) -> list[tuple[int, GridColumn, int]]:
    """Return number, column and width of the columns that fit in *width* characters.

    Columns are as wide as they need to be.  Where that is too wide, extra columns are left out, and
    then long texts give way, the longest first; but before they become unreadable, more columns are
    left out, those of the highest rank first.
    """
    chosen = {
        number: column
        for number, column in enumerate(COLUMNS[view])
        if has_station or column is not _STATION
    }
    while (sizes := _sizes(chosen, found)) and _total(sizes.values()) > width:
        worst = max(chosen, key=lambda number: chosen[number].rank)
        rank = chosen[worst].rank
        is_readable = _total(min(size, _READABLE) for size in sizes.values()) <= width
        if not rank or (rank < _EXTRA and is_readable):
            break
        del chosen[worst]
    while (excess := _total(sizes.values()) - width) > 0:
        spare = {number: size - chosen[number].least for number, size in sizes.items()}
        widest = max(spare, key=lambda number: (spare[number], sizes[number]))
        if spare[widest] <= 0:
            break
        sizes[widest] -= 1
    last = next(reversed(chosen))
    if not chosen[last].most and excess < 0:
        sizes[last] -= excess
    return [(number, column, sizes[number]) for number, column in chosen.items()]


def _sizes(chosen: Mapping[int, GridColumn], found: Sequence[Line]) -> dict[int, int]:
    """Return the width that each column needs, between its bounds."""
    sizes = {}
    for number, column in chosen.items():
        needed = max((len(line.cells[number]) for line in found), default=0)
        needed = max(needed, len(column.heading), column.least if column.is_number else 0)
        sizes[number] = min(needed, column.most) if column.most else column.least
    return sizes


def _total(sizes: Iterable[int]) -> int:
    return sum(size + _GAP for size in sizes)


def cut(text: str, size: int, *, is_number: bool) -> str:
    """Return *text* in *size* characters."""
    if len(text) > size:
        text = f"{text[: size - 1]}…"
    return text.rjust(size) if is_number else text


def _route_line(router: PlantRouter, row: RouteRow) -> Line:
    station = router.routes.station
    key = f"{router.plant}/{station}/{row.net_id}/{row.transport}/{row.address}"
    cells = (
        station, row.name, row.pattern, routes_view.transport_of(row),
        "?" if row.state == "unknown" else row.state,
        routes_view.round_trip(row.rtt_us), routes_view.short(row.requests),
        routes_view.octets_of(row), routes_view.short(row.errors), row.address, row.origin,
        row.last_error,
    )  # fmt: skip
    return Line(key, router, row, cells, row.state)


def _connection_line(router: PlantRouter, row: ConnectionRow) -> Line:
    station = router.routes.station
    key = f"{router.plant}/{station}/{row.transport}/{row.address}"
    cells = (
        station, row.address, routes_view.transport_of(row), " ".join(row.net_ids),
        routes_view.age(row.since_s), routes_view.short(row.requests),
        routes_view.octets_of(row), routes_view.short(row.errors), row.last_error,
    )  # fmt: skip
    return Line(key, router, row, cells, "")


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


STYLES = {
    "up": "green",
    "down": "bold red",
    "unknown": "dim",
    "client": "dim",
    "bold": "bold",
    "": "",
}
"""Colours of texts, by their content."""


class Grid(DataTable[Text]):
    """Lines of a view, one of them chosen."""

    def __init__(self, name: str) -> None:
        super().__init__(id=name, cursor_type="row", cell_padding=0)
        self._lines: Sequence[Line] = ()
        self._fitted: list[tuple[int, GridColumn, int]] = []

    @property
    def chosen(self) -> Line | None:
        """The line that the cursor is on."""
        at = self.cursor_row
        return self._lines[at] if 0 <= at < len(self._lines) else None

    def show_lines(
        self, view: View, found: Sequence[Line], width: int, *, has_station: bool
    ) -> None:
        """Show *found* in *width* characters; the cursor stays on its line if that is there."""
        fitted = fit(view, found, width, has_station=has_station)
        before, chosen = [line.key for line in self._lines], self.chosen
        self._lines = found
        cells = [
            [
                Text(cut(line.cells[number], size, is_number=column.is_number),
                     style=STYLES[line.state] if column.heading == "State" else "")
                for number, column, size in fitted
            ]
            for line in found
        ]  # fmt: skip
        # Rebuilding moves cursor and scroll position; usually only cells have changed.
        if (fitted, [line.key for line in found]) != (self._fitted, before):
            self._fitted = fitted
            self._lay_out(cells, chosen)
            return
        for number, row in enumerate(cells):
            for place, cell in enumerate(row):
                if self.get_cell_at((number, place)) != cell:  # type: ignore[arg-type]
                    self.update_cell_at((number, place), cell)  # type: ignore[arg-type]

    def _lay_out(self, cells: list[list[Text]], chosen: Line | None) -> None:
        at = max(self.cursor_row, 0)
        self.clear(columns=True)
        for _, column, size in self._fitted:
            heading = cut(column.heading, size, is_number=column.is_number)
            self.add_column(Text(heading, style="bold"), width=size + 1)
        self.add_rows(cells)
        # By key and not by number: the cursor stays on its route when others come and go.
        keys = [line.key for line in self._lines]
        if chosen is not None and chosen.key in keys:
            at = keys.index(chosen.key)
        self.move_cursor(row=max(min(at, len(keys) - 1), 0))
