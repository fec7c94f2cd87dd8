"""Bus ports in ``status``."""

from __future__ import annotations

import msgspec
import pytest

from eap.runtime.bus_status import bus_document, bus_link
from eap.runtime.engine_messages import BusReport, SlaveReport


def slave(state, station=1001, **more):
    row = {"vendor": 1, "product": 2, "revision": 3, "serial": 4, "alias": 0, "target": 8}
    return SlaveReport(station=station, name=f"s{station}", state=state, **row, **more)


LOST = slave(0, 1002, fault="it does not answer", since_ns=2_000_000_000)
UP = BusReport(is_up=True, slaves=(slave(8), LOST), cycles=7)


@pytest.mark.parametrize(
    ("report", "link"),
    [
        (None, "down"),
        (UP, "up"),
        (BusReport(is_up=True), "up"),
        (BusReport(is_up=True, slaves=(slave(0),)), "down"),
        (BusReport(is_up=False, slaves=(slave(8),)), "down"),
    ],
)
def test_bus_link_says_whether_slaves_answer(report, link):
    assert bus_link(report) == link


def test_bus_document_has_the_counters():
    report = msgspec.structs.replace(
        UP, wkc_errors=1, cycles_lost=2, cycles_late=3, cycles_skipped=4, trip_ns=1999,
        frames_sent=90, frames_received=80, frames_late=5, frames_lost=6, frames_retried=7,
        timeout_ns=2_000_999, round_trip_ns=300_999,
    )  # fmt: skip
    bus = bus_document(report, 100.0)["bus"]
    assert (bus["is_up"], bus["fault"], bus["cycles"], bus["wkc_errors"]) == (True, "", 7, 1)
    assert (bus["lost"], bus["late"], bus["skipped"], bus["trip_us"]) == (2, 3, 4, 1)
    assert msgspec.to_builtins(bus["frames"]) == {
        "sent": 90,
        "received": 80,
        "late": 5,
        "lost": 6,
        "retried": 7,
        "timeout_us": 2000,
        "round_trip_us": 300,
    }
    assert [each["state"] for each in bus["slaves"]] == ["OP", None]
    assert bus["slaves"][1]["fault"] == "it does not answer"
    assert bus_document(None, 100.0) == {}


def test_bus_document_has_one_finding_for_all_behind_the_first_that_is_silent():
    slaves = [slave(8)] + [slave(0, at, fault="it does not answer") for at in range(1002, 1101)]
    report = BusReport(is_up=True, slaves=tuple(slaves))
    (finding,) = bus_document(report, 100.0)["bus"]["findings"]
    assert finding.what == (
        "s1002 (1002) and 98 slaves behind it do not answer; the last that answers before it is"
        " s1001 (1001)"
    )
    assert finding.advice == "check the cable to s1002 (1002) and its power"
    assert len(finding.slaves) == 99
    assert (finding.is_over, finding.since) == (False, None)


def test_bus_document_blames_no_slave_while_no_frame_comes_back():
    silent = msgspec.structs.replace(UP, silent_since_ns=3_000_000_000)
    (finding,) = bus_document(silent, 100.0)["bus"]["findings"]
    assert finding.what == "no frame comes back: 2 slaves cannot be reached"
    assert finding.since == 97.0
    (finding,) = bus_document(msgspec.structs.replace(silent, silent_until_ns=1), 100.0)["bus"][
        "findings"
    ]
    assert finding.what.startswith("s1002 (1002) does not answer")
    assert finding.since == 98.0


def test_bus_document_absent_slave_behind_a_silent_one_is_not_said_to_answer():
    absent = slave(0, 1003, is_absent=True)
    report = msgspec.structs.replace(UP, slaves=(slave(8), LOST, absent))
    (finding,) = bus_document(report, 100.0)["bus"]["findings"]
    assert "behind answers" not in finding.what
