"""Events in words, from successive reports."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from eap.live.events import QUIET_NS, EventLog
from tests.support.statusdocument import NOW_S, bus_port, document, rx, tx, with_findings

SECOND = 1_000_000_000


class Reports:
    """A log that gets a report a second."""

    def __init__(self) -> None:
        self.log = EventLog()
        self.now_ns = 0

    def take(self, status: dict[str, Any], unreachable: Mapping[str, str] = {}) -> list[str]:
        self.now_ns += SECOND
        report = with_findings(status)
        found = self.log.take(report, self.now_ns, NOW_S + self.now_ns / 1e9, unreachable)
        return [f"{each.severity} {each.where}: {each.what}" for each in found]

    def wait(self, ns: int) -> None:
        self.now_ns += ns


@pytest.fixture
def reports() -> Reports:
    return Reports()


def engine(restarts: int, pid: int | None = 101) -> dict[str, Any]:
    status = document()
    process = status["processes"]["engine"]
    process.update(restarts=restarts, pid=pid)
    return status


def test_first_report_without_faults_has_no_events(reports: Reports) -> None:
    assert reports.take(document(rx=[rx("in", lost=7, late=2)])) == []


def test_restarted_engine_is_one_event(reports: Reports) -> None:
    reports.take(engine(0))
    text = "error line engine: ended and was restarted (once since the start)"
    assert reports.take(engine(1, pid=555)) == [text]
    assert reports.take(engine(1, pid=555)) == []


def test_restart_behind_a_gap_of_answers_is_an_event(reports: Reports) -> None:
    reports.take(engine(0))
    nothing = document() | {"stations": [], "appliances": []}
    reports.take(nothing, {"line": "does not answer"})
    found = reports.take(engine(1, pid=555))
    assert found[0] == "error line engine: ended and was restarted (once since the start)"


def test_fault_is_an_event_when_it_begins_and_when_it_is_over(reports: Reports) -> None:
    reports.take(document())
    down = document(
        ports=[{"name": "eap0", "kind": "eap", "interface": "ethernet://e", "link": "down"}]
    )
    assert reports.take(down) == ["error mixer/eap0: link down"]
    assert reports.take(down) == []
    assert reports.take(document()) == ["info mixer/eap0: over after 2.0 s: link down"]


def test_fault_is_not_over_because_its_appliance_does_not_answer(reports: Reports) -> None:
    port = {"name": "eap0", "kind": "eap", "interface": "ethernet://e", "link": "down"}
    down = document(ports=[port])
    reports.take(down)
    nothing = document() | {"stations": [], "appliances": []}
    assert reports.take(nothing, {"line": "gone"}) == ["error line: gone"]
    assert reports.take(down) == ["info line: answers again after 1.0 s"]


def test_fault_with_a_growing_number_is_one_fault(reports: Reports) -> None:
    reports.take(document())
    assert reports.take(document(links_held=1)) == [
        "warning mixer: 1 linked value held back: not a number"
    ]
    assert reports.take(document(links_held=1)) == []
    assert reports.take(document(links_held=17)) != []  # "values": another text
    assert reports.take(document(links_held=29)) == []


def test_losses_are_one_event_until_they_stop(reports: Reports) -> None:
    reports.take(document(rx=[rx("left"), rx("right")]))
    lossy = document(rx=[rx("left", lost=3), rx("right")])
    assert reports.take(lossy) == ["warning mixer: 3 lost: left"]
    assert reports.take(document(rx=[rx("left", lost=5), rx("right", lost=1)])) == []
    reports.wait(QUIET_NS)
    after = reports.take(document(rx=[rx("left", lost=5), rx("right", lost=1)]))
    assert after == ["info mixer: 6 lost in 1.0 s, none since"]


def test_single_burst_of_late_pds_ends_without_another_event(reports: Reports) -> None:
    reports.take(document(rx=[rx("in")]))
    assert reports.take(document(rx=[rx("in", late=1)])) == ["warning mixer: 1 late: in"]
    reports.wait(QUIET_NS)
    assert reports.take(document(rx=[rx("in", late=1)])) == []


def test_many_lossy_pds_are_counted_and_not_all_named(reports: Reports) -> None:
    names = [f"pd{number}" for number in range(20)]
    reports.take(document(rx=[rx(name) for name in names]))
    found = reports.take(document(rx=[rx(name, lost=1) for name in names]))
    assert found == ["warning mixer: 20 lost: pd0 and 19 other PDs"]


def test_state_of_a_station_is_an_event_and_no_finding_beside_it(reports: Reports) -> None:
    reports.take(document())
    assert reports.take(document(state="PREOP")) == ["warning mixer: state OP → PREOP"]
    assert reports.take(document()) == ["info mixer: state PREOP → OP"]


def test_slave_that_leaves_op_is_an_event(reports: Reports) -> None:
    drive = {"address": 1001, "name": "drive", "state": "OP", "target": "OP", "fault": ""}
    before = bus_port(slaves=[drive], findings=[])
    after = bus_port(slaves=[drive | {"state": "SAFEOP"}], findings=[])
    reports.take(document(ports=[before]))
    assert reports.take(document(ports=[after])) == ["warning mixer/bus0: drive: OP → SAFEOP"]
    assert reports.take(document(ports=[before])) == ["info mixer/bus0: drive: SAFEOP → OP"]


def test_lost_exchanges_of_a_bus_are_an_event(reports: Reports) -> None:
    reports.take(document(ports=[bus_port(findings=[])]))
    found = reports.take(document(ports=[bus_port(findings=[], lost=9)]))
    assert found == ["warning mixer/bus0: 6 exchanges of process data lost"]


def test_appliance_that_does_not_answer_is_an_event_until_it_does(reports: Reports) -> None:
    reports.take(document())
    silent = document() | {"stations": [], "appliances": []}
    assert reports.take(silent, {"line": "has ended"}) == ["error line: has ended"]
    assert reports.take(silent, {"line": "has ended"}) == []
    assert reports.take(document()) == ["info line: answers again after 2.0 s"]


def test_station_that_appears_later_begins_without_events(reports: Reports) -> None:
    reports.take(document() | {"stations": []})
    assert reports.take(document(tx=[tx("out")], rx=[rx("in", lost=9)])) == []


def test_log_keeps_the_latest_events() -> None:
    log = EventLog(most=2)
    for number in range(4):
        log.take(with_findings(engine(number)), number * SECOND, NOW_S)
    assert ["(2 times" in log.events[0].what, "(3 times" in log.events[1].what] == [True, True]
