"""A status document as tables: processes, stations with their ports, process data, remarks.

Pure: the document of ``eapctl status --json`` in, rich renderables out.  Tables hold what every row
has; what is rare, and worth a look because it is, follows below them in words.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from rich import box
from rich.console import RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from eap.cli import words

Row = Mapping[str, Any]

_GOOD, _BAD, _DIM = "green", "bold red", "dim"
_STATE_STYLE = {"OP": _GOOD, "running": _GOOD, "up": _GOOD, "stale": _BAD, "down": _BAD}
_OFF = "off"
_STATE_STYLE |= {"present": _GOOD, "missing": _BAD, "unknown": _DIM, _OFF: _DIM}
_HUNG_AFTER_US = 2_000_000
_HUNG_AFTER_CYCLES = 10
_NET_ID_DOTS = 5
_NOT_ASKED = "other: not asked for"
_REASONS = {
    "cycle": "cyclic",
    "divider": "divider",
    "change": "on change",
    "change_timeout": "resend",
    "event": "event",
    "poll": "polled",
}
_STATES = {
    "PREOP": "in PREOP, as was asked for last: it exchanges no process data",
    "SAFEOP": "in SAFEOP, as was asked for last: it receives no process data",
}
"""What it means when a station is there."""
_FRAME_STATES = {2: "larger than its network carries", 4: "nobody is there"}
"""What the bits of FrameState say beyond that a frame was not sent."""


def status_tables(document: Row) -> Iterator[RenderableType]:
    """Yield what to print for a status *document*, top to bottom."""
    stations = document["stations"]
    for appliance in document["appliances"]:
        yield _processes(appliance)
    yield _stations(stations)
    if any("bus" in port for station in stations for port in station["ports"]):
        yield _buses(stations)
    yield _process_data(stations)
    if any(_is_special(row) for station in stations for row in station.get("frames", ())):
        yield _frames(stations)
    remarks = [remark for appliance in document["appliances"] for remark in _of_engine(appliance)]
    remarks += [remark for station in stations for remark in _remarks(station)]
    if remarks:
        yield Text("Worth a look", style="bold")
        yield from (Padding(Text(remark), (0, 0, 0, 1)) for remark in remarks)


def _processes(appliance: Row) -> RenderableType:
    table = Table(title=f"Plant {appliance['plant']}", title_justify="left", title_style="bold")
    table.box, table.show_header, table.pad_edge = None, False, True
    for _ in range(5):
        table.add_column()
    processes = dict(appliance["processes"])
    segments = processes.pop("segments", {})
    processes |= {f"segment {name}": process for name, process in segments.items()}
    for name, process in processes.items():
        if not process["pid"]:
            table.add_row(name, Text("restarting", style=_BAD))
            continue
        if step := process.get("step"):
            table.add_row(name, f"process {process['pid']}", Text(f"starting: {step}", style=_BAD))
            continue
        cpu, rss = process.get("cpu"), process.get("rss")
        table.add_row(
            name,
            f"process {process['pid']}",
            "" if cpu is None else f"{cpu:.1f} % of a core",
            "" if rss is None else f"{rss / 1e6:.0f} MB",
            f"restarted {words.times(process['restarts'])}" if process.get("restarts") else "",
        )
    return table


def _of_engine(appliance: Row) -> Iterator[str]:
    """Yield what the engine asked for, to be on time, and was not given; and lost requests."""
    engine = appliance["processes"]["engine"]
    for what, outcome in engine.get("realtime", {}).items():
        if isinstance(outcome, str) and not outcome.startswith("fifo") and outcome != _NOT_ASKED:
            reason = outcome.removeprefix("other: ")
            yield f"{appliance['plant']} engine, {what.replace('_', ' ')}: {reason}"
    if counts := _counts(engine.get("bus_requests", {})):
        yield f"{appliance['plant']} engine, requests to buses: {counts}"


def _stations(stations: Sequence[Row]) -> RenderableType:
    table = _table("Station", "State", "Cycle", "Port", "Interface", "NetID", "Link")
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
    table = _table("Bus", "Slaves", "State", "Cycles", "Lost", "Counters", "Trip")
    for column in table.columns[3:]:
        column.justify, column.no_wrap = "right", True
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


def _bus_remarks(name: str, bus: Row) -> Iterator[str]:
    if bus["fault"]:
        yield f"{name}: {'; '.join(bus['fault'].splitlines())}"
    if bus["wkc_errors"]:
        yield f"{name}: {words.count(bus['wkc_errors'], 'cycle')} with a wrong working counter"
    for slave in bus["slaves"]:
        if slave["fault"]:
            yield f"{name} {slave['name']} ({slave['address']}): {slave['fault']}"


def _process_data(stations: Sequence[Row]) -> RenderableType:
    table = _table("", "Process data", "State", "Frames", "Lost", "Quality", "Age")
    table.add_column("Jitter or\nresponse µs\np50 / p99 / max")
    for column in table.columns[3:]:
        column.justify, column.no_wrap = "right", True
    for station in stations:
        pd = station["pd"]
        if pd["tx"] or pd["rx"]:
            table.add_row("", Text(station["name"], style="bold"))
        for row in pd["tx"]:
            why = row.get("last_reason") or next(reversed(row["reason"]), "silent")
            shown = _OFF if station["state"] == "PREOP" else _REASONS.get(why, why)
            table.add_row("→", row["name"], _state(shown), str(row["sent"]))
        for row in pd["rx"]:
            table.add_row(*_received(row, _OFF if station["state"] in _STATES else row["state"]))
    return table


def _received(row: Row, state: str) -> tuple[RenderableType, ...]:
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


def _is_special(row: Row) -> bool:
    """Tell whether a frame has more to say than its PDs: a monitored subscriber, or a NetID."""
    return bool(row["monitor_interval_ms"]) or row["destination"].count(".") == _NET_ID_DOTS


def _frames(stations: Sequence[Row]) -> RenderableType:
    table = _table("Frame", "Goes to", "Subscriber", "Frames", "Skipped")
    for column in table.columns[3:]:
        column.justify, column.no_wrap = "right", True
    for station in stations:
        for row in filter(_is_special, station.get("frames", ())):
            name, address = row["destination"], row["address"]
            table.add_row(
                f"{station['name']}/{row['name']}",
                name if name == address else f"{name} at {address or 'an unknown address'}",
                _state(row["subscriber"] if row["monitor_interval_ms"] else ""),
                str(row["sent"]),
                str(row["skipped"]),
            )
    return table


def _remarks(station: Row) -> Iterator[str]:
    name = station["name"]
    if own := "; ".join(_own_remarks(station)):
        yield f"{name}: {own}"
    for port in station["ports"]:
        if (bus := port.get("bus")) is not None:
            yield from _bus_remarks(f"{name}/{port['name']}", bus)
    for row in filter(_is_special, station.get("frames", ())):
        if row["address"] is None:
            waits = f"waits for a frame of {row['destination']}, to learn its MAC address"
            yield f"{name} → {row['name']}: {waits}"
    for row in station["pd"]["tx"]:
        if remark := "; ".join(_sent_remarks(row)):
            yield f"{name} → {row['name']}: {remark}"
    for row in station["pd"]["rx"]:
        if remark := "; ".join(_received_remarks(row)):
            yield f"{name} ← {row['name']}: {remark}"


def _own_remarks(station: Row) -> Iterator[str]:
    if meaning := _STATES.get(station["state"]):
        yield f"{meaning} until 'eapctl state {station['name']} OP'"
    silent_us = station.get("cycle_age_us") or 0
    if silent_us > max(_HUNG_AFTER_US, _HUNG_AFTER_CYCLES * station.get("cycle_us", 0)):
        yield f"has not run a cycle for {words.duration(silent_us)}"
    if overruns := station.get("overruns"):
        yield f"left out {words.count(overruns, 'cycle')}"
    if torn := station.get("torn"):
        yield f"found {words.count(torn, 'torn write')}"
    if held := station.get("links_held"):
        yield f"held {words.count(held, 'linked value')} back: no number"
    if discarded := _counts(station["discarded"]):
        yield f"turned away: {discarded}"


def _sent_remarks(row: Row) -> Iterator[str]:
    if row["skipped"]:
        yield f"skipped {words.times(row['skipped'])}"
    for bit, meaning in _FRAME_STATES.items():
        if row.get("frame_state", 0) & bit:
            yield meaning
    if len(row["reason"]) > 1:
        yield "sent " + ", ".join(
            f"{_REASONS.get(why, why)} {words.times(count)}" for why, count in row["reason"].items()
        )


def _received_remarks(row: Row) -> Iterator[str]:
    if row.get("timeouts"):
        yield f"timed out {words.times(row['timeouts'])}"
    for key in ("duplicated", "reordered", "late"):
        if row[key]:
            yield f"{row[key]} {key}"
    if discarded := _counts(row["discarded"]):
        yield f"discarded: {discarded}"
    if wrong := row.get("wrong_source"):
        ago = words.duration(wrong["age_us"])
        yield f"{wrong['address']} sends with this publisher ID, last {ago} ago: dropped"
    if other := row.get("other_source"):
        ago = words.duration(other["age_us"])
        yield (
            f"two senders with this publisher ID: {row['source']} and {other['address']}, "
            f"last {ago} ago"
        )


def _counts(counts: Row) -> str:
    words = (f"{count} {reason.replace('_', ' ')}" for reason, count in counts.items() if count)
    return ", ".join(words)


def _state(state: str) -> Text:
    return Text(state, style=_STATE_STYLE.get(state, ""))


def _table(*headings: str) -> Table:
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False)
    for heading in headings:
        table.add_column(heading, overflow="fold", vertical="top")
    return table
