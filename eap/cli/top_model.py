"""Content of ``eapctl top``: what is shown of the live reports, as rows of texts.

Nothing here knows a terminal: reports in, rows out.  Rates and counts come from ``eap.live.rows``;
this module chooses, sorts and words them, and remembers the last minute of each station.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple, TypeVar

import msgspec

from eap.live.events import LiveEvent
from eap.live.findings import Severity, StatusReport
from eap.live.row_filter import RowFilter
from eap.live.rows import (
    BusRow,
    PdFlow,
    Row,
    StationKey,
    StationRow,
    bus_rows,
    key_of,
    pd_flows,
    station_rows,
)
from eap.live.view import LiveReport
from eap.quantities import count, duration, quality

MINUTE_NS = 60_000_000_000
GONE = "gone"
"""State of a station whose appliance does not answer."""
BARS = "▁▂▃▄▅▆▇█"
_RECORDING = "recording "
_LOSSY = "!"
_SILENT = "·"
_GOOD, _BAD, _WARN, _DIM = "green", "bold red", "yellow", "dim"
_STATE_STYLES = {
    "OP": _GOOD, "up": _GOOD, "running": _GOOD, "PREOP": _WARN, "SAFEOP": _WARN, "waiting": _WARN,
    "INIT": _BAD, "stale": _BAD, "down": _BAD, "lost": _BAD, "no cycles": _BAD, "gone": _BAD,
    "absent": _DIM, "unknown": _DIM,
}  # fmt: skip
SEVERITY_STYLES = {Severity.ERROR: _BAD, Severity.WARNING: _WARN, Severity.INFO: ""}

AnyRowT = TypeVar("AnyRowT", bound=msgspec.Struct)


class Tab(StrEnum):
    """View of the overview."""

    STATIONS = "stations"
    PDS = "pds"
    BUSES = "buses"
    ROUTES = "routes"
    EVENTS = "events"


class EventRow(msgspec.Struct, frozen=True):
    """An event, as filters and tables see it."""

    time: float
    severity: str
    plant: str
    where: str
    what: str
    advice: str


class TopColumn(NamedTuple):
    """A column of a table: the field that it sorts by, its heading, and its place on a screen.

    *least* and *most* are widths, 0 for the rest of the line; the highest *rank* is left out first.
    """

    key: str
    heading: str
    least: int
    most: int
    is_number: bool = False
    rank: int = 0


COLUMNS: Mapping[Tab, tuple[TopColumn, ...]] = {
    Tab.STATIONS: (
        TopColumn("name", "Station", 7, 20),
        TopColumn("state", "State", 5, 9),
        TopColumn("tx_per_s", "Tx/s", 5, 6, is_number=True),
        TopColumn("rx_per_s", "Rx/s", 5, 6, is_number=True),
        TopColumn("lost", "Lost", 5, 6, is_number=True),
        TopColumn("late", "Late", 5, 6, is_number=True),
        TopColumn("age_us", "Age", 7, 8, is_number=True),
        TopColumn("jitter_p99_us", "Jit p99", 7, 8, is_number=True, rank=2),
        TopColumn("bus", "Bus", 6, 12),
        TopColumn("", "Last minute", 11, 0, rank=1),
    ),
    Tab.PDS: (
        TopColumn("station", "Station", 7, 20),
        TopColumn("direction", "", 1, 1),
        TopColumn("name", "PD", 10, 24),
        TopColumn("state", "State", 5, 9),
        TopColumn("per_s", "Hz", 6, 6, is_number=True),
        TopColumn("lost", "Lost", 5, 6, is_number=True),
        TopColumn("late", "Late", 5, 6, is_number=True),
        TopColumn("age_us", "Age", 7, 8, is_number=True),
        TopColumn("jitter_p99_us", "Jit p99", 7, 8, is_number=True, rank=1),
        TopColumn("dropped", "Dropped", 7, 7, is_number=True, rank=2),
        TopColumn("quality", "Quality", 7, 8, is_number=True, rank=3),
        TopColumn("port", "Port", 5, 12, rank=4),
        TopColumn("total", "Total", 8, 10, is_number=True, rank=5),
    ),
    Tab.BUSES: (
        TopColumn("station", "Bus", 10, 24),
        TopColumn("address", "Addr", 5, 5, is_number=True),
        TopColumn("name", "Slave", 8, 20),
        TopColumn("state", "State", 6, 8),
        TopColumn("lost", "Lost", 5, 6, is_number=True, rank=1),
        TopColumn("wkc", "WKC", 5, 6, is_number=True, rank=2),
        TopColumn("fault", "Fault", 20, 0),
    ),
    Tab.EVENTS: (
        TopColumn("time", "Time", 8, 8),
        TopColumn("severity", "", 7, 7),
        TopColumn("where", "Where", 12, 28),
        TopColumn("what", "What", 20, 0),
    ),
}
ROW_KINDS: Mapping[Tab, type[msgspec.Struct]] = {
    Tab.STATIONS: StationRow,
    Tab.PDS: PdFlow,
    Tab.BUSES: BusRow,
    Tab.EVENTS: EventRow,
}
SORT_KEYS = tuple(each.key for each in COLUMNS[Tab.STATIONS] if each.key)


class TopLine(NamedTuple):
    """A row of a table: its texts by column, and their styles."""

    key: str
    row: Any
    cells: tuple[str, ...]
    styles: tuple[str, ...]

    def style_of(self, number: int) -> str:
        """Return the style of a text, empty for none."""
        return self.styles[number]


class _Moment(NamedTuple):
    at_ns: int
    per_s: float
    trouble: int


class TopModel:
    """The reports of a view, and what is chosen of them.

    Attributes:
        report: The latest one.
        since: Lost and late ones are counted from this report on, None for the whole time.
        match: The filter.
        sort_key: Field that rows are sorted by, empty for the order of the plant.
        is_reversed: Whether the order is the other way round.
    """

    def __init__(self, *, match: str = "", sort_key: str = "") -> None:
        self.report: LiveReport | None = None
        self.since: LiveReport | None = None
        self.match = match
        self.sort_key = sort_key
        self.is_reversed = False
        self._before: LiveReport | None = None
        self._history: dict[StationKey, deque[_Moment]] = {}
        self._rows: dict[StationKey, StationRow] = {}
        self._totals: dict[StationKey, int] = {}

    def take(self, report: LiveReport) -> None:
        """Show another report."""
        self._before, self.report = self.report, report
        known, self._rows = self._rows, {}
        for row in station_rows(report.status, self._status(self._before)):
            key = row.plant, row.name
            self._rows[key] = row
            self._remember(key, row, report.at_ns)
        # Stations of an appliance that does not answer stay on the screen, and say so.
        if report.unreachable:
            for key, row in known.items():
                if key not in self._rows:
                    gone = msgspec.structs.replace(row, state=GONE, tx_per_s=None, rx_per_s=None)
                    self._rows[key] = gone

    def count_from_now(self) -> None:
        """Count lost and late ones from the latest report on."""
        self.since = self.report

    def filter_of(self, tab: Tab) -> RowFilter:
        """Return the filter of a view; raise ValueError for an expression that fits no rows."""
        if tab not in ROW_KINDS:
            return RowFilter()
        # A key of another view chooses no row here, and is no error.
        kinds = [ROW_KINDS[tab], *(kind for other, kind in ROW_KINDS.items() if other is not tab)]
        return RowFilter.parse(self.match, *kinds)

    def stations(self) -> list[StationRow]:
        """Return the rows of stations, chosen and sorted; raise ValueError for a wrong filter."""
        return self._chosen(Tab.STATIONS, self._counted())

    def lines(self, tab: Tab, events: Iterable[LiveEvent] = (), width: int = 12) -> list[TopLine]:
        """Return the rows of a view; raise ValueError for a wrong filter.

        Args:
            tab: The view.
            events: All events, the latest last.
            width: Characters for the last minute of a station.
        """
        if self.report is None:
            return []
        before, since = self._status(self._before), self._status(self.since)
        if tab is Tab.STATIONS:
            return [self._station_line(row, width) for row in self.stations()]
        if tab is Tab.PDS:
            flows = pd_flows(self.report.status, before, since)
            return [_pd_line(row) for row in self._chosen(tab, flows)]
        if tab is Tab.BUSES:
            buses = bus_rows(self.report.status, since)
            return [_bus_line(row) for row in self._chosen(tab, buses)]
        rows = [
            EventRow(e.time, e.severity, e.plant, e.where, e.what, e.advice)
            for e in reversed([*events])
        ]
        return [_event_line(row) for row in self._chosen(tab, rows)]

    def head(self) -> str:
        """Return the sums of all stations in a line."""
        if self.report is None:
            return "waiting for the first answer"
        rows = [*self._counted()]
        if not rows:
            why = "; ".join(f"{name}: {why}" for name, why in self.report.unreachable.items())
            return why or "no appliance runs: start one with 'eapctl run PLANT'"
        plants = ", ".join(dict.fromkeys(row.plant for row in rows))
        in_op = sum(row.state == "OP" for row in rows)
        parts = [
            f"{plants}: {in_op}/{len(rows)} OP",
            f"in {_sum_rate(row.rx_per_s for row in rows)}",
            f"out {_sum_rate(row.tx_per_s for row in rows)}",
            f"lost {sum(row.lost for row in rows)}",
            f"late {sum(row.late for row in rows)}",
        ]
        severities = [each.severity for each in self.report.status.findings]
        parts += [
            count(number, severity)
            for severity in (Severity.ERROR, Severity.WARNING)
            if (number := severities.count(severity))
        ]
        parts += [f"{name} does not answer" for name in self.report.unreachable]
        return "  ".join(parts)

    def findings_of(self, station: str, plant: str) -> list[tuple[str, str]]:
        """Return the present faults of a station, then those of its appliance, with their styles.

        *station* may be ``STATION/PORT``, which has its own only.
        """
        if self.report is None:
            return []
        now_s = self.report.time
        found = [each for each in self.report.status.findings if each.plant == plant]
        chosen = [each for each in found if _is_of(station, each.where)]
        if "/" not in station:
            names = [str(each["name"]) for each in self.report.status.stations]
            chosen += [
                each
                for each in found
                if not any(_is_of(name, each.where) for name in names)
                and (each.severity is not Severity.INFO or each.where.startswith(_RECORDING))
            ]
        rows = [(each.text(now_s), SEVERITY_STYLES[each.severity]) for each in chosen]
        return list(dict.fromkeys(rows))  # two appliances of a plant report its recordings

    def station(self, row: StationRow | PdFlow | BusRow) -> Row | None:
        """Return the station of a row in the status document, None if it is gone."""
        name = row.name if isinstance(row, StationRow) else row.station
        if self.report is None:
            return None
        return next(
            (each for each in self.report.status.stations if key_of(each) == (row.plant, name)),
            None,
        )

    def flows(self, plant: str, station: str) -> list[PdFlow]:
        """Return the PDs of a station, received ones first, in trouble before others."""
        if self.report is None:
            return []
        before, since = self._status(self._before), self._status(self.since)
        rows = [
            row
            for row in pd_flows(self.report.status, before, since)
            if (row.plant, row.station) == (plant, station)
        ]
        return sorted(
            rows,
            key=lambda row: (
                row.direction != "rx", row.state != "stale", -(row.lost or 0), -(row.late or 0)
            ),
        )  # fmt: skip

    def minute(self, key: StationKey, width: int) -> str:
        """Return the last minute of a station: a bar for its rate, a mark for losses and late ones.

        A dot is a time without PDs, a space one before the view began.
        """
        history = self._history.get(key)
        if not history or self.report is None:
            return ""
        slots: list[list[_Moment]] = [[] for _ in range(width)]
        for moment in history:
            ago = (self.report.at_ns - moment.at_ns) * width // MINUTE_NS
            # The report of a clock that has a step may lie outside the minute.
            slots[width - 1 - min(max(ago, 0), width - 1)].append(moment)
        highest = max(moment.per_s for moment in history)
        return "".join(_bar(slot, highest) for slot in slots)

    def _counted(self) -> Iterable[StationRow]:
        """Return all rows of stations, counted from the chosen report on."""
        if self.report is None or self.since is None:
            return self._rows.values()
        rows = station_rows(self.report.status, self._status(self._before), self.since.status)
        counted = {(row.plant, row.name): row for row in rows}
        return [counted.get(key, row) for key, row in self._rows.items()]

    def _remember(self, key: StationKey, row: StationRow, at_ns: int) -> None:
        total = row.lost + row.late
        # A counter that has gone back belongs to a plant that was started again.
        trouble = max(total - self._totals.get(key, total), 0)
        self._totals[key] = total
        if row.tx_per_s is None and row.rx_per_s is None:
            return
        history = self._history.setdefault(key, deque())
        history.append(_Moment(at_ns, (row.tx_per_s or 0) + (row.rx_per_s or 0), trouble))
        while history[0].at_ns < at_ns - MINUTE_NS:
            history.popleft()

    def _chosen(self, tab: Tab, rows: Iterable[AnyRowT]) -> list[AnyRowT]:
        wanted = self.filter_of(tab)
        found = [row for row in rows if wanted.fits(row)]
        if self.sort_key in sort_keys(tab):
            found = _sorted(found, self.sort_key)
        if self.is_reversed:
            found.reverse()
        return found

    def _station_line(self, row: StationRow, width: int) -> TopLine:
        minute = self.minute((row.plant, row.name), width)
        cells = (
            row.name, row.state, _rate(row.tx_per_s), _rate(row.rx_per_s), str(row.lost),
            str(row.late), duration(row.age_us), duration(row.jitter_p99_us), row.bus, minute,
        )  # fmt: skip
        state = _STATE_STYLES.get(row.state, "")
        is_bus_well = not row.bus or (row.bus.endswith(" OP") and _is_whole(row.bus))
        styles = (
            "", state, "", "", _BAD if row.lost else "", _WARN if row.late else "", "", "",
            "" if is_bus_well else _BAD, _BAD if _LOSSY in minute else "",
        )  # fmt: skip
        return TopLine(f"{row.plant}/{row.name}", row, cells, styles)

    @staticmethod
    def _status(report: LiveReport | None) -> StatusReport | None:
        return None if report is None else report.status


def _is_of(station: str, where: str) -> bool:
    return where == station or where.startswith((f"{station}/", f"{station} "))


def _sorted(rows: list[AnyRowT], key: str) -> list[AnyRowT]:
    """Return rows by a field: texts from A to Z, numbers from the highest, unknown ones last."""

    def order(row: AnyRowT) -> tuple[bool, Any]:
        value = getattr(row, key)
        if isinstance(value, str):
            return False, value
        # Numbers from the highest: what is worst is on the screen.
        return value is None, 0 if value is None else -value

    return sorted(rows, key=order)


def _bar(slot: Sequence[_Moment], highest: float) -> str:
    if not slot:
        return " "
    if any(moment.trouble for moment in slot):
        return _LOSSY
    # The least, so that a pause within a slot is seen.
    per_s = min(moment.per_s for moment in slot)
    if not per_s or not highest:
        return _SILENT
    return BARS[round(per_s / highest * (len(BARS) - 1))]


def _pd_line(row: PdFlow) -> TopLine:
    cells = (
        row.station, "←" if row.direction == "rx" else "→", row.name, row.state, _rate(row.per_s),
        _number(row.lost), _number(row.late), duration(row.age_us), duration(row.jitter_p99_us),
        str(row.dropped), quality(row.quality), row.port, str(row.total),
    )  # fmt: skip
    styles = [""] * len(cells)
    styles[3] = _STATE_STYLES.get(row.state, "")
    styles[5] = _BAD if row.lost else ""
    styles[6] = _WARN if row.late else ""
    styles[9] = _WARN if row.dropped else ""
    key = f"{row.plant}/{row.station}/{row.direction}/{row.name}"
    return TopLine(key, row, cells, tuple(styles))


def _bus_line(row: BusRow) -> TopLine:
    is_bus = not row.name
    cells = (
        f"{row.station}/{row.port}", _number(row.address), row.name, row.state,
        _number(row.lost), _number(row.wkc), row.fault.replace("\n", " "),
    )  # fmt: skip
    bold = "bold" if is_bus else ""
    styles = (
        bold, "", "", _STATE_STYLES.get(row.state, ""), _BAD if row.lost else "",
        _BAD if row.wkc else "", _BAD if row.fault else "",
    )  # fmt: skip
    return TopLine(f"{row.plant}/{row.station}/{row.port}/{row.address}", row, cells, styles)


def _event_line(row: EventRow) -> TopLine:
    style = SEVERITY_STYLES[Severity(row.severity)]
    cells = (clock(row.time), row.severity, row.where, row.what)
    key = f"{row.time}/{row.plant}/{row.where}/{row.what}"
    return TopLine(key, row, cells, ("", style, "", style))


def event_text(event: LiveEvent) -> str:
    """Return an event as a line."""
    return f"{clock(event.time)} {event.text}"


def clock(time_s: float) -> str:
    """Return the time of day of a Unix time."""
    from datetime import datetime

    return datetime.fromtimestamp(time_s).astimezone().strftime("%H:%M:%S")


def sort_keys(tab: Tab) -> Iterator[str]:
    """Yield the fields that a view can be sorted by, in the order of its columns."""
    for column in COLUMNS.get(tab, ()):
        if column.key:
            yield column.key


def _is_whole(bus: str) -> bool:
    in_op, _, number = bus.removesuffix(" OP").partition("/")
    return in_op == number


def _rate(per_s: float | None) -> str:
    if per_s is None:
        return ""
    return _short(per_s)


def _sum_rate(rates: Iterable[float | None]) -> str:
    return f"{_short(sum(each or 0.0 for each in rates))}/s"


def _short(number: float) -> str:
    if number < 10 and number % 1:
        return f"{number:.1f}"
    return f"{number:.0f}" if number < 99_999.5 else f"{number / 1000:.0f}k"


def _number(number: int | None) -> str:
    return "" if number is None else str(number)
