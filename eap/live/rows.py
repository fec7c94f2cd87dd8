"""Rows of a live view: stations and PDs with rates, from two status reports.

Counts are those since the start of the plant, or since an earlier report (``since``).  A rate is
None until there are two reports, and after counters restarted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, Literal, TypeAlias

import msgspec

from eap.live.findings import REASONS, StatusReport, is_hung

Row: TypeAlias = Mapping[str, Any]
StationKey: TypeAlias = tuple[str, str]
"""Plant and name of a station."""

NO_CYCLES = "no cycles"
"""State of a station whose engine runs no cycles."""


class StationRow(msgspec.Struct, frozen=True, kw_only=True):
    """One station.

    Attributes:
        plant: Its plant.
        name: Its name.
        state: Its state; ``no cycles`` while no engine runs it.
        tx_per_s: PDs that it sends a second.
        rx_per_s: PDs that it receives a second.
        lost: PDs that were lost, where the sender's step is known.
        late: PDs that came late.
        age_us: Age of its oldest received PD, of those that are sent in a fixed step if there are
            any; None before the first.
        jitter_p99_us: The highest 99th percentile of the jitter of its received PDs.
        bus: Slaves in OP of all slaves, such as ``2/2 OP``; a bus that is down; empty without one.
    """

    plant: str
    name: str
    state: str
    tx_per_s: float | None
    rx_per_s: float | None
    lost: int
    late: int
    age_us: int | None
    jitter_p99_us: int | None
    bus: str


class PdFlow(msgspec.Struct, frozen=True, kw_only=True):
    """One PD that a station sends or receives.

    Attributes:
        plant: Plant of the station.
        station: The station.
        direction: ``tx`` or ``rx``.
        name: Name of the PD.
        port: Its port.
        state: ``running``, ``stale`` or ``waiting`` of a received PD; the reason of the last frame
            of a sent one, empty before the first.
        per_s: Number of it a second.
        total: Number of it since the start.
        lost: Lost ones; None of a sent PD, or where the sender's step is not known.
        late: Late ones; None of a sent PD.
        age_us: Age of the last received one.
        jitter_p99_us: The 99th percentile of its jitter; of a polled PD of its response time.
        quality: Age of its data, in units of 100 us.
        dropped: Received and not accepted.
    """

    plant: str
    station: str
    direction: Literal["tx", "rx"]
    name: str
    port: str
    state: str
    per_s: float | None
    total: int
    lost: int | None
    late: int | None
    age_us: int | None
    jitter_p99_us: int | None
    quality: int | None
    dropped: int


class BusRow(msgspec.Struct, frozen=True, kw_only=True):
    """One bus, or one of its slaves.

    Attributes:
        plant: Plant of the station.
        station: The station.
        port: Port of the bus.
        name: Name of the slave; empty for the bus as a whole.
        address: Station address of the slave; None for the bus.
        state: State of the slave, ``lost`` without an answer; of the bus ``up`` or ``down``.
        target: State in which the master keeps the slave.
        lost: Lost exchanges of process data of the bus; None of a slave.
        wkc: Exchanges with a wrong working counter; None of a slave.
        fault: Present fault in words, or empty.
    """

    plant: str
    station: str
    port: str
    name: str
    address: int | None
    state: str
    target: str
    lost: int | None
    wkc: int | None
    fault: str


def bus_rows(now: StatusReport, since: StatusReport | None = None) -> list[BusRow]:
    """Return a row for each bus, each followed by those of its slaves."""
    first = stations_of(since)
    return [
        row
        for station in now.stations
        for port in station["ports"]
        if port["kind"] == "bus"
        for row in _bus_rows(station, port, _bus_of(first.get(key_of(station)), port["name"]))
    ]


def station_rows(
    now: StatusReport, before: StatusReport | None = None, since: StatusReport | None = None
) -> list[StationRow]:
    """Return a row for each station, in the order of the plants.

    Args:
        now: The report to show.
        before: The one before, for rates.
        since: Lost and late ones are counted from this report on; None for the whole time.
    """
    earlier, first = stations_of(before), stations_of(since)
    return [
        _station_row(station, earlier.get(key_of(station)), first.get(key_of(station)))
        for station in now.stations
    ]


def pd_flows(
    now: StatusReport, before: StatusReport | None = None, since: StatusReport | None = None
) -> list[PdFlow]:
    """Return a row for each PD; the arguments are those of :func:`station_rows`."""
    earlier, first = stations_of(before), stations_of(since)
    return [
        flow
        for station in now.stations
        for flow in _flows(station, earlier.get(key_of(station)), first.get(key_of(station)))
    ]


def stations_of(report: StatusReport | None) -> dict[StationKey, Row]:
    """Return the stations of a report by plant and name."""
    return {} if report is None else {key_of(station): station for station in report.stations}


def key_of(station: Row) -> StationKey:
    """Return the key of a station of a report."""
    return station["plant"], station["name"]


def station_s(station: Row) -> float:
    """Return the time of a station's counters: its cycles since the first, also those left out.

    Rates follow from it rather than from the time between two reports: the counters are older than
    a report by an unknown time, while the number of cycles belongs to the same moment as they do.
    A replay has no cycles, but a position in its recording.
    """
    if replayed := station.get("replayed"):
        recorded_s: float = replayed["rounds"] * replayed["seconds"] + replayed["position_s"]
        return recorded_s / float(replayed["rate"])
    cycles: int = station.get("cycle", 0) + station.get("overruns", 0)
    cycle_us: int = station.get("cycle_us", 0)
    return cycles * cycle_us / 1e6


def rate(now: int, before: int, station: Row, earlier: Row) -> float | None:
    """Return the rate of a counter of a station, None if it restarted; 0 while no cycle runs."""
    seconds = station_s(station) - station_s(earlier)
    if now < before or seconds < 0:
        return None
    return round((now - before) / seconds, 1) if seconds else 0.0


def count_total(station: Row, direction: str, key: str) -> int:
    """Return a counter of all PDs of a station; unknown ones count as 0."""
    return sum(row[key] or 0 for row in station["pd"][direction])


def count_dropped(row: Row) -> int:
    """Return the number of dropped frames of a PD or a station."""
    return sum(row["discarded"].values())


def bus_text(station: Row) -> str:
    """Return the buses of a station in short."""
    texts = []
    for port in station["ports"]:
        if (bus := port.get("bus")) is not None:
            texts.append(_bus_text(bus))
        elif port["kind"] == "bus":
            texts.append("?")
    return ", ".join(texts)


def _bus_text(bus: Row) -> str:
    if not bus["is_up"]:
        return "down"
    slaves = [each for each in bus["slaves"] if not each.get("is_absent")]
    states = Counter(each["state"] or "lost" for each in slaves)
    in_op = states.pop("OP", 0)
    if (ring := bus.get("ring")) is not None and ring["is_whole"] is False:
        return f"{in_op}/{len(slaves)} OP cut"
    return f"{in_op}/{len(slaves)} OP"


def _bus_of(station: Row | None, name: str) -> Row:
    """Return the bus of a port, empty if there is none."""
    ports = () if station is None else station["ports"]
    found: Row = next((each["bus"] for each in ports if each["name"] == name and "bus" in each), {})
    return found


def _bus_rows(station: Row, port: Row, first: Row) -> Iterator[BusRow]:
    own = {"plant": station["plant"], "station": station["name"], "port": port["name"]}
    bus = port.get("bus")
    if bus is None:
        yield BusRow(
            **own, name="", address=None, state="unknown", target="", lost=None, wkc=None,
            fault="the engine does not report it",
        )  # fmt: skip
        return
    yield BusRow(
        **own,
        name="",
        address=None,
        state="up" if bus["is_up"] else "down",
        target="",
        lost=max(bus["lost"] - first.get("lost", 0), 0),
        wkc=max(bus["wkc_errors"] - first.get("wkc_errors", 0), 0),
        fault=bus["fault"] or "; ".join(each["what"] for each in bus["findings"]),
    )
    for slave in bus["slaves"]:
        is_absent = slave.get("is_absent")
        yield BusRow(
            **own,
            name=slave["name"],
            address=slave["address"],
            state="absent" if is_absent else slave["state"] or "lost",
            target=slave.get("target") or "",
            lost=None,
            wkc=None,
            fault=slave["fault"],
        )


def _station_row(station: Row, earlier: Row | None, first: Row | None) -> StationRow:
    def per_s(direction: str, key: str) -> float | None:
        if earlier is None:
            return None
        now, before = (count_total(each, direction, key) for each in (station, earlier))
        return rate(now, before, station, earlier)

    def counted(key: str) -> int:
        total = count_total(station, "rx", key)
        return total if first is None else max(total - count_total(first, "rx", key), 0)

    received = station["pd"]["rx"]
    # Of PDs on change and the like only an age says nothing: no news is as configured.
    timed = [row for row in received if row["lost"] is not None] or received
    ages = [row["age_us"] for row in timed if row["age_us"] is not None]
    jitters = [row["jitter_us"]["p99"] for row in received if row["jitter_us"]["p99"] is not None]
    return StationRow(
        plant=station["plant"],
        name=station["name"],
        state=NO_CYCLES if is_hung(station) else station["state"],
        tx_per_s=per_s("tx", "sent"),
        rx_per_s=per_s("rx", "received"),
        lost=counted("lost"),
        late=counted("late"),
        age_us=max(ages, default=None),
        jitter_p99_us=max(jitters, default=None),
        bus=bus_text(station),
    )


def _flows(station: Row, earlier: Row | None, first: Row | None) -> Iterator[PdFlow]:
    for direction in ("tx", "rx"):
        before, since = _by_name(earlier, direction), _by_name(first, direction)
        for row in station["pd"][direction]:
            name = row["name"]
            total = row["sent" if direction == "tx" else "received"]
            per_s = None
            if earlier is not None and name in before:
                old = before[name]["sent" if direction == "tx" else "received"]
                per_s = rate(total, old, station, earlier)
            common = {
                "plant": station["plant"],
                "station": station["name"],
                "name": name,
                "port": row["port"],
                "per_s": per_s,
                "total": total,
            }
            if direction == "tx":
                yield _sent(row, common)
            else:
                yield _received(row, since.get(name), common)


def _sent(row: Row, common: dict[str, Any]) -> PdFlow:
    reason: str = row.get("last_reason") or ""
    return PdFlow(
        direction="tx",
        state=REASONS.get(reason, reason),
        lost=None,
        late=None,
        age_us=None,
        jitter_p99_us=None,
        quality=None,
        dropped=0,
        **common,
    )


def _received(row: Row, first: Row | None, common: dict[str, Any]) -> PdFlow:
    def counted(key: str) -> int | None:
        number: int | None = row[key]
        if number is None or first is None:
            return number
        return max(number - (first[key] or 0), 0)

    times = row.get("response_us") or row["jitter_us"]
    return PdFlow(
        direction="rx",
        state=row["state"],
        lost=counted("lost"),
        late=counted("late"),
        age_us=row["age_us"],
        jitter_p99_us=times["p99"],
        quality=row["quality"],
        dropped=count_dropped(row),
        **common,
    )


def _by_name(station: Row | None, direction: str) -> dict[str, Row]:
    return {} if station is None else {row["name"]: row for row in station["pd"][direction]}
