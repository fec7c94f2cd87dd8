"""Findings of a status document: each fault with its location, its begin, and a remedy.

Pure: the document of ``eapctl status --json`` and the time in, a list of findings out, errors
first.
A finding comes from a generator of this module, which reads it from the counters and states, or
from the list ``findings`` that the services of an appliance report by themselves.  A new kind of
finding is one more ``yield``.

Counters of past events are of severity INFO: they are no present fault, and the one-screen view
omits them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from eap.quantities import age, count, duration
from eap.quantities import times as times_of

if TYPE_CHECKING:
    from eap.live.status import ApplianceStatus, MergedStatus, SilentAppliance

Row = Mapping[str, Any]

_HUNG_AFTER_US = 2_000_000
_HUNG_AFTER_CYCLES = 10
_NET_ID_DOTS = 5
_NOT_REQUESTED = "other: not requested"
_RECENT_US = 60_000_000
"""A sender that should not be there is a warning for so long, then a remark."""
_LISTED = 3
"""So many PDs or slaves with the same fault are named; of more, their number is given."""

REASONS = {
    "cycle": "cyclic",
    "divider": "divider",
    "change": "on change",
    "change_timeout": "resend",
    "event": "event",
    "poll": "polled",
}
STATES = {
    "PREOP": "the station exchanges no process data",
    "SAFEOP": "the station receives no process data",
}
"""Effect of the states that a station can be left in by request."""
LISTENER_COUNTS = {
    "refused": "refused",
    "evicted": "closed in favour of others",
    "overdue": "closed as too slow",
}
_MOST_DESCRIPTORS = 0.9
"""Share of the limit from which on it is a warning."""
_TOO_LARGE, _NO_SUBSCRIBER = 2, 4
"""Bits of FrameState."""
PUBLISHER_HINT = (
    "TwinCAT 2 sends the NetID of its system as publisher, TwinCAT 3 that of the EAP device"
)
VERSION_HINT = (
    "TwinCAT 2 sends a hash of the type of a structure as version: take it over, or set"
    " ignore_version"
)
_HINTS = (PUBLISHER_HINT, VERSION_HINT)
"""Likely reasons that concern all publishers of a kind: shown once, however many PDs they drop."""
_OTHER_VERSION, _OTHER_LENGTH = 1, 2
"""Values of VarState of a received PD."""


class Severity(StrEnum):
    """Severity of a finding."""

    ERROR = "error"  # a function fails now
    WARNING = "warning"  # it works, but not as configured
    INFO = "info"  # something happened since the start


@dataclass(frozen=True, slots=True)
class StatusFinding:
    """One fault or remark.

    Attributes:
        severity: Its severity.
        where: Name of the appliance's process, station, port, slave or PD.
        what: The fault.
        advice: The remedy, or empty.
        since: Unix time at which it began, if that is known.
        plant: Plant of the appliance.
    """

    severity: Severity
    where: str
    what: str
    advice: str = ""
    since: float | None = None
    plant: str = ""

    def text(self, now_s: float) -> str:
        """Return the finding as a sentence: what happened, since when; what to do."""
        # The time belongs to the fault, and so stands before the details that follow it.
        fault, *details = self.what.split("; ")
        since = "" if self.since is None else f", since {_moment(self.since, now_s)}"
        parts = [f"{self.where}: {fault}{since}", *details, self.advice]
        return "; ".join(filter(None, parts))


@dataclass(frozen=True, slots=True)
class StatusReport:
    """Status of several appliances and the findings in it: the object of ``status --json``.

    Its other fields are those of :class:`eap.ops.client.MergedStatus`.
    """

    version: int
    processes: Row
    stations: list[Row]
    appliances: list[ApplianceStatus]
    silent: list[SilentAppliance]
    findings: list[StatusFinding]


def findings(status: MergedStatus, now_s: float) -> list[StatusFinding]:
    """Return all findings of *status*, errors first, then warnings."""
    found = [
        StatusFinding(
            Severity.ERROR,
            f"{silent.plant} ({', '.join(silent.stations)})",
            "services does not answer",
            f"look at process {silent.services}, or restart the appliance",
            plant=silent.plant,
        )
        for silent in status.silent
    ]
    found += [
        replace(each, plant=appliance.plant)
        for appliance in status.appliances
        for each in _of_appliance(appliance, appliance_label(status, appliance))
    ]
    for appliance in status.appliances:
        plant, label = appliance.plant, appliance_label(status, appliance)
        stations = _stations_of(status, appliance)
        found += [replace(each, plant=plant) for each in _of_engine(label, stations, now_s)]
        for station in stations:
            found += [replace(each, plant=plant) for each in _of_station(station)]
    # Sorted by severity alone: findings of one severity stay in the order of the plant.
    order = list(Severity)
    return _hinted_once(sorted(found, key=lambda each: order.index(each.severity)))


def _hinted_once(found: Sequence[StatusFinding]) -> list[StatusFinding]:
    """Return *found* with each of the general hints at its first place only."""
    shown: set[str] = set()
    result = []
    for each in found:
        hints = {hint for hint in _HINTS if hint in each.advice}
        advice = each.advice
        for hint in hints & shown:
            advice = advice.replace(f"; {hint}", "")
        shown |= hints
        result.append(replace(each, advice=advice))
    return result


def appliance_label(
    status: MergedStatus | StatusReport, appliance: ApplianceStatus | SilentAppliance
) -> str:
    """Return the plant of an appliance, with its stations where others run parts of that plant."""
    plants = [each.plant for each in status.appliances]
    plants += [each.plant for each in status.silent]
    plant = appliance.plant
    if plants.count(plant) == 1:
        return plant
    return f"{plant} ({', '.join(appliance.stations)})"


def _stations_of(status: MergedStatus, appliance: ApplianceStatus) -> list[Row]:
    """Return the stations of one appliance: several of them may run parts of one plant."""
    names, plant = set(appliance.stations), appliance.plant
    return [row for row in status.stations if row["plant"] == plant and row["name"] in names]


def is_special(frame: Row) -> bool:
    """Return whether a frame has a monitored subscriber or a NetID as its destination."""
    # A NetID has six numbers: five dots, which no IPv4 address has.
    return bool(frame["monitor_interval_ms"]) or frame["destination"].count(".") == _NET_ID_DOTS


def _error(where: str, what: str, advice: str = "", since: float | None = None) -> StatusFinding:
    return StatusFinding(Severity.ERROR, where, what, advice, since)


def _warning(where: str, what: str, advice: str = "", since: float | None = None) -> StatusFinding:
    return StatusFinding(Severity.WARNING, where, what, advice, since)


def _info(where: str, what: str) -> StatusFinding:
    return StatusFinding(Severity.INFO, where, what)


def _of_appliance(appliance: ApplianceStatus, plant: str) -> Iterator[StatusFinding]:
    for row in appliance.findings:
        yield StatusFinding(**{**row, "severity": Severity(row["severity"])})
    processes = dict(appliance.processes)
    segments = processes.pop("segments", {})
    processes |= {f"segment {name}": process for name, process in segments.items()}
    for name, process in processes.items():
        yield from _of_process(f"{plant} {name}", process)
    if audit := appliance.audit:
        yield from _of_audit(f"{plant} audit", audit)
    for name, process in processes.items():
        yield from _of_descriptors(f"{plant} {name}", process.get("descriptors"))
    for listener in appliance.listeners:
        yield from _of_listener(plant, listener)
    engine = processes["engine"]
    refused = [
        f"{name.replace('_', ' ')} ({outcome.removeprefix('other: ')})"
        for name, outcome in engine.get("realtime", {}).items()
        if isinstance(outcome, str) and not outcome.startswith("fifo") and outcome != _NOT_REQUESTED
    ]
    if refused:
        advice = "cycles may be late: run as root, or use --no-realtime"
        yield _warning(f"{plant} engine", f"no realtime: {', '.join(refused)}", advice)
    if counts := _counts(engine.get("bus_requests", {})):
        yield _info(f"{plant} engine", f"requests to buses: {counts}")


def _of_process(where: str, process: Row) -> Iterator[StatusFinding]:
    if fault := process.get("fault"):  # of an optional process
        yield _warning(where, f"not running: {fault}")
    elif not process["pid"]:
        yield _error(where, "not running", "it is being restarted")
    elif step := process.get("step"):
        yield _warning(where, f"starting: {step}")


def _of_audit(where: str, audit: Row) -> Iterator[StatusFinding]:
    lost, error = count(audit["lines"], "line"), audit["error"]
    if error:
        effect = "changes are refused" if audit["required"] else "changes are not recorded"
        advice = f"{lost} lost; free space for {audit['file']}, or make its folder writable"
        yield _error(where, f"cannot be written: {error}; {effect}", advice, audit["since"])
    elif audit["lines"]:
        yield _warning(where, f"{lost} lost; written again", since=audit["since"])


def _of_descriptors(where: str, descriptors: Row | None) -> Iterator[StatusFinding]:
    if descriptors is not None and descriptors["used"] > _MOST_DESCRIPTORS * descriptors["limit"]:
        what = f"{descriptors['used']} of {descriptors['limit']} file descriptors are in use"
        yield _warning(where, what, "raise the hard limit (ulimit -Hn, or LimitNOFILE= of systemd)")


def _of_listener(plant: str, listener: Row) -> Iterator[StatusFinding]:
    counts = {name: listener[key] for key, name in LISTENER_COUNTS.items() if listener[key]}
    if not counts:
        return
    ago_us = listener["crowded_ago_us"]
    where, what = f"{plant} {listener['name']}", _counts(counts)
    if ago_us is not None and ago_us < _RECENT_US:
        places = f"{listener['open']} of {listener['limit']} connections in use"
        _, _, number = listener["name"].rpartition(":")
        advice = f"'ss -tn sport = :{number}' shows the hosts" if number.isdecimal() else ""
        yield _warning(where, f"{places}; connections: {what}", advice)
    else:
        yield _info(where, f"connections: {what}")


def _of_engine(label: str, stations: Sequence[Row], now_s: float) -> Iterator[StatusFinding]:
    """Yield one finding for all stations that the engine runs no more."""
    # All stations share the engine: one line says it, not one for each of them.
    if hung := [station for station in stations if is_hung(station)]:
        names = ", ".join(station["name"] for station in hung)
        of_all = "any station" if len(hung) == len(stations) > 1 else names
        since = now_s - max(station["cycle_age_us"] for station in hung) / 1e6
        what = f"runs no cycles of {of_all}"
        yield _error(f"{label} engine", what, "see the log of 'eapctl run'", since)


def is_hung(station: Row) -> bool:
    """Return whether the engine has run no cycle of *station* for long."""
    # A long device cycle is no fault: the limit is ten cycles, and at least two seconds.
    silent_us: int = station.get("cycle_age_us") or 0
    cycle_us: int = station.get("cycle_us", 0)
    return silent_us > max(_HUNG_AFTER_US, _HUNG_AFTER_CYCLES * cycle_us)


def _of_station(station: Row) -> Iterator[StatusFinding]:
    yield from _of_cycles(station)
    for port in station["ports"]:
        yield from _of_port(station, port)
    for frame in filter(is_special, station.get("frames", ())):
        if frame["address"] is None:
            waits = f"MAC address of {frame['destination']} unknown: waiting for a frame from it"
            yield _warning(f"{station['name']} → {frame['name']}", waits)
    for row in station["pd"]["tx"]:
        yield from _of_sent(f"{station['name']} → {row['name']}", row)
    # A station in PREOP or SAFEOP receives nothing by request: its subscriptions are not stale.
    if station["state"] not in STATES:
        yield from _of_silent(station)
    for row in station["pd"]["rx"]:
        yield from _of_received(f"{station['name']} ← {row['name']}", row)
    yield from _of_sources(station)


def _of_port(station: Row, port: Row) -> Iterator[StatusFinding]:
    where = f"{station['name']}/{port['name']}"
    if (bus := port.get("bus")) is not None:
        yield from _of_bus(where, bus)
    elif fault := port.get("fault"):
        yield _error(where, fault, "it is found again when it comes back")
    elif port.get("link") == "down" and port["kind"] != "bus":
        advice = f"check cable and interface of {port['interface']}"
        yield _error(where, "link down", advice)
    # An engine that hangs exchanges no frames either: that is one finding, not one per bus.
    elif port.get("link") == "down" and not is_hung(station):
        yield _error(where, "no frame comes back", "check cable and interface of the bus")


def _of_cycles(station: Row) -> Iterator[StatusFinding]:
    name, state = station["name"], station["state"]
    if effect := STATES.get(state):
        advice = f"'eapctl state {name} OP' returns it to OP"
        yield _warning(name, f"in {state}, as requested: {effect}", advice)
    if held := station.get("links_held"):
        yield _warning(name, f"{count(held, 'linked value')} held back: not a number")
    if overruns := station.get("overruns"):
        yield _info(name, f"{count(overruns, 'cycle')} skipped: overrun")
    if torn := station.get("torn"):
        yield _info(name, f"{count(torn, 'torn write')} read")
    for text in _dropped(station["discarded"]):
        yield _info(name, text)


_BUS_COUNTERS = (
    ("wkc_errors", "cycle", "with a wrong working counter"),
    ("lost", "exchange", "lost: no frame came back"),
    ("late", "exchange", "late: the bus or this host was busy"),
    ("skipped", "exchange", "skipped: others were pending"),
)


def _of_bus(where: str, bus: Row) -> Iterator[StatusFinding]:
    advice = f"'eapctl bus diag {where}' shows details"
    if bus["fault"]:
        lines = "; ".join(line.strip() for line in bus["fault"].splitlines())
        yield _error(where, lines.replace(":; ", ": "), advice)
    elif not bus["is_up"]:
        yield _warning(where, "starting up")
    for each in bus.get("findings", []):
        if each["is_over"]:
            yield _info(where, f"{each['what']}; 'eapctl bus diag {where} --reset' clears this")
        elif each["until"] is not None:  # it happened a short time ago, and may again
            yield _warning(where, each["what"], each["advice"] or advice)
        else:
            yield _error(where, each["what"], each["advice"] or advice, each["since"])
    for key, noun, text in _BUS_COUNTERS:
        if number := bus.get(key):
            yield _info(where, f"{count(number, noun)} {text}")


def _of_sent(where: str, row: Row) -> Iterator[StatusFinding]:
    frame_state = row.get("frame_state", 0)
    if frame_state & _TOO_LARGE:
        advice = "use fewer or smaller PDs in its frame"
        yield _error(where, "not sent: its frame exceeds the maximum size of its network", advice)
    if frame_state & _NO_SUBSCRIBER:
        advice = "check cable and power of the receiving station"
        yield _error(where, "its subscriber does not answer", advice)
    if row["skipped"]:
        yield _info(where, f"skipped {times_of(row['skipped'])}")
    if len(row["reason"]) > 1:
        counts = (
            f"{REASONS.get(why, why)} {times_of(count)}" for why, count in row["reason"].items()
        )
        yield _info(where, f"sent {', '.join(counts)}")


def _of_silent(station: Row) -> Iterator[StatusFinding]:
    """Yield the subscriptions that receive nothing; many with the same fault as one finding."""
    stale = [row for row in station["pd"]["rx"] if row["state"] == "stale"]
    yield from _silent(station, stale, "stale: nothing received within the timeout", _error)
    waiting = [row for row in station["pd"]["rx"] if row["state"] == "waiting"]
    # Losses are counted only at a fixed step: without one, silence may be as configured.
    cyclic = [row for row in waiting if row["lost"] is not None]
    yield from _silent(station, cyclic, "nothing received yet", _warning)
    if rest := [row["name"] for row in waiting if row["lost"] is None]:
        yield _info(f"{station['name']} ← {', '.join(rest)}", "nothing received yet")


def _silent(
    station: Row, rows: Sequence[Row], what: str, finding: Callable[..., StatusFinding]
) -> Iterator[StatusFinding]:
    """Yield silent subscriptions, those apart whose PD ID another publisher sends."""
    others = [row for row in rows if row["discarded"].get("wrong_publisher")]
    alone = [row for row in rows if row not in others]
    advice = "check its sender and the network path"
    if station["discarded"].get("truncated"):
        advice += "; frames were dropped as truncated: 'eapctl discover' shows a wrong length"
    yield from _grouped(station, alone, what, advice, finding)
    advice = f"'eapctl discover' shows its NetID; {PUBLISHER_HINT}"
    what = f"{what}; another publisher sends its PD ID"
    yield from _grouped(station, others, what, advice, finding)


def _grouped(
    station: Row,
    rows: Sequence[Row],
    what: str,
    advice: str,
    finding: Callable[..., StatusFinding],
) -> Iterator[StatusFinding]:
    name = station["name"]
    if len(rows) <= _LISTED:
        for row in rows:
            yield finding(f"{name} ← {row['name']}", what, advice, row.get("last_good"))
        return
    # The earliest of them: the fault began with the first PD that stopped.
    times = [row["last_good"] for row in rows if row.get("last_good")]
    of_all = f"{len(rows)} of {len(station['pd']['rx'])} received PDs"
    where = f"{name} ← {rows[0]['name']} and others ({of_all})"
    yield finding(where, what, advice, min(times, default=None))


_RX_REMARKS = ("duplicated", "repeated", "reordered", "late")


def _of_received(where: str, row: Row) -> Iterator[StatusFinding]:
    if wrong := {_OTHER_VERSION: "version", _OTHER_LENGTH: "length"}.get(row.get("var_state", 0)):
        advice = "compare the plant files of both stations"
        if wrong == "version":
            advice += f"; {VERSION_HINT}"
        else:
            advice += ", and the packing of their structs"
        yield _error(where, f"dropped: unexpected {wrong}", advice)
    remarks = []
    if row.get("timeouts"):
        remarks.append(f"timed out {times_of(row['timeouts'])}")
    remarks += [f"{row[key]} {key}" for key in _RX_REMARKS if row.get(key)]
    remarks += _dropped(row["discarded"])
    if remarks:
        yield _info(where, "; ".join(remarks))


def _of_sources(station: Row) -> Iterator[StatusFinding]:
    """Yield one finding for each address that sends with a foreign publisher ID."""
    wrong: dict[str, list[Row]] = {}
    for row in station["pd"]["rx"]:
        if source := row.get("wrong_source"):
            what = f"{source['address']} sends with this publisher ID: dropped"
            # By text: one wrong sender concerns many PDs, and is one finding.
            wrong.setdefault(what, []).append(row | {"ago_us": source["age_us"]})
        if source := row.get("other_source"):
            both = " and ".join(sorted((row["source"], source["address"])))
            what = f"two senders with this publisher ID: {both}"
            wrong.setdefault(what, []).append(row | {"ago_us": source["age_us"]})
    for what, rows in wrong.items():
        ago_us = min(row["ago_us"] for row in rows)
        first, last = f"{station['name']} ← {rows[0]['name']}", duration(ago_us)
        where = f"{first} and {count(len(rows) - 1, 'other')}" if len(rows) > 1 else first
        text = f"{what}; last {last} ago"
        if ago_us > _RECENT_US:
            yield _info(where, text)
        else:
            yield _warning(where, text, "stop the wrong sender")


_WRONG_LENGTH = "wrong_length"
_NOT_AUTHENTIC = ("unsigned", "bad_tag", "replayed")
"""Reasons for which frames are dropped, or only counted, as the subscription says."""


def _dropped(counts: Row) -> Iterator[str]:
    """Yield what was dropped, and what was taken though its frame was not right."""
    apart = {_WRONG_LENGTH, *_NOT_AUTHENTIC}
    if dropped := _counts({why: n for why, n in counts.items() if why not in apart}):
        yield f"dropped: {dropped}"
    if forged := _counts({why: counts.get(why, 0) for why in _NOT_AUTHENTIC}):
        yield f"not authentic: {forged}"
    if taken := counts.get(_WRONG_LENGTH):
        yield f"taken in spite of a wrong frame length: {taken}"


def _counts(counts: Row) -> str:
    listed = (f"{count} {reason.replace('_', ' ')}" for reason, count in counts.items() if count)
    return ", ".join(listed)


def _moment(at_s: float, now_s: float) -> str:
    """Return a time of day and its age, with the date if it is another day."""
    at, now = (datetime.fromtimestamp(each).astimezone() for each in (at_s, now_s))
    form = "%H:%M:%S" if at.date() == now.date() else "%Y-%m-%d %H:%M:%S"
    return f"{at.strftime(form)} ({age(at_s, now_s)})"
