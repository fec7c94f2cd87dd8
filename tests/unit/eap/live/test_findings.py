from __future__ import annotations

from dataclasses import asdict
from datetime import datetime
from typing import Any

import msgspec
import pytest

from eap.live.findings import PUBLISHER_HINT, VERSION_HINT, Severity, StatusFinding, findings
from eap.live.status import SilentAppliance
from tests.support.statusdocument import NOW_S, bus_port, document, frame, merged, rx, tx


def found(status: dict[str, Any]) -> list[tuple[str, str]]:
    return [(each.severity.value, each.text(NOW_S)) for each in findings(merged(status), NOW_S)]


def texts(**parts: Any) -> list[str]:
    return [f"{severity} {text}" for severity, text in found(document(**parts))]


def clock(at_s: float) -> str:
    return datetime.fromtimestamp(at_s).astimezone().strftime("%H:%M:%S")


def test_findings_of_a_plant_without_faults_are_none() -> None:
    assert found(document(tx=[tx("state")], rx=[rx("left")])) == []


def test_findings_are_sorted_errors_first_and_name_the_plant() -> None:
    status = document(state="SAFEOP", overruns=2, ports=[bus_port()])
    listed = findings(merged(status), NOW_S)
    assert [each.severity for each in listed] == [
        Severity.ERROR, Severity.WARNING, Severity.INFO, Severity.INFO,
    ]  # fmt: skip
    assert {each.plant for each in listed} == {"line"}


@pytest.mark.parametrize(
    ("state", "effect"),
    [("PREOP", "exchanges"), ("SAFEOP", "receives")],
)
def test_station_in_a_requested_state_is_a_warning(state: str, effect: str) -> None:
    assert texts(state=state, rx=[rx("left", state="stale")]) == [
        (
            f"warning mixer: in {state}, as requested: the station {effect} no process data;"
            " 'eapctl state mixer OP' returns it to OP"
        )
    ]


def test_process_that_does_not_run_is_an_error() -> None:
    status = document()
    status["processes"]["services"]["pid"] = None
    status["processes"]["segments"] = {"mixer/bus0": {"pid": None}}
    assert found(status) == [
        ("error", "line services: not running; it is being restarted"),
        ("error", "line segment mixer/bus0: not running; it is being restarted"),
    ]


def test_process_that_starts_is_a_warning_with_its_step() -> None:
    status = document()
    status["processes"]["engine"]["step"] = "building station mixer"
    assert found(status) == [("warning", "line engine: starting: building station mixer")]


@pytest.mark.parametrize(("age_s", "severity"), [(2, "warning"), (120, "info")])
def test_second_sender_with_a_publisher_id_is_a_warning_for_a_minute(
    age_s: int, severity: str
) -> None:
    other = {"address": "10.0.0.9", "age_us": age_s * 1_000_000}
    rows = [rx("a", wrong_source=other), rx("b", source="10.0.0.1", other_source=other)]
    first, second = texts(rx=rows)
    assert first.startswith(f"{severity} mixer ← a: 10.0.0.9 sends with this publisher ID: dropped")
    assert second.startswith(
        f"{severity} mixer ← b: two senders with this publisher ID: 10.0.0.1 and 10.0.0.9; last "
    )


def test_second_sender_of_many_pds_is_one_finding() -> None:
    other = {"address": "10.0.0.9", "age_us": 2_000_000}
    rows = [rx(f"pd{n}", wrong_source=other | {"age_us": n * 1_000_000}) for n in range(1, 6)]
    (only,) = texts(rx=rows)
    assert only.startswith("warning mixer ← pd1 and 4 others: 10.0.0.9 sends with")
    assert "last 1.0 s ago" in only


def test_finding_names_its_beginning_behind_the_fault() -> None:
    fault = StatusFinding(
        Severity.ERROR, "a/bus0", "b does not answer; c is the last", "d", NOW_S - 2
    )
    since = f"since {clock(NOW_S - 2)} (2.0 s)"
    assert fault.text(NOW_S) == f"a/bus0: b does not answer, {since}; c is the last; d"


def test_engine_without_realtime_is_one_warning() -> None:
    status = document()
    status["processes"]["engine"]["realtime"] = {
        "scheduler": "other: needs CAP_SYS_NICE",
        "cpus": [0, 1],
        "memory_locked": "needs CAP_IPC_LOCK",
        "pm_qos": True,
    }
    assert found(status) == [
        (
            "warning",
            (
                "line engine: no realtime: scheduler (needs CAP_SYS_NICE), memory locked (needs"
                " CAP_IPC_LOCK); cycles may be late: run as root, or use --no-realtime"
            ),
        )
    ]


@pytest.mark.parametrize("scheduler", ["fifo 50", "other: not requested"])
def test_engine_that_got_all_it_requested_has_no_finding(scheduler: str) -> None:
    status = document()
    status["processes"]["engine"]["realtime"] = {"scheduler": scheduler, "pm_qos": True}
    assert found(status) == []


def test_requests_to_buses_that_were_lost_are_a_remark() -> None:
    status = document()
    status["processes"]["engine"]["bus_requests"] = {"malformed": 0, "dropped": 3}
    assert found(status) == [("info", "line engine: requests to buses: 3 dropped")]


@pytest.mark.parametrize(
    ("required", "effect"), [(False, "changes are not recorded"), (True, "changes are refused")]
)
def test_audit_that_cannot_be_written_is_an_error(required: bool, effect: str) -> None:
    status = document()
    status["appliances"][0]["audit"] = {
        "file": "/state/audit.jsonl", "required": required, "lines": 7, "since": NOW_S - 5,
        "until": NOW_S, "error": "No space left on device",
    }  # fmt: skip
    text = (
        "line audit: cannot be written: No space left on device, since"
        f" {clock(NOW_S - 5)} (5.0 s); {effect}; 7 lines lost; free space for"
        " /state/audit.jsonl, or"
        " make its folder writable"
    )
    assert found(status) == [("error", text)]


def test_audit_that_is_written_again_is_a_warning_when_lines_are_lost() -> None:
    status = document()
    audit = {"file": "/a", "required": False, "lines": 1, "since": NOW_S - 5, "until": NOW_S}
    status["appliances"][0]["audit"] = audit | {"error": ""}
    assert found(status) == [
        ("warning", f"line audit: 1 line lost, since {clock(NOW_S - 5)} (5.0 s); written again")
    ]
    status["appliances"][0]["audit"] = audit | {"lines": 0, "since": None, "error": ""}
    assert found(status) == []


def test_findings_of_the_services_are_taken_over() -> None:
    status = document()
    alarm = StatusFinding(
        Severity.ERROR, "line audit", "changes not recorded: disk full", "free space"
    )
    status["appliances"][0]["findings"] = [asdict(alarm)]
    (only,) = findings(merged(status), NOW_S)
    assert only == StatusFinding(**{**asdict(alarm), "severity": Severity.ERROR, "plant": "line"})


@pytest.mark.parametrize(("cycle_us", "hangs"), [(10_000, True), (1_000_000, False)])
def test_station_without_cycles_is_an_error_since_its_last_one(cycle_us: int, hangs: bool) -> None:
    since = f"{clock(NOW_S - 3.1)} (3.1 s)"
    expected = (
        f"error line engine: runs no cycles of mixer, since {since}; see the log of 'eapctl run'"
    )
    assert texts(cycle_us=cycle_us, cycle_age_us=3_100_000) == [expected] * hangs


def test_stale_pd_is_an_error_since_the_last_good_one() -> None:
    last = NOW_S - 90
    assert texts(rx=[rx("left", state="stale", last_good=last), rx("right")]) == [
        (
            f"error mixer ← left: stale: nothing received within the timeout, since {clock(last)}"
            " (90.0 s); check its sender and the network path"
        )
    ]


def test_time_of_another_day_has_its_date() -> None:
    text = StatusFinding(Severity.ERROR, "a", "b", since=NOW_S - 3 * 86400).text(NOW_S)
    day = datetime.fromtimestamp(NOW_S - 3 * 86400).astimezone().strftime("%Y-%m-%d")
    assert text.startswith(f"a: b, since {day} ")
    assert text.endswith("(72 h)")


def test_many_stale_pds_are_one_finding() -> None:
    rows = [rx(f"pd{n}", state="stale", last_good=NOW_S - n) for n in range(5)]
    (only,) = texts(rx=[*rows, rx("good")])
    assert only.startswith("error mixer ← pd0 and others (5 of 6 received PDs): stale")
    assert f"since {clock(NOW_S - 4)}" in only


def test_cyclic_pd_that_never_came_is_a_warning_and_any_other_a_remark() -> None:
    waiting = {"state": "waiting", "received": 0}
    assert [
        each.partition(";")[0]
        for each in texts(rx=[rx("a", **waiting), rx("b", lost=None, **waiting)])
    ] == ["warning mixer ← a: nothing received yet", "info mixer ← b: nothing received yet"]


@pytest.mark.parametrize(
    ("var_state", "wrong", "hint"),
    [(1, "version", f"; {VERSION_HINT}"), (2, "length", ", and the packing of their structs")],
)
def test_pd_of_another_layout_is_an_error(var_state: int, wrong: str, hint: str) -> None:
    assert texts(rx=[rx("left", var_state=var_state)]) == [
        (
            f"error mixer ← left: dropped: unexpected {wrong};"
            f" compare the plant files of both stations{hint}"
        )
    ]


def test_frame_states_of_sent_pds_are_errors() -> None:
    rows = [tx("a", frame_state=3), tx("b", frame_state=4), tx("c", frame_state=1, skipped=2)]
    first, second, third = texts(tx=rows)
    assert first.startswith(
        "error mixer → a: not sent: its frame exceeds the maximum size of its network"
    )
    assert second.startswith("error mixer → b: its subscriber does not answer")
    assert third == "info mixer → c: skipped 2 times"


def test_frame_that_waits_for_an_address_is_a_warning() -> None:
    rows = [frame("new", destination="5.3.3.3.2.1", address=None), frame("known")]
    assert texts(frames=rows) == [
        "warning mixer → new: MAC address of 5.3.3.3.2.1 unknown: waiting for a frame from it"
    ]


def test_port_without_link_is_an_error() -> None:
    port = {"name": "eap0", "kind": "eap", "interface": "ethernet://eth0", "link": "down"}
    assert texts(ports=[port]) == [
        "error mixer/eap0: link down; check cable and interface of ethernet://eth0"
    ]
    assert texts(ports=[port | {"kind": "bus"}]) == [
        "error mixer/eap0: no frame comes back; check cable and interface of the bus"
    ]


def test_port_whose_interface_is_gone_is_named() -> None:
    port = {"name": "eap0", "kind": "eap", "interface": "ethernet://eth0", "link": "down"}
    (found,) = texts(ports=[port | {"fault": "interface eth0 is gone: it was deleted"}])
    fault = "interface eth0 is gone: it was deleted; it is found again when it comes back"
    assert found == f"error mixer/eap0: {fault}"


def test_engine_that_runs_no_station_is_one_finding() -> None:
    silent_bus = {"name": "bus0", "kind": "bus", "interface": "sim://x", "link": "down"}
    status = document(cycle_age_us=3_000_000, ports=[silent_bus])
    (mixer,) = status["stations"]
    status["stations"] = [mixer | {"name": name} for name in ("a", "b", "c")]
    status["appliances"][0]["stations"] = ["a", "b", "c"]
    ((_, text),) = found(status)
    assert text.startswith("line engine: runs no cycles of any station, since")


def test_buses_and_their_slaves() -> None:
    down = bus_port("bus1", is_up=False, fault="no frame comes back\nso far", findings=[], lost=0)
    starting = bus_port("bus2", is_up=False, findings=[], lost=0)
    assert texts(ports=[bus_port(wkc_errors=4), down, starting]) == [
        "error mixer/bus0: press (1002) is lost; 'eapctl bus diag mixer/bus0' shows details",
        "error mixer/bus1: no frame comes back; so far; 'eapctl bus diag mixer/bus1' shows details",
        "warning mixer/bus2: starting up",
        "info mixer/bus0: 4 cycles with a wrong working counter",
        "info mixer/bus0: 3 exchanges lost: no frame came back",
    ]


def test_findings_tell_late_exchanges_from_lost_ones() -> None:
    (*_, late, skipped) = texts(ports=[bus_port(lost=0, findings=[], late=2, skipped=1)])
    assert late == "info mixer/bus0: 2 exchanges late: the bus or this host was busy"
    assert skipped == "info mixer/bus0: 1 exchange skipped: others were pending"


def test_bus_that_is_down_is_one_finding() -> None:
    slaves = [{"address": 1001, "name": "a", "state": None, "fault": "has not been found yet"}]
    fault = "the bus is not as configured:\n  a is missing"
    assert texts(
        ports=[bus_port(slaves=slaves, findings=[], is_up=False, fault=fault, lost=0)]
    ) == [
        (
            "error mixer/bus0: the bus is not as configured: a is missing;"
            " 'eapctl bus diag mixer/bus0' shows details"
        )
    ]


def test_past_events_are_remarks() -> None:
    left = rx(
        "left", timeouts=1, duplicated=2, reordered=3, late=4, discarded={"version": 5, "length": 6}
    )
    alarm = tx("alarm", reason={"change": 1, "change_timeout": 8})
    assert texts(
        tx=[alarm], rx=[left], discarded={"unknown_id": 8}, overruns=1, torn=2, links_held=3
    ) == [
        "warning mixer: 3 linked values held back: not a number",
        "info mixer: 1 cycle skipped: overrun",
        "info mixer: 2 torn writes read",
        "info mixer: dropped: 8 unknown id",
        "info mixer → alarm: sent on change once, resend 8 times",
        (
            "info mixer ← left: timed out once; 2 duplicated; 3 reordered; 4 late;"
            " dropped: 5 version, 6 length"
        ),
    ]


def test_frames_with_a_wrong_length_are_told_from_dropped_ones() -> None:
    left = rx("left", discarded={"wrong_length": 3, "version": 1})
    assert texts(rx=[left], discarded={"wrong_length": 3, "truncated": 2}) == [
        "info mixer: dropped: 2 truncated",
        "info mixer: taken in spite of a wrong frame length: 3",
        "info mixer ← left: dropped: 1 version; taken in spite of a wrong frame length: 3",
    ]


def test_silent_pd_beside_truncated_frames_may_have_a_wrong_length() -> None:
    silent = rx("left", state="waiting")
    advice = "check its sender and the network path; frames were dropped as truncated"
    assert texts(rx=[silent], discarded={"truncated": 2})[0] == (
        f"warning mixer ← left: nothing received yet; {advice}: 'eapctl discover' shows a wrong"
        " length"
    )


def test_hints_on_publisher_and_version_are_shown_once() -> None:
    rows = [
        rx("a", state="waiting", discarded={"wrong_publisher": 3}),
        rx("b", state="stale", discarded={"wrong_publisher": 3}),
        rx("c", var_state=1),
        rx("d", var_state=1),
        rx("e", state="waiting"),
    ]
    shown = [text for text in texts(rx=rows) if not text.startswith("info")]
    advice = "'eapctl discover' shows its NetID"
    assert shown == [
        (
            "error mixer ← b: stale: nothing received within the timeout; another publisher sends"
            f" its PD ID; {advice}; {PUBLISHER_HINT}"
        ),
        (
            "error mixer ← c: dropped: unexpected version; compare the plant files of both"
            f" stations; {VERSION_HINT}"
        ),
        "error mixer ← d: dropped: unexpected version; compare the plant files of both stations",
        "warning mixer ← e: nothing received yet; check its sender and the network path",
        (f"warning mixer ← a: nothing received yet; another publisher sends its PD ID; {advice}"),
    ]
    for hint in (PUBLISHER_HINT, VERSION_HINT):
        assert "TwinCAT 2" in hint


LISTENER = {
    "name": "ams-tcp 10.0.0.1:48898", "open": 128, "limit": 128, "refused": 5, "evicted": 12,
    "overdue": 3, "crowded_ago_us": 1_000_000,
}  # fmt: skip


def test_listener_that_is_crowded_now_is_a_warning_and_a_remark_later() -> None:
    status = document()
    status["appliances"][0]["listeners"] = [LISTENER]
    counts = "5 refused, 12 closed in favour of others, 3 closed as too slow"
    where = "line ams-tcp 10.0.0.1:48898"
    advice = "'ss -tn sport = :48898' shows the hosts"
    text = f"{where}: 128 of 128 connections in use; connections: {counts}; {advice}"
    assert found(status) == [("warning", text)]
    status["appliances"][0]["listeners"] = [LISTENER | {"crowded_ago_us": 61_000_000}]
    assert found(status) == [("info", f"{where}: connections: {counts}")]
    none = dict.fromkeys(("refused", "evicted", "overdue"), 0)
    status["appliances"][0]["listeners"] = [LISTENER | none]
    assert found(status) == []


def test_process_near_its_limit_of_descriptors_is_a_warning() -> None:
    status = document()
    status["processes"]["services"]["descriptors"] = {"used": 55, "limit": 60}
    advice = "raise the hard limit (ulimit -Hn, or LimitNOFILE= of systemd)"
    text = f"line services: 55 of 60 file descriptors are in use; {advice}"
    assert found(status) == [("warning", text)]
    status["processes"]["services"]["descriptors"] = {"used": 54, "limit": 60}
    assert found(status) == []


def test_findings_name_an_appliance_that_does_not_answer() -> None:
    status = msgspec.structs.replace(
        merged(document()), silent=[SilentAppliance("line", ["far", "near"], 77)]
    )
    first, *_ = findings(status, NOW_S)
    assert (first.severity, first.plant) == (Severity.ERROR, "line")
    assert first.text(NOW_S) == (
        "line (far, near): services does not answer; look at process 77, or restart the appliance"
    )


def test_finding_of_a_hung_engine_names_the_stations_of_its_appliance() -> None:
    status = document(cycle_age_us=5_000_000)
    status["silent"] = [{"plant": "line", "stations": ["far"], "services": 77}]
    wheres = [each.where for each in findings(merged(status), NOW_S)]
    assert wheres[:2] == ["line (far)", "line (mixer) engine"]


def test_finding_with_its_last_time_is_a_warning_and_a_remark_when_it_is_over() -> None:
    row = {"what": "drive (1001): 1 late", "advice": "do", "since": None, "until": NOW_S - 20}
    warned = bus_port(lost=0, findings=[row | {"is_over": False}])
    assert texts(ports=[warned])[0] == "warning mixer/bus0: drive (1001): 1 late; do"
    past = bus_port(lost=0, findings=[row | {"is_over": True}])
    assert texts(ports=[past])[0] == (
        "info mixer/bus0: drive (1001): 1 late; 'eapctl bus diag mixer/bus0 --reset' clears this"
    )
