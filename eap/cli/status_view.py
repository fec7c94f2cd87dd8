"""The whole status as tables: findings, processes, stations with their ports, buses, process data.

Pure: the document of ``eapctl status --json`` in, rich renderables out.  Tables hold what every row
has; what happened since the start without being wrong now follows below them in words.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich.console import RenderableType
from rich.text import Text

from eap.cli import words
from eap.cli.status_findings import LISTENER_COUNTS, REASONS, STATES, Finding, Severity, is_special
from eap.cli.status_screen import appliance_label, finding_grid, verdicts
from eap.cli.table import Column, TextTable

Row = Mapping[str, Any]

_GOOD, _BAD, _DIM = "green", "bold red", "dim"
_STATE_STYLE = {"OP": _GOOD, "running": _GOOD, "up": _GOOD, "stale": _BAD, "down": _BAD}
_OFF = "off"
_STATE_STYLE |= {"present": _GOOD, "missing": _BAD, "unknown": _DIM, _OFF: _DIM}


def status_tables(document: Row, now_s: float) -> Iterator[RenderableType]:
    """Yield what to print for a status *document* of *now_s*, top to bottom."""
    stations = document["stations"]
    yield from verdicts(document)
    found = [Finding.from_plain(row) for row in document["findings"]]
    if faults := [each for each in found if each.severity is not Severity.INFO]:
        yield finding_grid(faults, now_s)
    for appliance in document["appliances"]:
        yield Text()
        yield _processes(appliance, appliance_label(document, appliance))
        if listeners := appliance.get("listeners"):
            yield Text()
            yield _listeners(listeners)
    yield Text()
    yield _stations(stations)
    if any("bus" in port for station in stations for port in station["ports"]):
        yield Text()
        yield _buses(stations)
    yield Text()
    yield _process_data(stations)
    if any(is_special(row) for station in stations for row in station.get("frames", ())):
        yield Text()
        yield _frames(stations)
    if remarks := [each for each in found if each.severity is Severity.INFO]:
        yield Text("\nSince the start", style="bold")
        yield from (Text(each.text(now_s)) for each in remarks)


def _processes(appliance: Row, label: str) -> RenderableType:
    table = TextTable(
        f"Process of {label}",
        Column("PID", rank=1, is_number=True),
        Column("CPU", is_number=True),
        Column("Memory", is_number=True),
        Column("Files", rank=1, is_number=True),
        Column("Restarts", is_number=True),
    )
    processes = dict(appliance["processes"])
    segments = processes.pop("segments", {})
    processes |= {f"segment {name}": process for name, process in segments.items()}
    for name, process in processes.items():
        if not process["pid"]:
            table.add_row(name, "", Text("restarting", style=_BAD))
            continue
        if process.get("step"):
            table.add_row(name, str(process["pid"]), Text("starting", style=_BAD))
            continue
        cpu, rss = process.get("cpu"), process.get("rss")
        table.add_row(
            name,
            str(process["pid"]),
            "" if cpu is None else f"{cpu:.1f} %",
            "" if rss is None else f"{rss / 1e6:.0f} MB",
            _descriptors(process.get("descriptors")),
            str(process.get("restarts", "")),
        )
    return table


def _descriptors(descriptors: Row | None) -> str:
    return "" if descriptors is None else f"{descriptors['used']} of {descriptors['limit']}"


def _listeners(listeners: Sequence[Row]) -> RenderableType:
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


def _stations(stations: Sequence[Row]) -> RenderableType:
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
            words.duration(station["cycle_us"]) if "cycle_us" in station else "",
        )
        for port in station["ports"] or [{}]:
            where, net_id = _interface(port.get("interface", "")), port.get("net_id", "")
            link = _state(port.get("link") or "")
            table.add_row(*own, port.get("name", ""), where, net_id, link)
            own = ("", Text(), "")
    return table


def _interface(uri: str) -> str:
    """Return where a port is; of a simulated bus only the name of its file."""
    scheme, _, path = uri.partition("://")
    return f"{scheme}://{path.rpartition('/')[2]}" if scheme == "sim" else uri


def _buses(stations: Sequence[Row]) -> RenderableType:
    table = TextTable(
        "Bus",
        Column("Slaves", rank=3, is_number=True),
        Column("State", wraps=True),
        Column("Cycles", rank=1, is_number=True),
        Column("Lost", is_number=True),
        Column("Counters", is_number=True),
        Column("Trip", rank=2, is_number=True),
    )
    for station in stations:
        for port in station["ports"]:
            if (bus := port.get("bus")) is None:
                continue
            states = Counter(slave["state"] or "no answer" for slave in bus["slaves"])
            shown = ", ".join(
                state if len(states) == 1 else f"{count} {state}" for state, count in states.items()
            )
            table.add_row(
                f"{station['name']}/{port['name']}",
                str(len(bus["slaves"])),
                _state(shown if bus["is_up"] else "down"),
                str(bus["cycles"]),
                str(bus["lost"]),
                f"{bus['received_wkc']} of {bus['expected_wkc']}",
                words.duration(bus["trip_us"]),
            )
    return table


def _process_data(stations: Sequence[Row]) -> RenderableType:
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
            table.add_row("", Text(station["name"], style="bold"))
        for row in pd["tx"]:
            why = row.get("last_reason") or next(reversed(row["reason"]), "silent")
            shown = _OFF if station["state"] == "PREOP" else REASONS.get(why, why)
            table.add_row("→", row["name"], _state(shown), str(row["sent"]))
        for row in pd["rx"]:
            table.add_row(*_received(row, _OFF if station["state"] in STATES else row["state"]))
    return table


def _received(row: Row, state: str) -> tuple[str | Text, ...]:
    lost, quality, age = row["lost"], row["quality"], row["age_us"]
    times = row.get("response_us") or row["jitter_us"]
    spread = [times[key] for key in ("p50", "p99", "max")]
    return (
        "←",
        row["name"],
        _state(state),
        str(row["received"]),
        Text("unknown", style=_DIM) if lost is None else Text(str(lost), style=_BAD * bool(lost)),
        words.quality(quality),
        "" if age is None else words.duration(age),
        "" if None in spread else " / ".join(map(str, spread)),
    )


def _frames(stations: Sequence[Row]) -> RenderableType:
    table = TextTable(
        "Frame",
        Column("Goes to", wraps=True),
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


def _state(state: str) -> Text:
    return Text(state, style=_STATE_STYLE.get(state, ""))
