from __future__ import annotations

import pytest
from msgspec.structs import replace

from devicebus.mailbox.conversation import MailboxRequest
from devicebus.master.findings import History
from devicebus.wire.alstatus import AlState
from eap.codec.mailbox import MailboxType
from eap.engine.bus_report import report_bus
from eap.runtime.bus_status import find_lock_faults, history_of, report_findings
from eap.runtime.engine_messages import LockState, SlaveReport
from tests.support import enginebus
from tests.support.cyclic import MS
from tests.support.enginebus import US, BusRig


def test_bus_report_before_start_has_expected_slaves(tmp_path):
    rig = BusRig(tmp_path)
    rig.wire.is_deaf = True
    rig.start()
    rig.run(2000 * MS)
    report = report_bus(rig.bus, rig.now_ns)
    assert not report.is_up
    assert "no frame came back" in report.fault
    assert [(each.station, each.name, each.state) for each in report.slaves] == [
        (1001, "coupler", 0),
        (1002, "io", 0),
        (1003, "level", 0),
    ]
    assert report.frames_lost > 0
    assert report.cycles == 0


def test_a_bus_that_runs(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    rig.run(100 * MS)
    report = report_bus(rig.bus, rig.now_ns)
    assert (report.is_up, report.fault) == (True, "")
    # Of two slaves with process data one counts 3, as it reads and writes; so does the other.
    assert (report.expected_wkc, report.received_wkc) == (6, 6)
    assert report.cycles >= report.cycles_good >= 100
    assert 0 < report.trip_ns <= report.max_trip_ns
    assert report.frames_sent > report.cycles
    assert report.slaves[1] == SlaveReport(
        station=1002,
        name="io",
        vendor=0xE5A,
        product=2,
        revision=0x0001_0000,
        serial=0,
        alias=0,
        state=AlState.OP,
        target=AlState.OP,
        to_slave=256,
        to_master=256,
        protocols=4,
        order="io",
        usual_to_slave=256,
        usual_to_master=256,
        port_physics=0x11,
        link_preset=0x11,
    )
    assert [each.link_preset for each in report.slaves] == [0x11, 0x11, 0]
    assert report.slaves[2].to_slave == report.slaves[2].protocols == 0


def test_bus_report_of_lost_slave_has_reason(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    rig.fault(kind="power", slave="level")
    rig.run(100 * MS)
    lost = report_bus(rig.bus, rig.now_ns).slaves[2]
    assert (lost.state, lost.target, lost.fault) == (0, AlState.OP, "it does not answer")


def shown_states(rig, place, duration_ns):
    """Run the bus; return what image and report say of a slave's state, without repeats."""
    name = rig.bus.spec.slaves[place].name
    ways = (
        lambda: rig.value(f"{name}.state"),
        lambda: report_bus(rig.bus, rig.now_ns).slaves[place].state,
    )
    shown = [[], []]
    end_ns = rig.now_ns + duration_ns
    while rig.now_ns < end_ns:
        rig.step(end_ns)
        for way, states in zip(ways, shown, strict=True):
            if states[-1:] != [way()]:
                states.append(way())
    return shown


@pytest.fixture
def slow_trip(monkeypatch):
    """Frames take most of a cycle, so that each step of a slave's way back can be seen."""
    monkeypatch.setattr(enginebus, "TRIP_NS", 900 * US)


def test_report_slave_back_from_power_fault_has_no_state_until_it_was_read(tmp_path, slow_trip):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    rig.fault(kind="power", slave="io", for_ms=200)
    image, report = shown_states(rig, 1, 1_000 * MS)
    assert image == [8, 0, 1, 2, 4, 8]
    assert report == [8, 0, 1, 2, 4, 8]


def test_report_slave_that_left_op_by_itself_shows_the_state_that_was_read(tmp_path):
    rig = BusRig(tmp_path, cycle_us=4000).start()
    rig.wait_op()
    rig.fault(kind="refuse", slave="io", state="OP", code=0x52)
    rig.fault(kind="al-error", slave="io", code=0x52)
    image, report = shown_states(rig, 1, 500 * MS)
    assert image == [8, 4]
    assert report == [8, 4]


def test_report_other_product_in_place_of_a_slave_has_no_state(tmp_path):
    rig = BusRig(tmp_path, cycle_us=4000).start()
    rig.wait_op()
    io = rig.wire.segment.segment.slaves[1]
    io.esc.image = io.esc.image[:20] + b"\x63" + io.esc.image[21:]
    rig.fault(kind="power", slave="io", for_ms=200)
    image, report = shown_states(rig, 1, 2_500 * MS)
    assert image == [8, 0]
    assert report == [8, 0]
    assert "in place of io" in report_bus(rig.bus, rig.now_ns).slaves[1].fault


def findings(rig):
    """Text of `status` on the bus, and the past findings of `bus diag`."""
    report = report_bus(rig.bus, rig.now_ns)
    return [each.what for each in report_findings(report)], history_of(report)


def test_report_cut_cable_is_one_finding_and_over_once_it_is_mended(tmp_path):
    rig = BusRig(tmp_path, cycle_us=4000).start()
    rig.wait_op()
    rig.run(1_500 * MS)
    rig.fault(kind="cut", slave="io", for_ms=3_000)
    rig.run(2_500 * MS)
    ((only,), _) = findings(rig)
    assert only == (
        "io (1002) and 1 slave behind it do not answer; the last that answers before it is"
        " coupler (1001)"
    )
    rig.wait_op()
    rig.run(5_000 * MS)
    present, history = findings(rig)
    assert present == []
    assert [slave.name for slave, _ in history.over] == ["io", "level"]
    for _, times in history.over:
        assert 7_000 * MS < times.since_ns < 9_000 * MS
        assert 4_000 * MS < times.until_ns < 6_000 * MS
    assert history.ports[1001, 1].until_ns > 6_000 * MS
    rig.bus.forget_past()
    assert findings(rig) == ([], History())


def test_report_silent_bus_blames_no_slave_and_has_no_states(tmp_path):
    rig = BusRig(tmp_path, cycle_us=4000).start()
    rig.wait_op()
    rig.fault(kind="loss", for_ms=2_000)
    rig.run(1_500 * MS)
    present, _ = findings(rig)
    assert present == ["no frame comes back: 3 slaves cannot be reached"]
    assert [each.state for each in report_bus(rig.bus, rig.now_ns).slaves] == [0, 0, 0]
    rig.wait_op()
    rig.run(1_000 * MS)
    present, history = findings(rig)
    assert present == []
    assert history.silence is not None
    assert 900 * MS < history.silence.until_ns < 2_000 * MS


def test_report_counts_mailbox_requests_without_reply_until_they_are_reset(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    rig.fault(kind="mailbox", slave="io")

    def read():
        yield MailboxRequest(MailboxType.COE, bytes(10), timeout_ns=50 * MS)

    task = rig.bus.master.converse(1002, read(), rig.now_ns)
    rig.bus.keep(task, rig.now_ns)
    rig.run(200 * MS)
    assert task.is_done
    slave = report_bus(rig.bus, rig.now_ns).slaves[1]
    assert slave.mailbox_timeouts == 1
    assert slave.mailbox_timeout_ns > 100 * MS
    present, history = findings(rig)
    assert present == ["io (1002): 1 mailbox request without reply in time, last 0 s ago"]
    assert len(history.mailboxes) == 1
    rig.bus.forget_past()
    assert findings(rig) == ([], History())


def test_emergencies_are_reported_with_their_age_until_they_are_forgotten(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    device = rig.wire.segment.segment.slaves[1].device
    device.report_error(0x8611)
    rig.run(100 * MS)
    io = report_bus(rig.bus, rig.now_ns).slaves[1]
    (found,) = io.latest_emergencies
    assert io.emergencies == 1
    assert (found.protocol, found.code, found.register) == ("CoE", 0x8611, 1)
    assert 0 < found.ago_ns <= 100 * MS
    (finding,) = report_findings(report_bus(rig.bus, rig.now_ns))
    assert finding.what.startswith("io (1002) reports emergency 0x8611 by CoE: monitoring")
    device.report_error(0)
    rig.run(100 * MS)
    assert report_findings(report_bus(rig.bus, rig.now_ns)) == []
    assert report_bus(rig.bus, rig.now_ns).slaves[1].emergencies == 2
    rig.bus.forget_past()
    assert report_bus(rig.bus, rig.now_ns).slaves[1].emergencies == 0


def test_lock_is_reported_where_the_cycle_follows_the_clocks(tmp_path):
    rig = BusRig(tmp_path)
    assert report_bus(rig.bus, rig.now_ns).lock is None
    lock = LockState(
        reference=1001, is_locked=True, offset_ns=5, drift_ppb=7, lead_ns=300_000, late=2, early=1,
        fault_ns=3_000_000_000,
    )  # fmt: skip
    (finding,) = find_lock_faults(lock)
    assert finding.what == (
        "frames miss their time before SYNC0: 2 too late, 1 too early (more than 150 µs), last 3 s"
        " ago"
    )
    assert list(find_lock_faults(replace(lock, fault_ns=None))) == []
    assert list(find_lock_faults(replace(lock, fault_ns=11_000_000_000))) == []
    (finding,) = find_lock_faults(replace(lock, reference=None))
    assert "runs free" in finding.what
