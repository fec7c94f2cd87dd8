"""Stations, PDs, buses and events of running plants on a screen, with details of the chosen row."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import ClassVar, TypeAlias

from rich.text import Text
from textual import on, work
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import DataTable, Footer, Input, Static

from eap.cli.dialogs import FilteredScreen, Message, Question
from eap.cli.output import value_text
from eap.cli.top_model import (
    COLUMNS,
    SEVERITY_STYLES,
    EventRow,
    Tab,
    TopLine,
    TopModel,
    clock,
    event_text,
    sort_keys,
)
from eap.cli.top_tui.grid import Grid, GridColumn
from eap.cli.top_tui.recording import (
    RecordedThing,
    RecordForm,
    end_recording,
    find_recording,
    start_recording_of,
    thing_of,
)
from eap.errors import EapError
from eap.live.events import LiveEvent
from eap.live.findings import Severity
from eap.live.rows import BusRow, PdFlow, Row, StationRow
from eap.quantities import duration
from eap.runtime.recordings import RecordingState

TABS = {
    Tab.STATIONS: "1 Stations",
    Tab.PDS: "2 PDs",
    Tab.BUSES: "3 Buses",
    Tab.ROUTES: "4 Routes",
    Tab.EVENTS: "5 Events",
}
_SCROLLBAR = 1
"""Columns that one takes when there are more rows than lines."""
_MINUTE_WIDTHS = {80: 12, 100: 20, 130: 30}
"""Characters for the last minute of a station, from a width of the screen on."""
_LINES_PER_EVENT = 10
"""So many lines of the screen are there for each of the latest events below the table."""
Styled: TypeAlias = tuple[str, str]
"""Text and style."""

HELP = """\
1 to 5    stations, PDs, buses, routes, events; Tab goes on
↑ ↓       choose a row; its details are below the table
Enter     the PDs of the chosen station; Esc goes back
/         show rows that fit: a name, or KEY>NUMBER such as lost>0,
          age>5ms, state!=OP, name=island*; all of several words
< >       sort by the next column; o turns the order round
space     pause: the screen stays as it is
z Z       count lost and late from now on, here only; Z: from the start
r         record the chosen station, PD or bus, or end that (--write)
+ -       refresh more often, less often
? F1      this help
q         quit

Last minute: a bar for the rate, ! for lost or late PDs, · for none.
Left out columns: a wider terminal shows them."""


class OverviewScreen(FilteredScreen):
    """Tables of a model.

    Args:
        model: Content.
        events: All events, the latest last.
        record_refusal: Why nothing is recorded from here; empty if it is.

    Attributes:
        tab: View that is shown.
        values: Values of the chosen PD, by variable, or the reason that there are none.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        # With priority it is handled at once, so that the next keys are for the field.
        Binding("slash", "filter", "Filter", key_display="/", priority=True),
        Binding("less_than_sign", "sort(-1)", "Sort", key_display="< >"),
        Binding("greater_than_sign", "sort(1)", "Sort", show=False),
        Binding("o", "reverse", "Order", show=False),
        Binding("z", "zero", "Zero"),
        Binding("Z", "total", "Total", show=False),
        Binding("r", "record", "Record", show=False),
        Binding("space", "pause", "Pause", key_display="space"),
        Binding("tab", "next_tab", "Next view", show=False, priority=True),
        Binding("question_mark,f1", "app.help", "Help", key_display="?"),
    ]

    def __init__(
        self, model: TopModel, events: Sequence[LiveEvent], record_refusal: str = ""
    ) -> None:
        super().__init__()
        self._record_refusal = record_refusal
        self.tab = Tab.STATIONS
        self.values: dict[str, object] | str = {}
        self._model = model
        self._events = events
        self._is_complete = False
        self._is_paused = False
        self._period = ""
        self._drilled_from: str | None = None

    def compose(self) -> ComposeResult:
        """Yield the parts of the screen, top to bottom."""
        yield Static(id="head", markup=False)
        yield Static(id="views")
        yield Input(placeholder="a name, lost>0, age>5ms, state!=OP …", id="filter", compact=True)
        yield Grid("table")
        with VerticalScroll(id="detail"):
            yield Static(id="message")
        yield Static(id="events", markup=False)
        yield Footer(compact=True)

    @property
    def _grid(self) -> Grid[TopLine]:
        return self.query_one("#table", Grid)

    @property
    def chosen(self) -> TopLine | None:
        """The row that the cursor is on; None before the screen is complete."""
        return self._grid.chosen if self._is_complete else None

    def on_mount(self) -> None:
        """Show what is known."""
        field = self.query_one("#filter", Input)
        field.display = False
        field.value = self._model.match
        self._is_complete = True
        self._grid.focus()
        self.show()

    def on_resize(self) -> None:
        """Fit the table to the new size."""
        self.call_after_refresh(self.show)

    def on_screen_resume(self) -> None:
        """Show what has changed meanwhile."""
        self.call_after_refresh(self.show)

    def show_tab(self, tab: Tab) -> None:
        """Show another view."""
        self.tab = tab
        self.values = {}
        self.show()

    def show_period(self, period_s: float) -> None:
        """Show how often the screen is refreshed."""
        self._period = f"{period_s:g} s"
        self.show()

    def refresh_rows(self) -> None:
        """Show another report, unless the screen is paused."""
        if not self._is_paused:
            self.show()

    def show(self) -> None:
        """Show the model."""
        # Reports may come before the parts of the screen are there.
        if not self._is_complete:
            return
        width = self.size.width - _SCROLLBAR
        minute = max((n for at, n in _MINUTE_WIDTHS.items() if self.size.width >= at), default=8)
        problem = ""
        try:
            found = self._model.lines(self.tab, self._events, minute)
        except ValueError as exc:
            found, problem = [], f"filter: {exc}"
        columns = dict(self._columns())
        self._grid.show_lines(columns, found, width)
        self._show_head(problem)
        self._show_detail()
        number = self.size.height // _LINES_PER_EVENT
        latest = list(self._events)[-number:] if number else []
        lines = [Text(f" {event_text(each)}", SEVERITY_STYLES[each.severity]) for each in latest]
        for line in lines:
            line.truncate(width, overflow="ellipsis")
        lines += [Text()] * (number - len(lines))
        self.query_one("#events", Static).update(Text("\n").join(lines))

    def _columns(self) -> Iterator[tuple[int, GridColumn]]:
        for number, column in enumerate(COLUMNS[self.tab]):
            heading = column.heading
            if column.key and column.key == self._model.sort_key:
                heading += "▲" if self._model.is_reversed else "▼"
            most = column.most and max(column.most, len(heading))
            yield number, GridColumn(heading, column.least, most, column.is_number, column.rank)

    def _show_head(self, problem: str) -> None:
        text = Text(f" {problem or self._model.head()}", style="bold red" if problem else "")
        notes = [self._period]
        if self._model.since is not None:
            notes.insert(0, f"since {clock(self._model.since.time)}")
        if self._is_paused:
            notes.insert(0, "PAUSED")
        right = f" {' '.join(notes)} "
        # The notes on the right stay: they say that the figures are not all.
        text.truncate(self.size.width - len(right), overflow="ellipsis", pad=True)
        text.append(right, "bold" if len(notes) > 1 else "")
        self.query_one("#head", Static).update(text)
        report = self._model.report
        self._grid.set_class(report is not None and bool(report.unreachable), "stale")
        parts = [
            f"[@click=app.tab('{tab}')]{'[reverse]' if tab is self.tab else ''} {name} "
            f"{'[/]' if tab is self.tab else ''}[/]"
            for tab, name in TABS.items()
        ]
        if self._model.match:
            # A bracket would begin markup.
            match = self._model.match.replace("[", "")
            parts.append(f"[@click=screen.filter()] Filter: {match} [/]")
        self.query_one("#views", Static).update("".join(parts))

    @on(DataTable.RowHighlighted)
    def _show_detail(self) -> None:
        lines = list(self._detail())
        text = Text("\n").join(Text(part, style=style) for part, style in lines)
        self.query_one("#message", Static).update(text)

    def _detail(self) -> Iterator[Styled]:
        line = self.chosen
        if line is None:
            if self.tab is Tab.EVENTS:
                yield "no events since this view began", ""
            return
        row = line.row
        if isinstance(row, StationRow):
            yield from self._station_detail(row)
        elif isinstance(row, PdFlow):
            yield from self._pd_detail(row)
        elif isinstance(row, BusRow):
            yield from self._bus_detail(row)
        elif isinstance(row, EventRow):
            yield f"{clock(row.time)} {row.where} of {row.plant}", "bold"
            yield row.what, SEVERITY_STYLES[Severity(row.severity)]
            if row.advice:
                yield row.advice, ""

    def _station_detail(self, row: StationRow) -> Iterator[Styled]:
        station = self._model.station(row)
        if station is None:
            yield f"{row.name}: its appliance does not answer; the last figures are shown", "bold"
            return
        spread = station.get("lateness_us", {})
        cycle = f"cycle {duration(station['cycle_us'])}"
        if spread.get("p99") is not None:
            cycle += f", late by {duration(spread['p50'])} (p99 {duration(spread['p99'])})"
        yield f"{row.name}  {station['net_id']}  {cycle}", "bold"
        yield from self._model.findings_of(row.name, row.plant)
        for flow in self._model.flows(row.plant, row.name):
            yield _flow_text(flow)

    def _pd_detail(self, row: PdFlow) -> Iterator[Styled]:
        station = self._model.station(row)
        if station is None:
            return
        arrow = "received by" if row.direction == "rx" else "sent by"
        yield f"{row.name} {arrow} {row.station}/{row.port}: {row.total}", "bold"
        found = next(each for each in station["pd"][row.direction] if each["name"] == row.name)
        yield from _pd_facts(found, row.direction)
        if isinstance(self.values, str):
            yield self.values, "red"
        else:
            for name, value in self.values.items():
                yield f"{name:24} {value_text(value)}", ""

    def _bus_detail(self, row: BusRow) -> Iterator[Styled]:
        yield f"{row.station}/{row.port} {row.name}", "bold"
        if row.fault:
            yield row.fault, "red"
        if row.name and row.target:
            yield f"{row.state}, kept in {row.target} by the master", ""
        yield from self._model.findings_of(f"{row.station}/{row.port}", row.plant)

    def on_data_table_row_selected(self) -> None:
        """Go from a station to its PDs."""
        line = self.chosen
        if line is not None and isinstance(line.row, StationRow):
            self._drilled_from = self._model.match
            self._set_match(f"station={line.row.name}")
            self.show_tab(Tab.PDS)

    @on(Input.Changed, "#filter")
    def _apply_filter(self, event: Input.Changed) -> None:
        if event.value.strip() != self._model.match:
            self._model.match = event.value.strip()
            self.show()

    def key_escape(self) -> None:
        """End the filter, and go back from the PDs of a station."""
        before, self._drilled_from = self._drilled_from, None
        self._set_match(before or "")
        self._leave_filter()
        if before is not None and self.tab is Tab.PDS:
            self.show_tab(Tab.STATIONS)
        else:
            self.show()

    def _set_match(self, match: str) -> None:
        self._model.match = match
        self.query_one("#filter", Input).value = match

    def action_sort(self, step: int) -> None:
        """Sort by the next or the previous column; beyond the last one, not at all."""
        keys = ["", *sort_keys(self.tab)]
        at = keys.index(self._model.sort_key) if self._model.sort_key in keys else 0
        self._model.sort_key = keys[(at + step) % len(keys)]
        self.show()

    def action_reverse(self) -> None:
        """Turn the order round."""
        self._model.is_reversed = not self._model.is_reversed
        self.show()

    def action_zero(self) -> None:
        """Count from now on."""
        self._model.count_from_now()
        self.show()

    def action_total(self) -> None:
        """Count from the start of the plant."""
        self._model.since = None
        self.show()

    def action_pause(self) -> None:
        """Stop refreshing the screen, or go on."""
        self._is_paused = not self._is_paused
        self.show()

    def action_record(self) -> None:
        """Record what is chosen, or end its recording."""
        if self._record_refusal:
            self.app.push_screen(Message("Record", self._record_refusal))
            return
        thing = thing_of(self.chosen.row) if self.chosen is not None else None
        if thing is None:
            self.app.push_screen(Message("Record", "Choose a station, a PD or a bus first."))
        else:
            self._look_for_recording(thing)

    @work(thread=True, exclusive=True)
    def _look_for_recording(self, thing: RecordedThing) -> None:
        state = find_recording(thing)
        if state is None:
            self.app.call_from_thread(self._ask_for_target, thing)
        else:
            self.app.call_from_thread(self._ask_to_end, state)

    def _ask_for_target(self, thing: RecordedThing) -> None:
        target = Path.cwd() / f"{thing.file_name}-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
        self.app.push_screen(RecordForm(thing, target, start_recording_of), self._show_recording)

    def _ask_to_end(self, state: RecordingState) -> None:
        def answered(is_wanted: bool | None) -> None:
            if is_wanted:
                self._end_recording(state.name)

        target = state.files[-1] if state.files else "no file yet"
        self.app.push_screen(Question(f"End recording {state.name!r} ({target})?"), answered)

    @work(thread=True)
    def _end_recording(self, name: str) -> None:
        try:
            text = end_recording(name)
        except EapError as exc:
            text = str(exc)
        self.app.call_from_thread(self._show_recording, text)

    def _show_recording(self, text: str | None) -> None:
        if text:
            self.app.push_screen(Message("Record", text))

    def action_next_tab(self) -> None:
        """Show the next view."""
        tabs = list(Tab)
        self.app.action_tab(tabs[(tabs.index(self.tab) + 1) % len(tabs)])  # type: ignore[attr-defined]


def _flow_text(flow: PdFlow) -> Styled:
    arrow = "←" if flow.direction == "rx" else "→"
    per_s = "" if flow.per_s is None else f"{flow.per_s:g} Hz"
    parts = [f"{arrow} {flow.name:20.20} {flow.state:8} {per_s:>8}"]
    if flow.age_us is not None:
        parts.append(f"age {duration(flow.age_us):>8}")
    style = "red" if flow.state == "stale" else ""
    for number, word in ((flow.lost, "lost"), (flow.late, "late"), (flow.dropped, "dropped")):
        if number:
            parts.append(f"{number} {word}")
            style = style or "yellow"
    return "  ".join(parts), style


def _pd_facts(found: Row, direction: str) -> Iterator[Styled]:
    if direction == "tx":
        reasons = ", ".join(f"{n} {why.replace('_', ' ')}" for why, n in found["reason"].items())
        yield f"frame {found['frame']}; sent: {reasons or 'never'}; skipped: {found['skipped']}", ""
        return
    facts = [f"from {found['source'] or 'nobody yet'}"]
    facts += [
        f"{found[key]} {key}" for key in ("duplicated", "reordered", "repeated") if found[key]
    ]
    if found["timeouts"]:
        facts.append(f"timed out {found['timeouts']} times")
    facts += [f"{n} dropped: {why.replace('_', ' ')}" for why, n in found["discarded"].items()]
    yield "; ".join(facts), ""
    times = found.get("response_us") or found["jitter_us"]
    if times["p99"] is not None:
        word = "response" if found.get("response_us") else "jitter"
        spread = " / ".join(duration(times[key]) for key in ("p50", "p99", "max"))
        yield f"{word} p50 / p99 / max: {spread}", ""
