"""One bus of an engine: from its start to OP, and whatever comes between."""

from __future__ import annotations

import msgspec
import pytest

from devicebus.master.master import Master
from devicebus.master.procedure import read
from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from eap.compiled import cyclic
from eap.engine.bus_report import report_bus
from eap.engine.engine_bus import RETRY_NS, SILENT_RETRY_NS
from eap.pd.spec import BusTarget
from eap.runtime.bus_status import is_silent
from tests.support.cyclic import MS
from tests.support.enginebus import BUS, TRIP_NS, BusRig
from tests.support.terminals import write_bus


@pytest.fixture
def rig(tmp_path):
    made = BusRig(tmp_path).start()
    made.wait_op()
    return made


def entry(rig, position, index=0x7000, subindex=1):
    """Return an output as the slave has it."""
    return rig.wire.segment.segment.slaves[position].device.dictionary.entry(index, subindex).value


def test_slaves_get_to_op_and_their_inputs_into_the_image(tmp_path):
    rig = BusRig(tmp_path).start()
    assert (rig.bus.is_up, rig.bus.fault) == (False, "it is being brought up")
    assert rig.wait_op() < 50 * MS
    rig.run(2 * MS)
    assert (rig.bus.is_up, rig.bus.fault) == (True, "")
    assert rig.value("level.height") == -7
    assert rig.value("io.state") == rig.value("coupler.state") == AlState.OP
    assert rig.value("wkc_ok") is True


def test_outputs_reach_slaves_and_come_back_as_inputs(rig):
    rig.set("bus0.io.lamp", True)
    rig.set("bus0.level.limit", -300)
    rig.run(4 * MS)
    assert (entry(rig, 1, subindex=1), entry(rig, 1, subindex=2)) == (False, True)
    assert entry(rig, 2) == -300
    assert rig.value("io.echo") is True


def test_first_outputs_are_those_of_the_application(tmp_path):
    rig = BusRig(tmp_path)
    rig.set("bus0.level.limit", 1234)
    rig.start()
    seen = set()
    slave = rig.wire.segment.segment.slaves[2]
    while rig.value("state") != AlState.OP:
        rig.step(rig.now_ns + MS)
        if slave.state is AlState.OP:
            seen.add(entry(rig, 2))
    assert seen == {1234}


def test_inputs_hold_while_an_engine_takes_over(rig, tmp_path):
    heir = BusRig(tmp_path, rig.station)
    heir.wire = rig.wire
    heir.bus._port = rig.wire
    heir.now_ns = heir._next_ns = rig.now_ns
    heir.image.memory[:] = rig.image.memory
    heir.start()
    shown = set()
    while heir.value("state") != AlState.OP or not heir.bus.is_up:
        heir.step(heir.now_ns + MS)
        shown.add(heir.value("level.height"))
    assert shown == {-7}


@pytest.mark.parametrize("target", [BusTarget.INIT, BusTarget.PREOP, BusTarget.SAFEOP])
def test_slaves_stay_where_the_plant_wants_them(tmp_path, target):
    rig = BusRig(tmp_path, target=target).start()
    rig.wait(lambda: rig.bus.is_up)
    rig.run(300 * MS)
    assert rig.value("state") == AlState[target]
    assert rig.value("wkc_ok") is (target is BusTarget.SAFEOP)


def test_engine_bus_reports_unexpected_bus_and_retries(tmp_path):
    rig = BusRig(tmp_path)
    expected = msgspec.structs.replace(rig.bus._settings.expected[1], product=99)
    settings = msgspec.structs.replace(
        rig.bus._settings, expected=[rig.bus._settings.expected[0], expected, expected]
    )
    rig.bus.master, good = Master(settings), rig.bus.master
    rig.start()
    rig.run(100 * MS)
    assert not rig.bus.is_up
    assert "product 0x00000002" in rig.bus.fault
    assert "expected io with vendor 0x00000E5A, product 0x00000063" in rig.bus.fault
    assert [each.name for each in rig.bus.refused] == ["coupler", "io", "level"]
    report = report_bus(rig.bus, rig.now_ns)
    assert [each.vendor for each in report.refused] == [0xE5A] * 3
    assert [each.name for each in report.slaves] == ["coupler", "io", "level"]
    rig.bus.master = good
    assert rig.wait_op() < RETRY_NS + 100 * MS
    rig.run(2 * MS)
    assert rig.bus.fault == ""
    assert rig.bus.refused == report_bus(rig.bus, rig.now_ns).refused == ()


def test_wire_that_is_cut_at_the_start(tmp_path):
    rig = BusRig(tmp_path)
    rig.wire.is_deaf = True
    rig.start()
    rig.run(1000 * MS)
    assert "no frame came back" in rig.bus.fault
    assert rig.value("state") == 0
    rig.wire.is_deaf = False
    assert rig.wait_op() < 3 * SILENT_RETRY_NS
    assert rig.bus.is_up


def test_slave_that_goes_and_comes_back(rig):
    rig.fault(kind="power", slave="level", for_ms=300)
    assert rig.wait(lambda: rig.value("level.state") == 0) < 50 * MS
    assert (rig.value("state"), rig.value("io.state"), rig.value("wkc_ok")) == (0, 8, False)
    assert rig.bus.faults.of(1003) == "it does not answer"
    assert rig.wait_op() < 500 * MS
    rig.run(2 * MS)
    assert (rig.bus.faults.of(1003), rig.value("wkc_ok")) == ("", True)


def test_interface_that_is_switched_off_and_on(rig):
    rig.wire.is_down = True
    rig.run(500 * MS)
    assert "Network is down" in rig.bus.fault
    assert (rig.value("state"), rig.value("wkc_ok")) == (0, False)
    rig.wire.is_down = False
    rig.wait_op()
    assert rig.bus.fault == ""


def test_engine_bus_reports_missing_entry_and_runs_the_rest(tmp_path):
    rig = BusRig(tmp_path)
    changed = BUS.replace(
        "{name: height, type: INT", '{name: height, object: "0x6001:0", type: INT'
    )
    (tmp_path / "bus.yaml").write_text(changed)
    other = BusRig(tmp_path, rig.station).start()
    other.wait_op()
    other.run(MS)
    assert other.bus.is_up
    assert "level (station 1003) has no input 0x6000:01 of 16 bits" in other.bus.fault
    other.set("bus0.io.lamp", True)
    other.run(4 * MS)
    assert other.value("io.echo") is True
    assert other.value("level.height") == 0


def test_slave_that_refuses_does_not_keep_the_others_from_running(tmp_path):
    rig = BusRig(tmp_path)
    rig.fault(kind="refuse", slave="level", state="OP", code=0x1A)
    rig.start()
    rig.run(200 * MS)
    assert (rig.value("io.state"), rig.value("level.state")) == (AlState.OP, AlState.SAFEOP)
    assert (rig.bus.is_up, rig.bus.fault) == (True, "")
    assert "refuses OP" in rig.bus.faults.of(1003)
    rig.end(kind="refuse", slave="level", state="OP", code=0x1A)
    rig.wait_op()
    assert rig.bus.faults.of(1003) == ""


def test_master_that_breaks_is_replaced(rig, monkeypatch):
    broken = rig.bus.master
    task = broken.scan(rig.now_ns)
    rig.bus.keep(task, rig.now_ns)

    def fail(*arguments):
        raise ZeroDivisionError("what nobody thought of")

    monkeypatch.setattr(broken, "receive_frame", fail)
    rig.run(20 * MS)
    assert rig.bus.master is not broken
    assert "ZeroDivisionError: what nobody thought of" in rig.bus.fault
    assert "ZeroDivisionError" in str(task.error)
    assert rig.wait(lambda: rig.bus.is_up) <= RETRY_NS + 100 * MS
    assert rig.bus.fault == ""


def test_bus_that_was_silent_is_not_silent_with_a_new_master(rig, monkeypatch):
    rig.wire.is_deaf = True
    rig.wait(lambda: rig.bus.master.is_lost)
    rig.run(2 * MS)
    assert is_silent(report_bus(rig.bus, rig.now_ns))
    broken = rig.bus.master
    monkeypatch.setattr(broken, "handle_timeout", lambda now_ns: 1 // 0)
    rig.run(2 * MS)
    assert rig.bus.master is not broken
    rig.wire.is_deaf = False
    rig.wait(lambda: rig.bus.is_up)
    assert not is_silent(report_bus(rig.bus, rig.now_ns))


def test_shut_down_leaves_slaves_at_rest(rig):
    rig.set("bus0.level.limit", 5)
    rig.run(3 * MS)
    task = rig.bus.shut_down(rig.now_ns)
    rig.wait(lambda: task.is_done)
    assert task.error is None
    rig.run(100 * MS)
    states = {slave.state for slave in rig.wire.segment.segment.slaves}
    assert states == {AlState.INIT}


def test_without_anything_urgent_the_cycle_is_soon_enough(rig):
    rig.run(5 * MS)
    assert rig.bus.next_timeout() is None
    before = rig.wire.sent
    rig.run(100 * MS)
    assert 100 <= rig.wire.sent - before < 130


def test_slow_cycles_do_not_slow_down_the_watch(tmp_path):
    rig = BusRig(tmp_path, cycle_us=500_000).start()
    rig.wait_op()
    rig.run(1000 * MS)
    assert rig.bus.next_timeout() is not None


def test_engine_start_drops_waiting_frames(tmp_path):
    rig = BusRig(tmp_path)
    for _ in range(200):
        rig.wire.send(bytes.fromhex("0d10 0707 0000 3001 0180 0000 0000 00"))
    rig.wire.now_ns += MS
    rig.wire.settle()
    rig.now_ns += MS
    rig.start()
    assert rig.bus.master.stats().link.unexpected == 0
    rig.wait_op()


def test_unexpected_frames_are_received_on_arrival_only(rig):
    rig.wait(lambda: not rig.bus.master.is_waiting)
    rig.wire.send(bytes.fromhex("0d10 0707 0000 3001 0180 0000 0000 00"))
    rig.wire.settle()
    rig.wire.now_ns += 100_000
    unexpected = rig.bus.master.stats().link.unexpected
    rig.bus.receive(rig.now_ns)
    assert rig.bus.master.stats().link.unexpected == unexpected
    rig.bus.drain(rig.now_ns)
    assert rig.bus.master.stats().link.unexpected == unexpected + 1


def test_engine_bus_terminals_of_one_bit_pdos_share_a_byte_in_the_image(tmp_path):
    rig = BusRig(tmp_path, bus=write_bus(tmp_path).read_text())
    rig.start()
    rig.wait_op()
    places = {place.name: place.bit_offset for place in rig.image.layout.variables}
    bits = [places[f"bus0.di8.Channel_{channel}.Signal"] for channel in range(1, 9)]
    assert bits == list(range(bits[0], bits[0] + 8))
    assert not bits[0] % 8
    assert places["bus0.di4.Channel_1.Signal"] == bits[0] + 8
    rig.set("bus0.do8.Channel_6.Signal", True)
    rig.run(5 * MS)
    assert rig.wire.segment.segment.slaves[2].device.process_data.outputs.pack() == b"\x20"


def test_replies_of_quiet_cycles_wait_for_the_next_cycle(rig):
    rig.run(50 * MS)
    before, changes = rig.bus.master.cycle.stats(), rig.changes
    rig.run(300 * MS)
    after = rig.bus.master.cycle.stats()
    assert after.good - before.good == after.cycles - before.cycles > 290
    # The round trip ends when the frame arrives, not when it is taken.
    assert after.trip_ns == after.max_trip_ns == TRIP_NS
    if cyclic is None:
        assert rig.is_listening
    else:
        assert 0 < rig.changes - changes < 60


def test_replies_are_taken_at_once_while_frames_are_recorded(rig):
    rig.run(55 * MS)
    rig.wire.tap = lambda frame, is_sent: None
    rig.run(2 * MS)
    changes = rig.changes
    rig.run(50 * MS)
    assert rig.is_listening
    assert rig.changes == changes
    rig.wire.tap = None
    rig.run(2 * MS)
    assert rig.is_listening is (cyclic is None)


def test_requests_are_not_kept_waiting_by_quiet_cycles(rig):
    rig.run(55 * MS)
    begun_ns = rig.now_ns
    task = rig.bus.master.run(read(1001, Register.TYPE, 1), begun_ns)
    rig.bus.keep(task, begun_ns)
    assert rig.is_listening
    rig.wait(lambda: task.is_done)
    assert rig.now_ns - begun_ns == TRIP_NS
