"""``eapctl status``: the state of the running appliances, once or periodically.

The screen shows the number of errors, findings, stations and processes.  On a terminal it takes no
more lines than there are: the parts in order give way first, and a line names the omitted ones.
The full view has each process, port, bus and PD, and below the tables the remarks since the start.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from threading import Event
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from eap.cli.group import ExitCode
from eap.cli.output import (
    Column,
    ItemLine,
    Renderer,
    Styled,
    TextTable,
    json_option,
    repaint,
    write_json,
)
from eap.cli.params import plant_option, station_option
from eap.errors import ControlError
from eap.live.findings import (
    LISTENER_COUNTS,
    REASONS,
    STATES,
    Severity,
    StatusFinding,
    StatusReport,
    appliance_label,
    findings,
    is_hung,
    is_special,
)
from eap.quantities import count, duration, quality, times

if TYPE_CHECKING:
    from rich.console import Console, ConsoleOptions, RenderableType, RenderResult

    from eap.live.status import ApplianceStatus


_LEAST_INTERVAL_S = 0.1


class StatusSample(NamedTuple):
    """Status of the appliances at one time.

    Attributes:
        now_s: Unix time of the sample.
        document: The merged status with its findings.
        earlier: The document of the previous sample, if there is one.
    """

    now_s: float
    document: StatusReport
    earlier: StatusReport | None = None


@click.command()
@click.option("--full", is_flag=True, help="Show every process, port, bus and PD.")
@click.option("--watch", is_flag=True, help="Refresh until Ctrl-C, and show rates.")
@click.option(
    "--interval",
    "interval_s",
    type=click.FloatRange(_LEAST_INTERVAL_S),
    default=2.0,
    show_default=True,
    metavar="S",
    help="Seconds between refreshes with --watch.",
)
@plant_option
@station_option
@json_option("Print one object; docs/control.md explains its fields.")
@click.pass_context
def status(
    ctx: click.Context,
    full: bool,
    watch: bool,
    interval_s: float,
    plant: str | None,
    station: str | None,
    output: Renderer,
) -> None:
    """Show the state of the running appliances: errors first, then a line for each station.

    Each error and warning has its place, cause, time and remedy.

    Exits with 1 when an appliance does not answer.
    """
    view = _full if full else _screen
    if not watch:
        sample = _take_sample(plant, station)
        output.show(sample.document, lambda _: view(sample))
        if sample.document.silent:
            ctx.exit(ExitCode.FAILED)
        return
    try:
        for found in _samples(plant, station, interval_s):
            if output.is_json:
                _write_object(found)
            else:
                repaint(_page(found, view, interval_s))
    except KeyboardInterrupt:
        return


def _samples(
    plant: str | None, station: str | None, interval_s: float
) -> Iterator[StatusSample | str]:
    """Yield a sample every *interval_s*, or the error of the request; never end."""
    before: StatusSample | None = None
    while True:
        start = time.monotonic()
        try:
            sample = _take_sample(plant, station)
        except ControlError as exc:
            # No rates over a gap: the appliance may be another one afterwards.
            before = None
            yield str(exc)
        else:
            if before is not None:
                sample = sample._replace(earlier=before.document)
            before = sample
            yield sample
        _pause(max(0.0, start + interval_s - time.monotonic()))


def _pause(seconds: float) -> None:
    # A signal handler runs during the wait, so that Ctrl-C ends it at once.
    Event().wait(seconds)


def _take_sample(plant: str | None, station: str | None) -> StatusSample:
    """Return the merged answer of the chosen appliances, cut down to *station* if it is given."""
    from msgspec.structs import asdict, replace

    from eap.live.status import MergedStatus, SilentAppliance
    from eap.ops.client import connect, request_each

    with ExitStack() as stack:
        clients = [stack.enter_context(client) for client in connect(plant, station)]
        answers, silent = request_each(clients, "status")
    status = MergedStatus.of(
        answers, [SilentAppliance(each.plant, each.stations, each.services.pid) for each in silent]
    )
    if station:
        status = replace(
            status, stations=[row for row in status.stations if row["name"] == station]
        )
    now_s = time.time()
    document = StatusReport(**asdict(status), findings=findings(status, now_s))
    return StatusSample(now_s, document)


def _write_object(found: StatusSample | str) -> None:
    if isinstance(found, StatusSample):
        write_json(found.document)
    else:
        click.echo(found, err=True)


def _page(
    found: StatusSample | str,
    view: Callable[[StatusSample], Iterable[RenderableType]],
    interval_s: float,
) -> Iterator[RenderableType]:

    yield Styled(f"{time.strftime('%H:%M:%S')}, every {interval_s:g} s", style="dim")
    if isinstance(found, StatusSample):
        yield from view(found)
    else:
        yield Styled(f"{found}; waiting for an appliance", style="bold red")


def _screen(sample: StatusSample) -> Iterator[RenderableType]:
    yield StatusScreen(sample.document, sample.now_s, sample.earlier)


def _full(sample: StatusSample) -> Iterator[RenderableType]:
    return full_view(sample.document, sample.now_s)


Row = Mapping[str, Any]

_STYLES = {Severity.ERROR: "bold red", Severity.WARNING: "yellow", Severity.INFO: ""}
_GOOD, _BAD, _DIM = "green", "bold red", "dim"
_STATE_STYLES = {"OP": _GOOD, "INIT": _BAD, "PREOP": "yellow", "SAFEOP": "yellow"}
_OFF = "off"
_ABSENT = "absent"
_SLAVE_STYLES = {"OP": _GOOD, _ABSENT: _DIM}
_FULL_STYLES = {"OP": _GOOD, "running": _GOOD, "up": _GOOD, "stale": _BAD, "down": _BAD}
_FULL_STYLES |= {"present": _GOOD, "missing": _BAD, "unknown": _DIM, _OFF: _DIM}
_SPARE_LINES = 2
"""Lines of the screen that stay free: for the heading of ``--watch``, and for the shell."""
_LEAST_ROWS = 1
"""Number of findings and stations that the smallest screen shows."""


class StatusScreen:
    """One status document, fitted to the screen.

    With an *earlier* document it shows rates in place of counts.
    """

    def __init__(
        self,
        document: StatusReport,
        now_s: float,
        earlier: StatusReport | None = None,
    ) -> None:
        self._document = document
        self._findings = [each for each in document.findings if each.severity is not Severity.INFO]
        self._remarks = len(document.findings) - len(self._findings)
        self._now_s = now_s
        self._earlier = earlier

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        def excess(findings: int, stations: int) -> int:
            """Return the number of lines that exceed the screen."""
            lines = console.render_lines(self._layout(findings, stations), options, pad=False)
            return len(lines) + _SPARE_LINES - console.height

        stations, findings = len(self._document.stations), len(self._findings)
        if console.is_terminal:
            # Measured by rendering: a long finding takes several lines on a narrow screen.
            while findings > _LEAST_ROWS and (lines := excess(findings, _LEAST_ROWS)) > 0:
                findings = max(_LEAST_ROWS, findings - lines)
            while stations > _LEAST_ROWS and (lines := excess(findings, stations)) > 0:
                stations = max(_LEAST_ROWS, stations - lines)
        yield self._layout(findings, stations)

    def _layout(self, findings: int, stations: int) -> RenderableType:
        from rich.console import Group

        parts: list[RenderableType] = [*summaries(self._document)]
        if self._findings:
            parts.append(finding_grid(self._findings[:findings], self._now_s))
        if rest := len(self._findings) - findings:
            parts.append(Styled(f"{rest} more: eapctl status --full", style="dim"))
        parts += [Styled(), self._stations(stations)]
        if others := self._document.stations[stations:]:
            parts.append(Styled(f"{count(len(others), 'more station')}, {_states(others)}"))
        parts.append(Styled())
        parts += (
            _processes(each, appliance_label(self._document, each))
            for each in self._document.appliances
        )
        remarks = f", and {count(self._remarks, 'remark')}" if self._remarks else ""
        parts.append(Styled(f"eapctl status --full: each PD, port and bus{remarks}", style="dim"))
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
        for row in self._document.stations[:shown]:
            rx = row["pd"]["rx"]
            dropped = sum(row["discarded"].values())
            dropped += sum(number for each in rx for number in each["discarded"].values())
            table.add_row(
                row["name"],
                Styled("no cycles", style=_BAD)
                if is_hung(row)
                else Styled(row["state"], style=_STATE_STYLES.get(row["state"], "")),
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
        """Return a sum over all PDs: since the start, or per second after a previous sample."""
        # Imported here: its records take time to build, and --help needs none of them.
        from eap.live.rows import count_total, key_of, rate, stations_of

        total = count_total(station, direction, key)
        if self._earlier is None:
            return str(total)
        earlier = stations_of(self._earlier).get(key_of(station))
        if earlier is None:
            return ""  # the station is new
        per_s = rate(total, count_total(earlier, direction, key), station, earlier)
        return "" if per_s is None else f"{per_s:.0f}"


def summaries(document: StatusReport) -> list[Styled]:
    """Return a line for each plant: the number of errors and warnings, and its parts."""
    plants = dict.fromkeys(each.plant for each in document.appliances)
    plants |= dict.fromkeys(each.plant for each in document.silent)
    return [_summary(document, plant) for plant in plants]


def _summary(document: StatusReport, plant: str) -> Styled:
    stations = [row for row in document.stations if row["plant"] == plant]
    pds = sum(len(row["pd"]["tx"]) + len(row["pd"]["rx"]) for row in stations)
    counts = Counter(each.severity for each in document.findings if each.plant == plant)
    text = Styled(f"{plant}: ", style="bold")
    if errors := counts[Severity.ERROR]:
        text.append(count(errors, "error"), _BAD)
    else:
        text.append("no errors", _GOOD)
    if warnings := counts[Severity.WARNING]:
        text.append(f", {count(warnings, 'warning')}", _STYLES[Severity.WARNING])
    scope = f" ({count(len(stations), 'station')}, {count(pds, 'PD')})"
    return text.append(scope, "not bold")


def finding_grid(found: Iterable[StatusFinding], now_s: float) -> RenderableType:
    """Return a line for each finding, or more where it is long."""
    from rich.table import Table

    grid = Table.grid(padding=(0, 2, 0, 0))
    grid.add_column(no_wrap=True)
    grid.add_column()
    for each in found:
        grid.add_row(Styled(each.severity, style=_STYLES[each.severity]), Styled(each.text(now_s)))
    return grid


def _states(stations: Iterable[Row]) -> str:
    states = Counter(row["state"] for row in stations)
    return ", ".join(f"{number} in {state}" for state, number in states.items())


def _links(ports: Sequence[Row]) -> Styled:
    down = [port["name"] for port in ports if port.get("link") == "down"]
    if down:
        return Styled(f"{', '.join(down)} down", style=_BAD)
    return (
        Styled("up", style=_GOOD) if any(port.get("link") == "up" for port in ports) else Styled()
    )


def _buses(ports: Sequence[Row]) -> Styled:
    """Return each bus with the states of its slaves."""
    text = Styled()
    for port in ports:
        if (bus := port.get("bus")) is None:
            continue
        text.append(f"{', ' if text.plain else ''}{port['name']}: ")
        states = Counter(map(_slave_state, bus["slaves"]))
        if not bus["is_up"]:
            text.append("down", _BAD)
        for at, (state, number) in enumerate(states.items() if bus["is_up"] else ()):
            style = _SLAVE_STYLES.get(state, _BAD)
            text.append(", " if at else "").append(f"{number} {state}", style)
    return text


def _slave_state(slave: Row) -> str:
    return slave["state"] or (_ABSENT if slave.get("is_absent") else "no answer")


def _bad_count(number: int) -> Styled:
    return Styled(str(number), style=_BAD if number else "")


_CYCLIC_PATH = {None: "", True: " (compiled)", False: " (Python)"}


def _processes(appliance: ApplianceStatus, label: str) -> RenderableType:
    processes = dict(appliance.processes)
    segments = list(processes.pop("segments", {}).values())
    items = [_process(name, [process]) for name, process in processes.items()]
    if segments:
        items.append(_process(count(len(segments), "segment"), segments))
    return ItemLine(f"{label}:", items)


def _process(name: str, processes: Sequence[Row]) -> Styled:
    """Return name, share of a core and memory of processes of one kind."""
    text = Styled(name)
    if any(process.get("fault") for process in processes):
        return text.append(" not running", _STYLES[Severity.WARNING])
    if not all(process["pid"] for process in processes):
        return text.append(" restarting", _BAD)
    if any(process.get("step") for process in processes):
        return text.append(" starting", _STYLES[Severity.WARNING])
    if any(process.get("compiled") is False for process in processes):
        text.append(_CYCLIC_PATH[False])
    if all(process.get("cpu") is not None for process in processes):
        text.append(f" {sum(process['cpu'] for process in processes):.0f} %")
    if all(process.get("rss") is not None for process in processes):
        text.append(f" {sum(process['rss'] for process in processes) / 1e6:.0f} MB")
    if restarts := sum(process.get("restarts") or 0 for process in processes):
        text.append(f" restarted {times(restarts)}", _STYLES[Severity.WARNING])
    return text


def full_view(document: StatusReport, now_s: float) -> Iterator[RenderableType]:
    """Yield everything in a status *document* of *now_s*, as tables."""
    stations = document.stations
    yield from summaries(document)
    found = document.findings
    if faults := [each for each in found if each.severity is not Severity.INFO]:
        yield finding_grid(faults, now_s)
    for appliance in document.appliances:
        yield ""
        if (label := appliance_label(document, appliance)) != appliance.plant:
            # Above the table: a heading with all stations would widen its first column.
            yield Styled(label, style="bold")
        yield _processes_table(appliance)
        if groups := appliance.processes.get("engine", {}).get("groups"):
            yield ""
            yield _groups(groups)
        if listeners := appliance.listeners:
            yield ""
            yield _listeners(listeners)
        if any(each.get("bridge") for each in appliance.processes.values()):
            yield ""
            yield _bridges(appliance)
    yield ""
    yield _stations_table(stations)
    if any("bus" in port for station in stations for port in station["ports"]):
        yield ""
        yield _buses_table(stations)
        yield from _eoe_tables(stations)
    yield ""
    yield _process_data(stations)
    if any(is_special(row) for station in stations for row in station.get("frames", ())):
        yield ""
        yield _frames(stations)
    if remarks := [each for each in found if each.severity is Severity.INFO]:
        yield Styled("\nSince the start", style="bold")
        yield from (Styled(each.text(now_s)) for each in remarks)


def _processes_table(appliance: ApplianceStatus) -> TextTable:
    table = TextTable(
        f"Process of {appliance.plant}",
        Column("PID", rank=1, is_number=True),
        Column("CPU", is_number=True),
        Column("Memory", is_number=True),
        Column("Files", rank=1, is_number=True),
        Column("Restarts", is_number=True),
    )
    processes = dict(appliance.processes)
    segments = processes.pop("segments", {})
    processes |= {f"segment {name}": process for name, process in segments.items()}
    for name, process in processes.items():
        if not process["pid"]:
            state = "not running" if process.get("fault") else "restarting"
            table.add_row(name, "", Styled(state, style=_BAD))
            continue
        if process.get("step"):
            table.add_row(name, str(process["pid"]), Styled("starting", style=_BAD))
            continue
        cpu, rss = process.get("cpu"), process.get("rss")
        table.add_row(
            name + _CYCLIC_PATH[process.get("compiled")],
            str(process["pid"]),
            "" if cpu is None else f"{cpu:.1f} %",
            "" if rss is None else f"{rss / 1e6:.0f} MB",
            _descriptors(process.get("descriptors")),
            str(process.get("restarts", "")),
        )
    return table


def _descriptors(descriptors: Row | None) -> str:
    return "" if descriptors is None else f"{descriptors['used']} of {descriptors['limit']}"


def _groups(groups: Iterable[Row]) -> TextTable:
    """Return the groups of stations that run one after the other in a wake-up of the engine."""
    table = TextTable(
        "Group of cycle",
        Column("Begins at", is_number=True),
        Column("Stations", is_number=True),
        Column("Last station after", is_number=True),
    )
    for group in groups:
        begin, last = duration(group["phase_us"]), duration(group["last_us"])
        table.add_row(duration(group["cycle_us"]), begin, str(len(group["stations"])), last)
    return table


def _bridges(appliance: ApplianceStatus) -> TextTable:
    """Return bridges, and the controllers that they read."""
    table = TextTable(
        "Bridge",
        "Peer",
        "State",
        Column("Clients", rank=2, is_number=True),
        Column("Sent", rank=1, is_number=True),
        Column("Received", rank=1, is_number=True),
        Column("Failed", is_number=True),
    )
    for name, process in appliance.processes.items():
        if not (bridge := process.get("bridge")):
            continue
        if bridge["peer"]:
            clients = "" if bridge["clients"] is None else str(bridge["clients"])
            counts = (str(bridge[key]) for key in ("sent", "received", "refused"))
            table.add_row(name, bridge["peer"], _peer_state(bridge), clients, *counts)
        for peer in bridge.get("peers", ()):
            failed = f"{peer['failed']} of {peer['values']}"
            label, sent = f"{name} {peer['name']}", str(peer["writes"])
            table.add_row(label, peer["url"], _peer_state(peer), "", sent, "", failed)
    return table


def _peer_state(row: Row) -> str | Styled:
    return "up" if row["is_up"] else Styled("down", style=_BAD)


def _listeners(listeners: Sequence[Row]) -> TextTable:
    table = TextTable(
        "Listener",
        Column("Open", is_number=True),
        Column("Refused", is_number=True),
        Column("Evicted", is_number=True),
        Column("Too slow", is_number=True),
    )
    for row in listeners:
        opened = f"{row['open']} of {row['limit']}"
        counts = (str(row[key]) for key in LISTENER_COUNTS)
        table.add_row(row["name"], opened, *counts)
    return table


def _stations_table(stations: Sequence[Row]) -> TextTable:
    table = TextTable(
        "Station",
        "State",
        Column("Cycle", rank=2),
        "Port",
        Column("Interface", rank=1),
        Column("NetID", rank=3),
        "Link",
    )
    for station in stations:
        own = (
            station["name"],
            _state(station["state"]),
            duration(station["cycle_us"]) if "cycle_us" in station else "",
        )
        for port in station["ports"] or [{}]:
            where, net_id = _interface(port.get("interface", "")), port.get("net_id", "")
            link = _state(port.get("link") or "")
            table.add_row(*own, port.get("name", ""), where, net_id, link)
            own = ("", Styled(), "")
    return table


def _interface(uri: str) -> str:
    """Return where a port is; of a simulated bus only the name of its file."""
    scheme, _, path = uri.partition("://")
    return f"{scheme}://{path.rpartition('/')[2]}" if scheme == "sim" else uri


def _buses_table(stations: Sequence[Row]) -> TextTable:
    table = TextTable(
        "Bus",
        Column("Slaves", rank=3, is_number=True),
        Column("State", wraps=True),
        Column("Cycles", rank=1, is_number=True),
        Column("Lost", is_number=True),
        Column("WKC", is_number=True),
        Column("RTT", rank=2, is_number=True),
    )
    for station in stations:
        for port in station["ports"]:
            if (bus := port.get("bus")) is None:
                continue
            states = Counter(map(_slave_state, bus["slaves"]))
            shown = ", ".join(
                state if len(states) == 1 else f"{number} {state}"
                for state, number in states.items()
            )
            table.add_row(
                f"{station['name']}/{port['name']}",
                str(len(bus["slaves"])),
                _state(shown if bus["is_up"] else "down"),
                str(bus["cycles"]),
                str(bus["lost"]),
                f"{bus['received_wkc']} of {bus['expected_wkc']}",
                duration(bus["trip_us"]),
            )
    return table


def _eoe_tables(stations: Sequence[Row]) -> Iterator[TextTable | str]:
    """Yield the ports of each bus with a TAP interface."""
    # Imported here: few plants use EoE.
    import msgspec

    from eap.cli.bus_view import eoe_table
    from eap.runtime.engine_messages import EoeReport

    for port in (port for station in stations for port in station["ports"]):
        if (report := port.get("bus", {}).get("eoe")) is not None:
            yield ""
            yield eoe_table(msgspec.convert(report, EoeReport))


def _process_data(stations: Sequence[Row]) -> TextTable:
    table = TextTable(
        "",
        "Process data",
        "State",
        Column("Frames", is_number=True),
        Column("Lost", is_number=True),
        Column("Quality", rank=2, is_number=True),
        Column("Age", rank=1, is_number=True),
        Column("Jitter or\nresponse µs\np50 / p99 / max", rank=3, is_number=True),
    )
    for station in stations:
        pd = station["pd"]
        if pd["tx"] or pd["rx"]:
            table.add_row("", Styled(station["name"], style="bold"))
        for row in pd["tx"]:
            # An appliance of an older release has no last_reason.
            why = row.get("last_reason") or next(reversed(row["reason"]), "silent")
            # SafeOp still sends (ETG.1005), so only PreOp shows its PDs as off.
            shown = _OFF if station["state"] == "PREOP" else REASONS.get(why, why)
            table.add_row("→", row["name"], _state(shown), str(row["sent"]))
        for row in pd["rx"]:
            table.add_row(*_received(row, _OFF if station["state"] in STATES else row["state"]))
    return table


def _received(row: Row, state: str) -> tuple[str | Styled, ...]:
    lost, age = row["lost"], row["age_us"]
    times = row.get("response_us") or row["jitter_us"]
    spread = [times[key] for key in ("p50", "p99", "max")]
    return (
        "←",
        row["name"],
        _state(state),
        str(row["received"]),
        Styled("unknown", style=_DIM)
        if lost is None
        else Styled(str(lost), style=_BAD * bool(lost)),
        quality(row["quality"]),
        duration(age),
        "" if None in spread else " / ".join(map(str, spread)),
    )


def _frames(stations: Sequence[Row]) -> TextTable:
    table = TextTable(
        "Frame",
        Column("Destination", wraps=True),
        "Subscriber",
        Column("Frames", rank=1, is_number=True),
        Column("Skipped", is_number=True),
    )
    for station in stations:
        for row in filter(is_special, station.get("frames", ())):
            name, address = row["destination"], row["address"]
            table.add_row(
                f"{station['name']}/{row['name']}",
                name if name == address else f"{name} at {address or 'an unknown address'}",
                _state(row["subscriber"] if row["monitor_interval_ms"] else ""),
                str(row["sent"]),
                str(row["skipped"]),
            )
    return table


def _state(state: str) -> Styled:
    return Styled(state, style=_FULL_STYLES.get(state, ""))
