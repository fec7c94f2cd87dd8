"""Rows of a live view, from two reports."""

from __future__ import annotations

from typing import Any

from eap.live.rows import NO_CYCLES, StationRow, bus_rows, pd_flows, station_rows
from tests.support.statusdocument import bus_port, document, rx, tx, with_findings


def at(cycle: int, **station: Any) -> Any:
    """Return a report of one station with 10 ms cycles."""
    return with_findings(document(cycle=cycle, overruns=0, **station))


def only(rows: list[Any]) -> Any:
    (row,) = rows
    return row


def test_station_row_has_rates_by_the_cycles_of_the_station() -> None:
    before = at(1000, tx=[tx("out", sent=500)], rx=[rx("in", received=100)])
    now = at(1100, tx=[tx("out", sent=600)], rx=[rx("in", received=125)])
    row: StationRow = only(station_rows(now, before))
    assert (row.plant, row.name, row.state) == ("line", "mixer", "OP")
    assert (row.tx_per_s, row.rx_per_s) == (100.0, 25.0)
    assert (row.age_us, row.jitter_p99_us, row.bus) == (4200, 111, "")


def test_station_row_without_an_earlier_report_has_no_rates() -> None:
    row = only(station_rows(at(1000, rx=[rx("in")])))
    assert (row.tx_per_s, row.rx_per_s) == (None, None)


def test_station_row_of_restarted_counters_has_no_rate() -> None:
    before, now = at(1000, rx=[rx("in", received=9)]), at(10, rx=[rx("in", received=2)])
    assert only(station_rows(now, before)).rx_per_s is None


def test_station_row_without_cycles_has_rate_zero_and_says_so() -> None:
    before = at(1000, rx=[rx("in", received=9)])
    now = at(1000, rx=[rx("in", received=9)], cycle_age_us=2_500_000)
    row = only(station_rows(now, before))
    assert (row.state, row.rx_per_s) == (NO_CYCLES, 0.0)


def test_station_row_counts_since_an_earlier_report() -> None:
    first = at(1000, rx=[rx("a", lost=5, late=1), rx("b", lost=None, late=2)])
    now = at(1100, rx=[rx("a", lost=7, late=1), rx("b", lost=None, late=6)])
    assert (only(station_rows(now)).lost, only(station_rows(now)).late) == (7, 7)
    row = only(station_rows(now, None, first))
    assert (row.lost, row.late) == (2, 4)


def test_station_row_shows_buses_in_short() -> None:
    assert only(station_rows(at(1, ports=[bus_port()]))).bus == "1/2 OP"
    assert only(station_rows(at(1, ports=[bus_port(is_up=False)]))).bus == "down"
    cut = bus_port(ring={"is_whole": False})
    assert only(station_rows(at(1, ports=[cut]))).bus == "1/2 OP cut"


def test_pd_flows_show_both_directions() -> None:
    before = at(1000, tx=[tx("out", sent=500)], rx=[rx("in", received=100, lost=1)])
    now = at(1100, tx=[tx("out", sent=600)], rx=[rx("in", received=150, lost=4)])
    sent, received = pd_flows(now, before, before)
    assert (sent.direction, sent.name, sent.per_s, sent.total) == ("tx", "out", 100.0, 600)
    assert (sent.lost, sent.age_us) == (None, None)
    assert (received.direction, received.per_s, received.lost) == ("rx", 50.0, 3)
    assert (received.state, received.jitter_p99_us) == ("running", 111)


def test_pd_flow_of_unknown_step_has_no_losses() -> None:
    now = at(1100, rx=[rx("in", lost=None)])
    assert only(pd_flows(now)).lost is None


def test_bus_rows_show_the_bus_and_then_its_slaves() -> None:
    first, now = at(1, ports=[bus_port(lost=1)]), at(2, ports=[bus_port(lost=5)])
    bus, drive, press = bus_rows(now, first)
    assert (bus.port, bus.name, bus.state, bus.lost, bus.wkc) == ("bus0", "", "up", 4, 0)
    assert (drive.name, drive.address, drive.state, drive.fault) == ("drive", 1001, "OP", "")
    assert (press.name, press.state, press.target, press.fault) == (
        "press", "lost", "OP", "is lost"
    )  # fmt: skip


def test_bus_that_the_engine_does_not_report_is_unknown() -> None:
    port = bus_port()
    del port["bus"]
    assert only(bus_rows(at(1, ports=[port]))).state == "unknown"


def test_station_row_has_the_age_of_pds_that_come_in_a_fixed_step() -> None:
    received = [rx("a", age_us=10), rx("b", age_us=30), rx("alarm", age_us=9000, lost=None)]
    assert only(station_rows(at(1, rx=received))).age_us == 30
    assert only(station_rows(at(1, rx=received[2:]))).age_us == 9000
