"""The status of all appliances on one screen: verdict, findings, stations, processes.

Pure: one or two documents of ``eapctl status --json`` in, one rich renderable out.  On a terminal
it takes no more lines than there are: what is in order gives way first, and a line says what was
left out.  ``eapctl status --full`` (status_view.py) shows every PD, port and bus.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from eap.cli import words
from eap.cli.status_findings import Finding, Severity
from eap.cli.table import Column, ItemLine, TextTable

Row = Mapping[str, Any]

_STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.INFO: ""}
_GOOD = "green"
_STATE_STYLES = {"OP": _GOOD, "INIT": "bold red", "PREOP": "yellow", "SAFEOP": "yellow"}
_SPARE_LINES = 2
"""Lines of the screen that stay free: for the heading of ``--watch``, and for the shell."""
_LEAST_ROWS = 1
"""So many findings and stations are shown on the smallest screen."""


class StatusScreen:
    """One status document, fitted to the screen.

    With the document of *seconds* ago as *earlier* it shows rates in place of counts.
    """

    def __init__(
        self, document: Row, now_s: float, earlier: Row | None = None, seconds: float = 0.0
    ) -> None:
        findings = [Finding.from_plain(row) for row in document["findings"]]
        self._document = document
        self._findings = [each for each in findings if each.severity is not Severity.INFO]
        self._remarks = len(findings) - len(self._findings)
        self._now_s = now_s
        self._earlier = earlier
        self._seconds = seconds

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        def excess(findings: int, stations: int) -> int:
            """Return the number of lines for which the screen has no room."""
            lines = console.render_lines(self._layout(findings, stations), options, pad=False)
            return len(lines) + _SPARE_LINES - console.height

        stations, findings = len(self._document["stations"]), len(self._findings)
        if console.is_terminal:
            while findings > _LEAST_ROWS and (lines := excess(findings, _LEAST_ROWS)) > 0:
                findings = max(_LEAST_ROWS, findings - lines)
            while stations > _LEAST_ROWS and (lines := excess(findings, stations)) > 0:
                stations = max(_LEAST_ROWS, stations - lines)
        yield self._layout(findings, stations)

    def _layout(self, findings: int, stations: int) -> RenderableType:
        parts: list[RenderableType] = [*verdicts(self._document)]
        if self._findings:
            parts.append(finding_grid(self._findings[:findings], self._now_s))
        if rest := len(self._findings) - findings:
            parts.append(Text(f"{rest} more: eapctl status --full", style="dim"))
        parts += [Text(), self._stations(stations)]
        if others := self._document["stations"][stations:]:
            parts.append(Text(f"{words.count(len(others), 'more station')}, {_states(others)}"))
        parts.append(Text())
        parts += (
            _processes(each, appliance_label(self._document, each))
            for each in self._document["appliances"]
        )
        remarks = f", and {words.count(self._remarks, 'remark')}" if self._remarks else ""
        parts.append(Text(f"eapctl status --full: each PD, port and bus{remarks}", style="dim"))
        return Group(*parts)

    def _stations(self, shown: int) -> RenderableType:
        rate = "/s" if self._earlier else ""
        table = TextTable(
            "Station",
            "State",
            Column("Links", rank=3, wraps=True),
            Column(f"Tx{rate}", is_number=True),
            Column(f"Rx{rate}", is_number=True),
            Column("Lost", is_number=True),
            Column("Late", is_number=True),
            Column("Dropped", rank=2, is_number=True),
            Column("Buses", rank=1, wraps=True),
        )
        for row in self._document["stations"][:shown]:
            rx = row["pd"]["rx"]
            dropped = sum(row["discarded"].values())
            dropped += sum(count for each in rx for count in each["discarded"].values())
            table.add_row(
                row["name"],
                Text(row["state"], style=_STATE_STYLES.get(row["state"], "")),
                _links(row["ports"]),
                self._figure(row, "tx", "sent"),
                self._figure(row, "rx", "received"),
                _bad_count(sum(each["lost"] or 0 for each in rx)),
                str(sum(each["late"] for each in rx)),
                str(dropped),
                _buses(row["ports"]),
            )
        return table

    def _figure(self, station: Row, direction: str, key: str) -> str:
        """Return a sum over all PDs: since the start, or a second where there is a look before."""
        total = _total(station, direction, key)
        if self._earlier is None:
            return str(total)
        before = [
            row
            for row in self._earlier["stations"]
            if (row["plant"], row["name"]) == (station["plant"], station["name"])
        ]
        if not before or total < (total_before := _total(before[0], direction, key)):
            return ""  # it was not there, or its counters started anew
        # Not the time between the looks: counters are of a moment that the look does not know.
        seconds = _station_s(station) - _station_s(before[0])
        return f"{(total - total_before) / (seconds if seconds > 0 else self._seconds):.0f}"


def appliance_label(document: Row, appliance: Row) -> str:
    """Return the plant of an appliance, with its stations where others run parts of that plant."""
    plants = [each["plant"] for each in document["appliances"]]
    plant: str = appliance["plant"]
    if plants.count(plant) == 1:
        return plant
    return f"{plant} ({', '.join(appliance['stations'])})"


def verdicts(document: Row) -> list[Text]:
    """Return a line for each plant: the number of errors and warnings, and its parts."""
    plants = dict.fromkeys(appliance["plant"] for appliance in document["appliances"])
    return [_verdict(document, plant) for plant in plants]


def _verdict(document: Row, plant: str) -> Text:
    stations = [row for row in document["stations"] if row["plant"] == plant]
    pds = sum(len(row["pd"]["tx"]) + len(row["pd"]["rx"]) for row in stations)
    counts = Counter(row["severity"] for row in document["findings"] if row["plant"] == plant)
    text = Text(f"{plant}: ", style="bold")
    if errors := counts[Severity.ERROR]:
        text.append(words.count(errors, "error"), _STYLES[Severity.ERROR])
    else:
        text.append("no errors", _GOOD)
    if warnings := counts[Severity.WARNING]:
        text.append(f", {words.count(warnings, 'warning')}", _STYLES[Severity.WARNING])
    scope = f" ({words.count(len(stations), 'station')}, {words.count(pds, 'PD')})"
    return text.append(scope, "not bold")


def finding_grid(found: Iterable[Finding], now_s: float) -> RenderableType:
    """Return a line for each finding, or more where it is long."""
    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(no_wrap=True)
    grid.add_column()
    for each in found:
        grid.add_row(Text(each.severity, style=_STYLES[each.severity]), Text(each.text(now_s)))
    return grid


def _total(station: Row, direction: str, key: str) -> int:
    return sum(row[key] for row in station["pd"][direction])


def _station_s(station: Row) -> float:
    """Return the time of a station's counters: its cycles since the first, also those left out."""
    cycles: int = station.get("cycle", 0) + station.get("overruns", 0)
    cycle_us: int = station.get("cycle_us", 0)
    return cycles * cycle_us / 1e6


def _states(stations: Iterable[Row]) -> str:
    states = Counter(row["state"] for row in stations)
    return ", ".join(f"{count} in {state}" for state, count in states.items())


def _links(ports: Sequence[Row]) -> Text:
    down = [port["name"] for port in ports if port.get("link") == "down"]
    if down:
        return Text(f"{', '.join(down)} down", style=_STYLES[Severity.ERROR])
    return Text("up", style=_GOOD) if any(port.get("link") == "up" for port in ports) else Text()


def _buses(ports: Sequence[Row]) -> Text:
    """Return each bus with the states of its slaves."""
    text = Text()
    for port in ports:
        if (bus := port.get("bus")) is None:
            continue
        text.append(f"{', ' if text else ''}{port['name']}: ")
        states = Counter(slave["state"] or "no answer" for slave in bus["slaves"])
        if not bus["is_up"]:
            text.append("down", _STYLES[Severity.ERROR])
        for number, (state, count) in enumerate(states.items() if bus["is_up"] else ()):
            style = _GOOD if state == "OP" else _STYLES[Severity.ERROR]
            text.append(", " if number else "").append(f"{count} {state}", style)
    return text


def _bad_count(count: int) -> Text:
    return Text(str(count), style=_STYLES[Severity.ERROR] if count else "")


def _processes(appliance: Row, label: str) -> RenderableType:
    processes = dict(appliance["processes"])
    segments = list(processes.pop("segments", {}).values())
    items = [_process(name, [process]) for name, process in processes.items()]
    if segments:
        items.append(_process(words.count(len(segments), "segment"), segments))
    return ItemLine(f"{label}:", items)


def _process(name: str, processes: Sequence[Row]) -> Text:
    """Return name, share of a core and memory of processes of one kind."""
    text = Text(name)
    if not all(process["pid"] for process in processes):
        return text.append(" restarting", _STYLES[Severity.ERROR])
    if any(process.get("step") for process in processes):
        return text.append(" starting", _STYLES[Severity.WARNING])
    if all(process.get("cpu") is not None for process in processes):
        text.append(f" {sum(process['cpu'] for process in processes):.0f} %")
    if all(process.get("rss") is not None for process in processes):
        text.append(f" {sum(process['rss'] for process in processes) / 1e6:.0f} MB")
    if restarts := sum(process.get("restarts") or 0 for process in processes):
        text.append(f" restarted {words.times(restarts)}", _STYLES[Severity.WARNING])
    return text
