"""Optional slaves: absent at start, plugged in, unplugged, and plugged in again."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from devicebus.errors import BusError, MailboxClosedError
from devicebus.master.bus import MasterSettings, SlaveFailed
from devicebus.master.cycle import Participation
from devicebus.master.esm import read_identification
from devicebus.master.master import Master, why_closed
from devicebus.master.pdo import Pdo, PdoEntry, ProcessDataChannel
from devicebus.master.scan import assign_stations
from devicebus.sim.spec import ChannelSpec, ClockSpec
from devicebus.wire.alstatus import AlState
from eap.od.slave_config import ID_REGISTER, OpMode, SdoWrite
from tests.support.busline import MS, Bench, Line, Paced, expect, run, segment, slave

PLANNED = (
    ProcessDataChannel(2, 0, 0, True, (Pdo(0, (PdoEntry(0x7000, 1, 1), PdoEntry(0, 0, 7))),)),
    ProcessDataChannel(3, 0, 0, False, (Pdo(0, (PdoEntry(0x6000, 1, 1), PdoEntry(0, 0, 7))),)),
)
ECHO = (ChannelSpec(name="in", follows="out"),)


def box(name, **options):
    return slave(name, **({"inputs": ECHO} | options))


def wanted(spec, *, channels=PLANNED, **config):

    return replace(expect(spec, **config), channels=channels)


def tree(**config):
    """A coupler with two branches: an optional tool at port 2, and the line at port 1."""
    specs = (
        box("coupler", product=1),
        box("tool", product=2, after="coupler", port=2),
        box("end", product=3, after="coupler"),
    )
    expected = [
        wanted(specs[0]),
        # The frame comes to port 1 before port 2.
        wanted(specs[2]),
        wanted(specs[1], **({"optional": True} | config)),
    ]
    line = Paced(Master(MasterSettings(expected=expected)), segment(*specs))
    line.tool = line.segment.slaves[1]
    return line


def bring(line):
    line.wait(line.core.bring_up(line.now_ns))


def kinds(events):
    return [(type(each).__name__, each.station) for each in events]


def exchange(line, station):
    """Return whether output and input of a slave agree, both ways."""
    image = line.core.image
    (output,) = (e.name for e in image.layout.variables if e.station == station and e.is_output)
    (entry,) = (e.name for e in image.layout.variables if e.station == station and not e.is_output)
    seen = []
    for value in (True, False, True):
        image.write(station, output, value)
        line.elapse(5 * MS)
        seen.append(image.read(station, entry))
    image.write(station, output, False)
    return seen == [True, False, True]


def test_absent_slave_is_no_error_and_has_its_place_in_the_image():
    line = tree()
    line.segment.cut(1)
    bring(line)
    assert list(line.core.slaves) == [1001, 1002, 1003]
    absent = line.core.slaves[1003]
    assert (absent.is_absent, absent.al_state, absent.name) == (True, 0, "tool")
    assert line.core.cycle.is_full
    assert exchange(line, 1002)
    line.elapse(1000 * MS)
    assert line.events() == []
    assert line.core.image.layout.slaves[1003].inputs_size == 1
    with pytest.raises(BusError, match=r"slave 1003 .tool. is absent: plug it in"):
        line.core.request_state(1003, AlState.OP, line.now_ns)
    assert isinstance(why_closed(absent), MailboxClosedError)


def test_slave_that_is_plugged_in_is_configured_and_exchanges_data():
    line = tree(writes=(SdoWrite(index=0x7000, subindex=1, data=b"\1"),))
    line.segment.cut(1)
    bring(line)
    line.elapse(300 * MS)
    bad = line.core.stats().cycle.wkc_errors
    line.segment.mend(1)
    line.elapse_until(lambda: line.tool.state is AlState.OP)
    assert line.tool.state is AlState.OP
    assert kinds(line.events()) == [("SlaveBack", 1003)]
    tool = line.core.slaves[1003]
    assert (tool.is_absent, tool.found.position, tool.found.name) == (False, 2, "tool")
    assert tool.found.node.parent == 0
    assert all(exchange(line, station) for station in line.core.slaves)
    assert line.core.cycle.is_full
    # The others have not missed a cycle.
    assert line.core.stats().cycle.wkc_errors == bad


def test_unplugged_slave_is_absent_and_returns():
    line = tree()
    bring(line)
    for _ in range(3):
        line.segment.cut(1)
        line.elapse(300 * MS)
        assert kinds(line.events()) == [("SlaveAbsent", 1003)]
        assert line.core.cycle.is_full
        assert line.core.cycle.participation(1003) is Participation.AWAY
        assert exchange(line, 1002)
        line.segment.mend(1)
        line.elapse_until(lambda: line.tool.state is AlState.OP)
        assert line.tool.state is AlState.OP
        assert kinds(line.events()) == [("SlaveBack", 1003)]
        assert exchange(line, 1003)
        assert line.core.cycle.is_full


def test_slave_that_returns_without_power_loss_keeps_the_others_valid():
    line = tree()
    bring(line)
    line.segment.cut(1)
    line.elapse(20 * MS)
    line.segment.mend(1)
    bad = line.core.stats().cycle.wkc_errors
    line.elapse(1500 * MS)
    assert line.core.stats().cycle.wkc_errors == bad
    assert line.tool.state is AlState.OP


def test_power_loss_of_an_optional_slave_is_the_same():
    line = tree()
    bring(line)
    line.segment.switch(1, on=False)
    line.elapse(300 * MS)
    line.segment.switch(1, on=True)
    line.elapse_until(lambda: line.tool.state is AlState.OP)
    assert line.tool.state is AlState.OP
    assert kinds(line.events()) == [("SlaveAbsent", 1003), ("SlaveBack", 1003)]


def test_other_slave_in_its_place_is_named_and_not_taken_in():
    line = tree()
    line.tool.esc.image = (
        line.tool.esc.image[:20] + (9).to_bytes(4, "little") + line.tool.esc.image[24:]
    )
    line.segment.cut(1)
    bring(line)
    line.segment.mend(1)
    line.elapse(500 * MS)
    (text,) = line.core.strangers
    assert text.startswith("position 2: vendor 0x00000E5A, product 0x00000009")
    assert line.tool.state is AlState.INIT
    assert line.core.cycle.is_full
    line.segment.cut(1)
    line.elapse(300 * MS)
    assert line.core.strangers == ()


def test_another_unit_of_the_same_kind_may_be_plugged_in():
    line = tree()
    bring(line)
    line.segment.cut(1)
    line.elapse(300 * MS)
    image = line.tool.esc.image
    line.tool.esc.image = image[:28] + (77).to_bytes(4, "little") + image[32:]
    line.segment.switch(1, on=False)
    line.segment.switch(1, on=True)
    line.segment.mend(1)
    line.elapse_until(lambda: line.tool.state is AlState.OP)
    assert line.tool.state is AlState.OP
    assert line.core.slaves[1003].found.identity.serial == 77


def test_process_data_that_is_not_as_described_is_named():
    line = tree()
    other = (ProcessDataChannel(2, 0, 0, True, (Pdo(0, (PdoEntry(0x7055, 1, 8),)),)),)
    line = tree()
    settings = line.core._bus.settings

    expected = [*settings.expected[:2], replace(settings.expected[2], channels=other)]
    line = Paced(Master(replace(settings, expected=expected)), line.segment)
    line.segment.cut(1)
    bring(line)
    line.segment.mend(1)
    line.elapse(500 * MS)
    failed = [each for each in line.events() if isinstance(each, SlaveFailed)]
    assert "slave 1003: it has 1 bytes of outputs and 1 of inputs, but 1 and 0 are planned" in (
        failed[0].reason
    )
    assert line.core.cycle.is_full


def test_entries_that_are_not_as_described_are_named():
    line = tree()

    settings = line.core._bus.settings
    other = (
        ProcessDataChannel(2, 0, 0, True, (Pdo(0, (PdoEntry(0x7055, 1, 8),)),)),
        PLANNED[1],
    )
    expected = [*settings.expected[:2], replace(settings.expected[2], channels=other)]
    line = Paced(Master(replace(settings, expected=expected)), line.segment)
    line.segment.cut(1)
    bring(line)
    line.segment.mend(1)
    line.elapse(500 * MS)
    failed = [each for each in line.events() if isinstance(each, SlaveFailed)]
    assert "it has output 0x7000:01 of 1 bits at bit 16" in failed[0].reason


def test_group_at_another_place_keeps_its_names():
    specs = (
        box("coupler", product=1),
        box("first", product=2, alias=5),
        box("second", product=3),
        box("end", product=4),
    )
    group = {"group": "tool", "identification": ID_REGISTER}
    expected = [
        wanted(specs[0]),
        wanted(specs[3]),
        wanted(specs[1], **group),
        wanted(specs[2], group="tool"),
    ]
    line = Paced(Master(MasterSettings(expected=expected)), segment(*specs))
    bring(line)
    assert {at: each.name for at, each in line.core.slaves.items()} == {
        1001: "coupler", 1003: "first", 1004: "second", 1002: "end",
    }  # fmt: skip
    assert all(exchange(line, station) for station in line.core.slaves)
    assert {each.state for each in line.segment.slaves} == {AlState.OP}


def test_group_that_is_plugged_in_is_told_by_its_identification():
    specs = (
        box("coupler", product=1),
        box("one", product=2, alias=5, after="coupler", port=2),
        box("two", product=2, alias=6, after="coupler", port=3),
    )
    by_id = {"identification": ID_REGISTER}
    expected = [
        wanted(specs[0]),
        wanted(specs[1], group="one", **by_id),
        wanted(specs[2], group="two", **by_id),
    ]
    line = Paced(Master(MasterSettings(expected=expected)), segment(*specs))
    line.segment.cut(1)
    line.segment.cut(2)
    bring(line)
    line.segment.mend(2)
    line.elapse_until(lambda: line.segment.slaves[2].state is AlState.OP)
    assert line.segment.slaves[2].state is AlState.OP
    assert [each.is_absent for each in line.core.slaves.values()] == [False, True, False]
    assert line.core.slaves[1003].found.alias == 6
    line.segment.mend(1)
    line.elapse_until(lambda: line.segment.slaves[1].state is AlState.OP)
    assert line.segment.slaves[1].state is AlState.OP
    assert all(exchange(line, station) for station in line.core.slaves)
    # In the order of the segment: port 3 comes before port 2.
    assert list(line.core.slaves) == [1001, 1003, 1002]


def test_group_with_a_missing_member_says_so():
    specs = (box("a", product=1), box("b", product=2), box("c", product=3))
    expected = [wanted(specs[0]), wanted(specs[1], group="g"), wanted(specs[2], group="g")]
    line = Paced(Master(MasterSettings(expected=expected)), segment(*specs[:2]))
    bring(line)
    lacks = [line.core.lacks_group(each) for each in line.core.slaves.values()]
    assert lacks == [False, False, True]


def test_clocks_and_sync0_of_a_slave_that_is_plugged_in():
    specs = (
        box("a", product=1, clock=ClockSpec(drift_ppm=20)),
        box("b", product=2, clock=ClockSpec(drift_ppm=-30, needs_sync0=True)),
    )
    expected = [wanted(specs[0]), wanted(specs[1], optional=True, sync=OpMode())]
    line = Paced(Master(MasterSettings(expected=expected)), segment(*specs))
    line.segment.cut(1)
    bring(line)
    line.segment.mend(1)
    line.elapse_until(lambda: line.segment.slaves[1].state is AlState.OP)
    assert line.segment.slaves[1].state is AlState.OP
    one, two = (each.esc.clock.system_time(line.now_ns) for each in line.segment.slaves)
    assert abs(one - two) < 1000
    assert line.segment.slaves[1].esc.clock.sync0_is_active


def test_read_identification_leaves_the_state_as_it_is():
    line = Line(Bench(), segment(slave("a", alias=77)))
    run(line, assign_stations([(0, 1001)]))
    assert run(line, read_identification(1001)) == 77
    assert line.segment.slaves[0].state is AlState.INIT
    assert line.segment.slaves[0].esc.memory[0x130] == 1


@pytest.mark.parametrize("stale", [1001, 1002])
def test_slave_with_the_address_of_another_is_taken_in_without_it(stale):
    line = tree()
    line.segment.cut(1)
    bring(line)
    line.tool.esc.memory[0x10:0x12] = stale.to_bytes(2, "little")
    line.segment.mend(1)
    line.elapse_until(lambda: {each.state for each in line.segment.slaves} == {AlState.OP})
    assert {each.state for each in line.segment.slaves} == {AlState.OP}
    assert all(exchange(line, station) for station in line.core.slaves)
    assert line.core.cycle.is_full


def test_other_slave_with_the_address_of_the_absent_one_is_a_stranger():
    line = tree()
    image = line.tool.esc.image
    line.tool.esc.image = image[:20] + (9).to_bytes(4, "little") + image[24:]
    line.segment.cut(1)
    bring(line)
    line.tool.esc.memory[0x10:0x12] = (1003).to_bytes(2, "little")
    line.segment.mend(1)
    line.elapse(2500 * MS)
    assert len(line.core.strangers) == 1
    assert line.events() == []
    assert line.core.slaves[1003].is_absent
