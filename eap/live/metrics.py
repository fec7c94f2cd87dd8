"""Metrics of plants in the OpenMetrics text format, from a status report.

Each family is a row of a table: its name, type, help, and the place of its value in the rows of
the status document.  Values have base units (seconds, bytes, ratios), as Prometheus wants them.
The series of a plant are bounded by its plant file: stations, ports, PDs and slaves that it names,
and the fixed reasons for dropping and sending.  No value of a variable, address of a peer or text
becomes a label.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, Final, NamedTuple, TypeAlias

from eap.live.findings import Severity, StatusFinding, StatusReport
from eap.live.status import ApplianceStatus
from eap.release import RELEASE

CONTENT_TYPE: Final = "application/openmetrics-text; version=1.0.0; charset=utf-8"
MAX_SERIES: Final = 50_000
"""Series of one answer; what a larger plant has beyond is counted in eap_metrics_left_out."""

Row: TypeAlias = Mapping[str, Any]
ValueReader: TypeAlias = Callable[[Row], Any]

_MICRO: Final = 1e-6
_NANO: Final = 1e-9
_QUALITY_S: Final = 1e-4
"""Seconds of one unit of quality."""
_STATES: Final = ("INIT", "PREOP", "BOOT", "SAFEOP", "OP", "unknown")
_UNITS: Final = ("seconds", "bytes", "ratio")
_SUFFIXES: Final = {"counter": "_total", "info": "_info"}
"""Of samples, behind the name of their family."""


class Family(NamedTuple):
    """One metric family.

    Attributes:
        name: Its name, without the suffix _total of counters.
        type: ``counter``, ``gauge`` or ``info``.
        help: Its description.
        read: Returns its value of a row; None leaves the series out.  A mapping becomes one series
            for each key, in the label *label*.
        label: Name of that label.
    """

    name: str
    type: str
    help: str
    read: ValueReader
    label: str = ""

    def head(self) -> str:
        """Return its lines of metadata."""
        unit = next((each for each in _UNITS if self.name.endswith(f"_{each}")), "")
        lines = [f"# TYPE {self.name} {self.type}"]
        lines += [f"# UNIT {self.name} {unit}"] if unit else []
        return "\n".join((*lines, f"# HELP {self.name} {_escape(self.help)}", ""))

    def prefix(self, labels: str, value: str = "") -> str:
        """Return a sample without its number; *value* is that of its own label."""
        own = f'{self.label}="{_escape(value)}"' if self.label else ""
        inside = ",".join(each for each in (labels, own) if each)
        return f"{self.name}{_SUFFIXES.get(self.type, '')}{{{inside}}} "


def _key(*path: str, scale: float = 1) -> ValueReader:
    """Return a reader of the value at *path* in a row; None where a key is missing."""

    def read(row: Row) -> Any:
        value: Any = row
        for key in path:
            if value is None:
                return None
            value = value.get(key)
        return value if value is None or scale == 1 else value * scale

    return read


def _quantiles(key: str) -> ValueReader:
    """Return a reader of the quantiles that a row has in microseconds, such as ``p99``."""

    def read(row: Row) -> dict[str, float] | None:
        found = row.get(key)
        if found is None:
            return None
        names = {"p50": "0.5", "p99": "0.99", "max": "1"}
        return {
            quantile: found[name] * _MICRO
            for name, quantile in names.items()
            if found.get(name) is not None
        }

    return read


def _present(key: str, known: Iterable[str]) -> ValueReader:
    """Return a reader of a state as one series for each *known* one: 1 of the present one."""
    # A generator could be read once only.
    states = tuple(known)

    def read(row: Row) -> dict[str, int]:
        present = row.get(key)
        return {state: int(state == present) for state in states}

    return read


def _is(key: str, wanted: object) -> ValueReader:
    """Return a reader: 1 where the value at *key* is *wanted*, else 0; None without that key."""
    return lambda row: int(row[key] == wanted) if key in row else None


def _counter(name: str, text: str, *path: str, scale: float = 1) -> Family:
    return Family(name, "counter", text, _key(*path, scale=scale))


def _gauge(name: str, text: str, *path: str, scale: float = 1) -> Family:
    return Family(name, "gauge", text, _key(*path, scale=scale))


def _slave_states(bus: Row) -> dict[str, int]:
    # States without a slave are 0: a series that is missing raises no alert.
    counts = dict.fromkeys((*_STATES, "absent"), 0)
    for slave in bus["slaves"]:
        state = "absent" if slave.get("is_absent") else slave["state"]
        counts[state if state in counts else "unknown"] += 1
    return counts


def _bridge_is_up(bridge: Row) -> int:
    # One that only reads controllers has no peer of its own.
    own = bridge["is_up"] or not bridge["peer"]
    return int(own and all(peer["is_up"] for peer in bridge.get("peers", ())))


_APPLIANCE = (
    Family(
        "eap_findings",
        "gauge",
        "Present errors and warnings, and remarks on what happened since the start.",
        _key("findings"),
        "severity",
    ),
    _counter(
        "eap_audit_lost_lines", "Lines that could not be written to the audit.", "audit", "lines"
    ),
)
_PROCESS = (
    Family(
        "eap_process_up", "gauge", "1 while the process runs.", lambda row: int(bool(row["pid"]))
    ),
    _counter("eap_process_restarts", "Restarts since the appliance began.", "restarts"),
    _gauge("eap_process_cpu_ratio", "CPU time, as a share of one core.", "cpu", scale=0.01),
    _gauge("eap_process_resident_memory_bytes", "Memory.", "rss"),
    _gauge("eap_process_open_descriptors", "File descriptors in use.", "descriptors", "used"),
    _gauge("eap_process_max_descriptors", "Limit of file descriptors.", "descriptors", "limit"),
    _counter(
        "eap_process_malformed_bus_requests",
        "Messages of services to the engine that were no request.",
        *("bus_requests", "malformed"),
    ),
    _counter(
        "eap_process_dropped_bus_answers",
        "Answers of the engine that services did not read.",
        *("bus_requests", "dropped"),
    ),
)
_LOGINS = (
    Family(
        "eap_refused_logins",
        "counter",
        "Logins that servers refused.",
        _key("counts"),
        "why",
    ),
)
_BRIDGE = (
    Family(
        "eap_bridge_up",
        "gauge",
        "1 while the bridge listens or is connected, to all its controllers, too.",
        _bridge_is_up,
    ),
    _gauge("eap_bridge_clients", "Connections to the bridge, where it is a server.", "clients"),
    _counter("eap_bridge_sent_values", "Values passed on from the plant.", "sent"),
    _counter("eap_bridge_received_writes", "Writes that clients requested.", "received"),
    _counter("eap_bridge_refused_writes", "Those that were not done.", "refused"),
    _counter(
        "eap_bridge_dropped", "Values and requests left out for a slow other side.", "dropped"
    ),
)
_LISTENER = (
    _gauge("eap_listener_connections", "Open connections.", "open"),
    _gauge("eap_listener_max_connections", "Limit of open connections.", "limit"),
    _counter(
        "eap_listener_refused", "Connections refused because all places were taken.", "refused"
    ),
    _counter("eap_listener_evicted", "Connections closed in favour of others.", "evicted"),
    _counter("eap_listener_overdue", "Connections closed as too slow.", "overdue"),
)
_STATION = (
    Family(
        "eap_station_state",
        "gauge",
        "1 for the present state of the station.",
        _present("state", ("INIT", "PREOP", "SAFEOP", "OP")),
        "state",
    ),
    _counter("eap_station_cycles", "Cycles.", "cycle"),
    _counter("eap_station_overruns", "Cycles that were left out.", "overruns"),
    _counter("eap_station_restarts", "Restarts of the engine below this station.", "restarts"),
    _counter(
        "eap_station_torn_cycles", "Cycles in which a writer had stopped while writing.", "torn"
    ),
    _counter("eap_station_held_links", "Values that a link did not copy.", "links_held"),
    _gauge("eap_station_cycle_seconds", "Configured cycle time.", "cycle_us", scale=_MICRO),
    _gauge(
        "eap_station_cycle_age_seconds", "Time since the last cycle.", "cycle_age_us", scale=_MICRO
    ),
    Family(
        "eap_station_lateness_seconds",
        "gauge",
        "Lateness of the latest cycles; quantile 1 is the largest since the start.",
        _quantiles("lateness_us"),
        "quantile",
    ),
    Family(
        "eap_station_discarded",
        "counter",
        "Frames and connections dropped, by reason.",
        _key("discarded"),
        "reason",
    ),
)
_PORT = (
    Family("eap_port_up", "gauge", "1 while the link of the port is up.", _is("link", "up")),
    Family(
        "eap_port_fault",
        "gauge",
        "1 while interface or address is gone.",
        lambda row: int("fault" in row),
    ),
)
_FRAME = (
    _counter("eap_frame_sent", "Frames sent.", "sent"),
    _counter("eap_frame_skipped", "Frames that were due and not sent.", "skipped"),
)
_SENT_PD = (
    _counter("eap_pd_sent", "PDs sent.", "sent"),
    _counter("eap_pd_skipped", "PDs that were due and not sent.", "skipped"),
    Family("eap_pd_triggered", "counter", "PDs sent, by trigger.", _key("reason"), "reason"),
)
_RECEIVED_PD = (
    _counter("eap_pd_received", "PDs received.", "received"),
    _counter("eap_pd_lost", "PDs lost, where the sender's step is known.", "lost"),
    _counter("eap_pd_duplicated", "PDs that came twice.", "duplicated"),
    _counter("eap_pd_reordered", "PDs behind a later one.", "reordered"),
    _counter("eap_pd_late", "PDs that came later than expected by more than one cycle.", "late"),
    _counter("eap_pd_timeouts", "Time-outs of the subscription.", "timeouts"),
    _counter("eap_pd_repeated", "Repeated frames.", "repeated"),
    Family("eap_pd_discarded", "counter", "PDs dropped, by reason.", _key("discarded"), "reason"),
    Family("eap_pd_running", "gauge", "1 while the PD arrives in time.", _is("state", "running")),
    _gauge("eap_pd_age_seconds", "Age of the last accepted PD.", "age_us", scale=_MICRO),
    _gauge("eap_pd_quality_seconds", "Age of its data.", "quality", scale=_QUALITY_S),
    Family(
        "eap_pd_jitter_seconds",
        "gauge",
        "Deviation of arrivals from the cycle; quantile 1 is the largest.",
        _quantiles("jitter_us"),
        "quantile",
    ),
    Family(
        "eap_pd_response_seconds",
        "gauge",
        "Time from a request to its answer, of polled PDs.",
        _quantiles("response_us"),
        "quantile",
    ),
)
_BUS = (
    Family("eap_bus_up", "gauge", "1 after the bus was brought up.", _is("is_up", True)),
    Family(
        "eap_bus_findings", "gauge", "Present errors of the bus.", lambda row: len(row["findings"])
    ),
    Family("eap_bus_slaves", "gauge", "Slaves, by state.", _slave_states, "state"),
    _counter("eap_bus_exchanges", "Exchanges of process data.", "cycles"),
    _counter("eap_bus_lost_exchanges", "Exchanges that were lost.", "lost"),
    _counter("eap_bus_late_exchanges", "Exchanges that came back after their time-out.", "late"),
    _counter("eap_bus_skipped_exchanges", "Cycles without an exchange.", "skipped"),
    _counter(
        "eap_bus_working_counter_errors", "Exchanges with a wrong working counter.", "wkc_errors"
    ),
    _gauge("eap_bus_exchange_seconds", "Duration of the last exchange.", "trip_us", scale=_MICRO),
    _gauge(
        "eap_bus_slowest_exchange_seconds",
        "Duration of the slowest exchange since the start.",
        "max_trip_us",
        scale=_MICRO,
    ),
    *(
        _counter(f"eap_bus_{name}_frames", f"Frames of the bus: {name}.", "frames", name)
        for name in ("sent", "received", "late", "lost", "retried")
    ),
    _gauge(
        "eap_bus_round_trip_seconds",
        "Mean time of the latest frames.",
        *("frames", "round_trip_us"),
        scale=_MICRO,
    ),
    _gauge("eap_bus_clock_locked", "1 while the cycle follows the clocks.", "lock", "is_locked"),
    _gauge(
        "eap_bus_clock_offset_seconds",
        "Mean offset of the frames to the clocks; positive if they come late.",
        *("lock", "offset_ns"),
        scale=_NANO,
    ),
    _gauge(
        "eap_bus_clock_drift_ratio",
        "Drift of this host's clock.",
        *("lock", "drift_ppb"),
        scale=1e-9,
    ),
    _gauge("eap_bus_ring_whole", "1 while no cable of the ring is cut.", "ring", "is_whole"),
    _counter("eap_bus_ring_cuts", "Cuts of the ring.", "ring", "cuts"),
    _counter("eap_bus_ethernet_received", "Frames from this host to slaves.", "eoe", "received"),
    _counter("eap_bus_ethernet_sent", "Frames of slaves to this host.", "eoe", "sent"),
    _counter("eap_bus_ethernet_dropped", "Ethernet frames dropped.", "eoe", "dropped"),
)
_SLAVE = (
    Family(
        "eap_slave_faulty",
        "gauge",
        "1 while the slave has a fault.",
        lambda row: int(bool(row["fault"])),
    ),
    _counter("eap_slave_emergencies", "Emergencies.", "emergencies"),
)
_OWN = (
    Family("eap", "info", "Release of this program.", lambda row: {RELEASE: 1}, "release"),
    _gauge("eap_unreachable", "Appliances and hosts that do not answer.", "unreachable"),
    _gauge("eap_metrics_left_out", "Series beyond the limit of one answer.", "left_out"),
)
FAMILIES: Final = (
    *_APPLIANCE, *_LOGINS, *_PROCESS, *_BRIDGE, *_LISTENER, *_STATION, *_PORT, *_FRAME, *_SENT_PD,
    *_RECEIVED_PD, *_BUS, *_SLAVE, *_OWN,
)  # fmt: skip


_Labels: TypeAlias = tuple[str, ...]
"""Names and values in turn."""
_LabelledRow: TypeAlias = tuple[tuple[Family, ...], _Labels, Row]
"""Families, and the row that their values are of."""


class MetricsWriter:
    """Metrics of the same plants again and again; what does not change is made once."""

    def __init__(self) -> None:
        self._prefixes: dict[tuple[str, ...], list[str | dict[str, str]]] = {}
        """Samples without their numbers, by the row they are of."""
        self._heads = {family.name: family.head() for family in FAMILIES}

    def write(self, status: StatusReport, unreachable: int = 0) -> str:
        """Return the metrics of a report, which ends with ``# EOF``.

        Args:
            status: The appliances that answer.
            unreachable: Number of those that do not, of which there are no other series.
        """
        samples: dict[str, list[str]] = {family.name: [] for family in FAMILIES}
        left = MAX_SERIES
        left_out = 0
        known = len(self._prefixes)
        seen = 0
        for families, labels, row in _rows(status):
            seen += 1
            lines = self._samples(families, labels, row)
            # The rows come in the order of their importance: what is left out is the least.
            if len(lines) > left:
                left_out += len(lines)
                continue
            left -= len(lines)
            for name, line in lines:
                samples[name].append(line)
        own = {"left_out": left_out, "unreachable": unreachable}
        for name, line in self._samples(_OWN, (), own):
            samples[name].append(line)
        if known > 2 * seen + 16:
            # Stations or PDs have gone: the next report makes those again that are left.
            self._prefixes.clear()
        parts: list[str] = []
        for name, texts in samples.items():
            if texts:
                parts += (self._heads[name], *texts)
        return "".join((*parts, "# EOF\n"))

    def _samples(
        self, families: tuple[Family, ...], labels: _Labels, row: Row
    ) -> list[tuple[str, str]]:
        """Return name of the family and line of each sample of a row."""
        key = (families[0].name, *labels)
        prefixes = self._prefixes.get(key)
        if prefixes is None:
            text = _label_text(labels)
            prefixes = [{} if each.label else each.prefix(text) for each in families]
            self._prefixes[key] = prefixes
        lines: list[tuple[str, str]] = []
        for family, prefix in zip(families, prefixes, strict=True):
            value = family.read(row)
            if value is None:
                continue
            if isinstance(prefix, str):
                lines.append((family.name, f"{prefix}{_number(value)}\n"))
                continue
            for each, number in value.items():
                if (begin := prefix.get(each)) is None:
                    begin = prefix[each] = family.prefix(_label_text(labels), str(each))
                lines.append((family.name, f"{begin}{_number(number)}\n"))
        return lines


def _rows(status: StatusReport) -> Iterator[_LabelledRow]:
    """Yield the rows of a report with their families and labels, the important ones first."""
    plants = Counter(appliance.plant for appliance in status.appliances)
    for appliance in status.appliances:
        labels: _Labels = ("plant", appliance.plant)
        if plants[appliance.plant] > 1:
            # Appliances of one plant differ in their stations alone.
            labels += ("stations", "+".join(appliance.stations))
        yield from _appliance_rows(appliance, labels, status.findings)
    stations: list[tuple[_Labels, Row]] = [
        (("plant", station["plant"], "station", station["name"]), station)
        for station in status.stations
    ]
    for labels, station in stations:
        yield _STATION, labels, station
        for port in station["ports"]:
            yield _PORT, (*labels, "port", port["name"]), port
            if bus := port.get("bus"):
                yield _BUS, (*labels, "port", port["name"]), bus
    for labels, station in stations:
        yield from _pd_rows(station, labels)
        yield from _slave_rows(station, labels)


def _appliance_rows(
    appliance: ApplianceStatus, labels: _Labels, found: Iterable[StatusFinding]
) -> Iterator[_LabelledRow]:
    # As above: severities without a finding are 0.
    counts = dict.fromkeys(map(str, Severity), 0)
    for finding in found:
        if finding.plant == appliance.plant:
            counts[str(finding.severity)] += 1
    yield _APPLIANCE, labels, {"findings": counts, "audit": appliance.audit}
    for transport, logins in appliance.logins.items():
        yield _LOGINS, (*labels, "transport", transport), {"counts": logins}
    processes = dict(appliance.processes)
    segments = processes.pop("segments", {})
    processes |= {f"segment {name}": process for name, process in segments.items()}
    for name, process in processes.items():
        yield _PROCESS, (*labels, "process", name), process
        if (bridge := process.get("bridge")) is not None:
            yield _BRIDGE, (*labels, "bridge", name), bridge
    for listener in appliance.listeners:
        yield _LISTENER, (*labels, "listener", listener["name"]), listener


def _pd_rows(station: Row, labels: _Labels) -> Iterator[_LabelledRow]:
    for frame in station.get("frames", ()):
        yield _FRAME, (*labels, "port", frame["port"], "frame", frame["name"]), frame
    for families, direction in ((_SENT_PD, "tx"), (_RECEIVED_PD, "rx")):
        for pd in station["pd"][direction]:
            yield families, (*labels, "port", pd["port"], "pd", pd["name"]), pd


def _slave_rows(station: Row, labels: _Labels) -> Iterator[_LabelledRow]:
    for port in station["ports"]:
        for slave in (port.get("bus") or {}).get("slaves", ()):
            names = ("slave", slave["name"], "address", str(slave["address"]))
            yield _SLAVE, (*labels, "port", port["name"], *names), slave


def _label_text(labels: _Labels) -> str:
    pairs = zip(labels[::2], labels[1::2], strict=True)
    return ",".join(f'{name}="{_escape(value)}"' for name, value in pairs)


def _escape(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _number(value: float) -> str:
    # int() for truth values; 12 digits leave out the noise of the scales.
    return str(int(value)) if isinstance(value, int) else f"{value:.12g}"
