"""Live view of routes: the table with the details of its current row, forms, and requests.

Each request connects anew, because appliances start and end while the view is open.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from time import monotonic
from typing import Any, ClassVar

from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical, VerticalScroll
from textual.widgets import Button, Checkbox, DataTable, Footer, Input, Label, Static

from eap.cli import routes_view
from eap.cli.dialogs import DialogForm, FilteredScreen, Message, Question
from eap.cli.routes_tui.table import (
    STYLES,
    Line,
    PlantRouter,
    RouteRequests,
    Snapshot,
    View,
    columns_of,
    detail,
    lines,
)
from eap.cli.top_tui.grid import Grid
from eap.control.routes import (
    RouteRow,
)
from eap.errors import EapError
from eap.quantities import duration

PERIOD_S = 1.0
"""Period of requests."""
STALE_AFTER_S = 2.5
"""Time without an answer after which the view says so."""
_ALL = "all stations"
_SCROLLBAR = 1
"""Columns that one takes when there are more rows than lines."""


class RoutesScreen(FilteredScreen):
    """Routes and connections of running stations.

    Args:
        client: Sends the requests.
        period_s: Period of requests.
        refusal: Why routes are not changed here; empty if they are.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("a", "add", "Add"),
        Binding("e", "edit", "Edit"),
        Binding("d,delete", "remove", "Remove", key_display="d"),
        Binding("t,enter", "test", "Test", key_display="t"),
        # With priority it is handled at once, so that the next keys are for the field.
        Binding("slash", "filter", "Filter", key_display="/", priority=True),
        Binding("s", "station", "Station", show=False),  # the line of the views names these four
        Binding("r", "view('routes')", "Routes", show=False),
        Binding("c", "view('connections')", "Connections", show=False),
        Binding("w", "view('warnings')", "Warnings", show=False),
        Binding("question_mark,f1", "help", "Help", key_display="?"),
    ]

    def __init__(
        self, client: RouteRequests, *, period_s: float = PERIOD_S, refusal: str = ""
    ) -> None:
        super().__init__()
        self._client = client
        self._refusal = refusal
        self._period_s = period_s
        self._snapshot = Snapshot([], "sending…")
        self._view = View.ROUTES
        self._station = _ALL
        self._match = ""
        self._requested_at: float | None = None

    def compose(self) -> ComposeResult:
        """Yield the parts of the screen, top to bottom."""
        yield Static(id="head", markup=False)
        yield Static(id="views")
        yield Input(placeholder="show only what has this in it", id="filter", compact=True)
        yield Grid("table")
        with VerticalScroll(id="detail"):
            yield Static(id="message")
        yield Footer(compact=True)

    @property
    def _grid(self) -> Grid[Line]:
        return self.query_one("#table", Grid)

    def on_mount(self) -> None:
        """Start the periodic requests."""
        self.query_one("#filter").display = False
        self._grid.focus()
        self.set_interval(self._period_s, self.fetch)
        self.fetch()

    def on_resize(self) -> None:
        """Fit the table to the new size."""
        self.call_after_refresh(self._show)

    def fetch(self) -> None:
        """Request the routes, unless a request is under way or another view is shown."""
        if self not in self.app.screen_stack:
            return
        # One request at a time: a station that does not answer must not pile up threads.
        if self._requested_at is None:
            self._requested_at = monotonic()
            self._look(self._match if self._view is View.ROUTES else "")
        elif (waited_s := monotonic() - self._requested_at) > STALE_AFTER_S:
            problem = f"no answer for {waited_s:.0f} s"
            self._snapshot = self._snapshot._replace(problem=problem)
            self._show()

    # The control client blocks; in Textual's own thread a slow answer would freeze the keyboard.
    @work(thread=True)
    def _look(self, match: str) -> None:
        snapshot = self._client.fetch(match)
        self.app.call_from_thread(self._take, snapshot)

    def _take(self, snapshot: Snapshot) -> None:
        self._requested_at = None
        if snapshot.problem:
            # The last rows stay on the screen, in another style, below the reason.
            snapshot = Snapshot(self._snapshot.routers, snapshot.problem)
        self._snapshot = snapshot
        self._show()

    def _routers(self) -> list[PlantRouter]:
        routers = self._snapshot.routers
        names = {each.routes.station for each in routers}
        if self._station in names:
            return [each for each in routers if each.routes.station == self._station]
        return routers

    def _show(self) -> None:
        """Refresh the screen."""
        routers = self._routers()
        found = lines(self._view, routers, self._match)
        self._show_head(routers)
        has_station = len(routers) > 1
        self._grid.show_lines(
            columns_of(self._view, has_station=has_station), found, self.size.width - _SCROLLBAR
        )
        self._show_detail()

    def _show_head(self, routers: list[PlantRouter]) -> None:
        stations = [each.routes for each in routers]
        plants = ", ".join(dict.fromkeys(each.plant for each in self._snapshot.routers))
        where = self._station if self._station != _ALL else f"{len(stations)} stations"
        text = Text(f" {plants}, {where}: {routes_view.summary(stations)}" if stations else " ")
        if self._snapshot.problem:
            text = Text(f" {self._snapshot.problem}", style="bold red")
        text.truncate(self.size.width, overflow="ellipsis")
        self.query_one("#head", Static).update(text)
        self.query_one("#table").set_class(bool(self._snapshot.problem), "stale")
        counts = {
            View.ROUTES: sum(each.total for each in stations),
            View.CONNECTIONS: sum(len(each.connections) for each in stations),
            View.WARNINGS: sum(len(each.warnings) for each in stations),
        }
        parts = [
            f"[@click=screen.view('{view}')]{'[reverse]' if view is self._view else ''}"
            f" {view[0]} {view.capitalize()} {counts[view]} "
            f"{'[/]' if view is self._view else ''}[/]"
            for view in View
        ]
        parts.append(f"[@click=screen.station()] s {self._station} [/]")
        if self._match:
            parts.append(f"[@click=screen.filter()] Filter: {self._match.replace('[', '')} [/]")
        self.query_one("#views", Static).update("".join(parts))

    @on(DataTable.RowHighlighted)
    def _show_detail(self) -> None:
        text = Text("\n").join(
            Text(part, style=STYLES[style]) for part, style in detail(self._grid.chosen)
        )
        self.query_one("#message", Static).update(text)

    def action_help(self) -> None:
        """Show what each key does."""
        self._show_problem("Keys", _HELP)

    def action_view(self, view: str) -> None:
        """Show routes, connections or warnings."""
        self._view = View(view)
        self._show()

    def action_station(self) -> None:
        """Show the next station alone, and after the last one all."""
        names = [_ALL, *dict.fromkeys(each.routes.station for each in self._snapshot.routers)]
        at = names.index(self._station) if self._station in names else 0
        self._station = names[(at + 1) % len(names)]
        self._show()

    @on(Input.Changed, "#filter")
    def _apply_filter(self, event: Input.Changed) -> None:
        self._match = event.value.strip()
        self._show()
        self.fetch()

    def key_escape(self) -> None:
        """End the filter."""
        field = self.query_one("#filter", Input)
        field.value = ""
        self._leave_filter()

    def action_add(self) -> None:
        """Open a form for a new route of the chosen station."""
        if self._is_refused("Add"):
            return
        if (router := self._router()) is not None:
            self._ask_for(router, f"New route of {router.routes.station}", {"octets": "4"})

    def action_edit(self) -> None:
        """Open a form for a change of the chosen route."""
        if self._is_refused("Edit"):
            return
        line = self._grid.chosen
        if line is None or not isinstance(line.row, RouteRow):
            self._show_problem("Edit", "Choose a route first.")
        elif line.row.origin != "added":
            self._show_problem("Edit", _KEPT_ELSEWHERE[line.row.origin].format(name=line.row.name))
        else:
            title = f"Route {line.row.name} of {line.router.routes.station}"
            self._ask_for(line.router, title, values_of(line.row))

    def action_remove(self) -> None:
        """Remove the chosen route after a confirmation."""
        if self._is_refused("Remove"):
            return
        line = self._grid.chosen
        if line is None or not isinstance(line.row, RouteRow):
            self._show_problem("Remove", "Choose a route first.")
            return
        row, router = line.row, line.router

        def answered(is_wanted: bool | None) -> None:
            if is_wanted:
                self._remove(router, row)

        station = router.routes.station
        text = f"Remove route {row.name} ({row.pattern}, {routes_view.path_of(row)}) of {station}?"
        self.app.push_screen(Question(text), answered)

    def _is_refused(self, title: str) -> bool:
        """Say why routes are not changed here; return whether that is so."""
        if self._refusal:
            self._show_problem(title, self._refusal)
        return bool(self._refusal)

    def action_test(self) -> None:
        """Measure the round trip to the chosen route's station."""
        line = self._grid.chosen
        if line is None or not isinstance(line.row, RouteRow):
            self._show_problem("Test", "Choose a route first.")
        elif not line.row.octets:
            self._show_problem("Test", "A default route leads to no station of its own.")
        else:
            self._test(line.router, line.row)

    def on_data_table_row_selected(self) -> None:
        """Test the row that Enter or a second click chooses."""
        self.action_test()

    @work(thread=True)
    def _remove(self, router: PlantRouter, row: RouteRow) -> None:
        try:
            self._client.remove(router, row.net_id, row.transport, row.address)
        except EapError as exc:
            self.app.call_from_thread(self._show_problem, "Remove", str(exc))
        self.app.call_from_thread(self.fetch)

    @work(thread=True)
    def _test(self, router: PlantRouter, row: RouteRow) -> None:
        try:
            result = self._client.test(router, row.net_id)
        except EapError as exc:
            text = str(exc)
        else:
            trip = f" in {duration(result.rtt_us)}" if result.ok else ""
            line = f"{result.target}{trip}: {result.text}"
            text = "\n".join(filter(None, [line, result.hint]))
        title = f"{router.routes.station} to {row.name}"
        self.app.call_from_thread(self._show_problem, title, text)
        self.app.call_from_thread(self.fetch)

    def _ask_for(self, router: PlantRouter, title: str, values: dict[str, Any]) -> None:
        def ended(warnings: list[str] | None) -> None:
            self.fetch()
            if warnings:
                self._show_problem("Added, but", "\n".join(warnings))

        form = RouteForm(title, values, lambda params: self._client.add(router, params))
        self.app.push_screen(form, ended)

    def _router(self) -> PlantRouter | None:
        line = self._grid.chosen
        if line is not None:
            return line.router
        routers = self._routers()
        return routers[0] if routers else None

    def _show_problem(self, title: str, text: str) -> None:
        self.app.push_screen(Message(title, text))


_HELP = """\
↑ ↓      choose a row
t Enter  test the chosen route: read the state of its station
a        add a route
e d      edit or remove a route that was added
/        show only rows that have a text in them; Esc ends that
s        show one station after the other, then all
r c w    show routes, connections, warnings
1 to 5   other views: stations, PDs, buses, routes, events
? F1     this help
q        quit
Left out columns: a wider terminal shows them."""

_KEPT_ELSEWHERE = {
    "static": "Route {name} is in the plant file: change it there.",
    "derived": "Route {name} follows from the ports in the plant file: write another one there.",
    "learned": "Route {name} is announced by the station itself.",
}


_FIELDS = {
    "name": ("Name", "press"),
    "net_id": ("NetID", "5.1.2.3.1.1; may be empty for a station of the plant"),
    "via": ("Via", "STATION/PORT, ams-tcp:HOST, ams-tls:HOST, udp:ADDRESS, mqtt:NETWORK"),
    "port": ("EAP port", "to leave by; may be empty"),
    "octets": ("Bytes", "of the NetID that must match: 4, 5 or 6; 0 for a default route"),
    "virtual": ("Virtual", "NetID that it has here (NAT); may be empty"),
    "timeout_ms": ("Time-out", "of an answer, in ms; may be empty"),
}
_KINDS_WITHOUT_PORT = {"ams-tcp", "ams-tls", "mqtt"}


class Tick(Checkbox):
    """A checkbox whose mark is visible without colours."""

    BUTTON_LEFT = "["
    BUTTON_INNER = " "
    BUTTON_RIGHT = "]"

    def watch_value(self) -> None:
        """Show the value."""
        self.BUTTON_INNER = "x" if self.value else " "
        super().watch_value()


class RouteForm(DialogForm[list[str]]):
    """The fields of a route; it stays until the route is taken, or the form is left.

    Its result is the warnings about the route, or None if it was cancelled.

    Args:
        title: Its heading.
        values: Of the fields at first, and ``replaces`` for a route that is to go.
        save: Sends the parameters of ``routes_add``, in a thread, and returns the warnings
            against them; raises EapError if refused.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "leave", "Cancel"),
        Binding("ctrl+s", "save", "Save"),
    ]

    def __init__(
        self, title: str, values: dict[str, Any], save: Callable[[dict[str, Any]], list[str]]
    ) -> None:
        super().__init__()
        self._title = title
        self._values = values
        self._save = save

    def compose(self) -> ComposeResult:
        """Yield a line for each field, and the buttons below."""
        with Vertical(classes="box"):
            yield Static(self._title, classes="title", markup=False)
            for name, (label, hint) in _FIELDS.items():
                with Horizontal(classes="field"):
                    yield Label(label)
                    value = str(self._values.get(name, "") or "")
                    yield Input(
                        value, placeholder=hint, id=name, compact=True, select_on_focus=False
                    )
            with Horizontal(classes="field"):
                is_probed = bool(self._values.get("probed", True))
                yield Tick("probe the next hop", is_probed, id="probed", compact=True)
                is_one_way = bool(self._values.get("unidirectional", False))
                yield Tick("one way only", is_one_way, id="unidirectional", compact=True)
            yield Static("", id="problem", markup=False)
            with Horizontal(classes="buttons"):
                yield Button("Save (^s)", id="save", compact=True)
                yield Button("Cancel (esc)", id="leave", compact=True)

    @on(Input.Submitted)
    @on(Button.Pressed, "#save")
    def action_save(self) -> None:
        """Send the route."""
        texts = {name: self.query_one(f"#{name}", Input).value.strip() for name in _FIELDS}
        try:
            numbers = {name: int(texts[name] or 0) for name in ("timeout_ms",)}
            numbers["octets"] = int(texts["octets"] or 4)
        except ValueError as exc:
            self.show_problem(f"expected a number: {exc}")
            return
        replaced = {"replaces": self._values.get("replaces", "")}
        ticks = {
            name: self.query_one(f"#{name}", Tick).value for name in ("probed", "unidirectional")
        }
        self.perform("sending…", partial(self._save, texts | numbers | replaced | ticks))


def values_of(row: RouteRow) -> dict[str, Any]:
    """Return the initial values of a form for a change of *row*."""
    kind, _, port = row.transport.partition(":")
    address = port if kind == "mqtt" else row.address
    return {
        "name": row.name,
        "net_id": row.real or row.net_id,
        "via": f"{kind}:{address}",
        "port": "" if kind in _KINDS_WITHOUT_PORT else port,
        "octets": str(row.octets),
        "virtual": row.net_id if row.real else "",
        "timeout_ms": row.timeout_ms,
        "probed": row.probed,
        "unidirectional": row.unidirectional,
        # The NetID may be edited too: the old route then goes with the same request.
        "replaces": row.net_id,
    }
