from __future__ import annotations

from devicebus.wire.alstatus import AlState
from eap.appliance.bus_request import SlaveReport
from eap.appliance.engine.bus_report import report_bus
from tests.support.cyclic import MS
from tests.support.enginebus import BusRig


def test_before_it_is_up_the_expected_slaves_are_told(tmp_path):
    rig = BusRig(tmp_path)
    rig.wire.is_deaf = True
    rig.start()
    rig.run(200 * MS)
    report = report_bus(rig.bus)
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
    report = report_bus(rig.bus)
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


def test_a_slave_that_is_gone_says_why(tmp_path):
    rig = BusRig(tmp_path).start()
    rig.wait_op()
    rig.fault(kind="power", slave="level")
    rig.run(100 * MS)
    lost = report_bus(rig.bus).slaves[2]
    assert (lost.state, lost.target, lost.fault) == (0, AlState.OP, "it does not answer")
