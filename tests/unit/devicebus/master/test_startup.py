from __future__ import annotations

import random

import msgspec
import pytest

from devicebus.errors import (
    AlStatusError,
    BusError,
    FrameLostError,
    IdentityError,
    StateTimeoutError,
)
from devicebus.master.bus import MasterSettings
from devicebus.master.master import Master
from devicebus.master.matching import ExpectedSlave
from devicebus.sim.spec import ClockSpec, MailboxSpec
from devicebus.wire import sii
from devicebus.wire.alstatus import AlState
from eap.od.slave_config import OpMode
from tests.support.busline import MS, Paced, Slow, expect, segment, slave


def line_of(*slaves, **settings):
    return Paced(Master(MasterSettings(**settings)), segment(*slaves))


def states(line):
    return [each.state for each in line.segment.slaves]


SLAVES = (
    slave("coupler", "coupler", mailbox=None),
    slave("a"),
    slave("b", mailbox=None),
    slave("c", after="coupler", port=3, mailbox=MailboxSpec(size=128)),
)


@pytest.mark.parametrize("target", [AlState.INIT, AlState.PREOP, AlState.SAFEOP, AlState.OP])
def test_startup_brings_all_slaves_to_the_state(target):
    line = line_of(*SLAVES)
    line.wait(line.core.bring_up(line.now_ns, target))
    assert set(states(line)) == {target}
    assert {unit.state for unit in line.core.slaves.values()} == {target}


def test_sixteen_slaves_are_in_op_in_less_than_a_tenth_of_a_second():
    line = line_of(*[slave(f"s{n}") for n in range(16)])
    begun = line.now_ns
    line.wait(line.core.bring_up(begun))
    assert set(states(line)) == {AlState.OP}
    assert line.now_ns - begun < 100 * MS


def test_startup_slaves_with_an_alias_keep_name_and_station():
    there = [slave("right", product=2, alias=6), slave("x"), slave("left", product=2, alias=5)]
    expected = [
        ExpectedSlave(name=name, vendor=0xE5A, product=product, alias=alias)
        for name, product, alias in (("left", 2, 5), ("right", 2, 6), ("behind", 7, None))
    ]
    line = line_of(*there, expected=expected)
    line.wait(line.core.bring_up(line.now_ns))
    units = line.core.slaves
    assert [(at, unit.name) for at, unit in units.items()] == [
        (1002, "right"), (1003, "behind"), (1001, "left")
    ]  # fmt: skip
    line.core.image.write(1001, "out", True)
    line.elapse(5 * MS)
    written = [each.device.dictionary.entry(0x7000, 1).value for each in line.segment.slaves]
    assert list(map(bool, written)) == [False, False, True]
    line.segment.switch(1, on=False)
    line.elapse(200 * MS)
    line.segment.switch(1, on=True)
    line.elapse(500 * MS)
    assert states(line) == [AlState.OP] * 3
    assert not any(unit.is_lost for unit in units.values())


def test_startup_takes_over_a_running_bus():
    line = line_of(*SLAVES)
    line.wait(line.core.bring_up(line.now_ns))
    line.wait(line.core.bring_up(line.now_ns))
    assert set(states(line)) == {AlState.OP}


@pytest.mark.parametrize("seed", [3, 5])
def test_startup_lost_frames_delay_only(seed):
    line = line_of(*SLAVES)
    line.lose_out = lambda number: number % 11 == seed
    line.lose_back = lambda number: number % 13 == seed
    line.wait(line.core.bring_up(line.now_ns))
    assert set(states(line)) == {AlState.OP}


def test_names_are_those_that_were_expected():
    expected = [ExpectedSlave(name=f"n{n}", vendor=0xE5A, product=7) for n in range(2)]
    line = line_of(slave("a"), slave("b"), expected=expected)
    line.wait(line.core.bring_up(line.now_ns, AlState.PREOP))
    assert [unit.name for unit in line.core.slaves.values()] == ["n0", "n1"]


def test_startup_leaves_an_unexpected_bus_in_init():
    expected = [ExpectedSlave(name="n", vendor=0xE5A, product=8)]
    line = line_of(slave("a"), expected=expected)
    with pytest.raises(IdentityError, match="expected n with vendor"):
        line.wait(line.core.bring_up(line.now_ns))
    assert states(line) == [AlState.INIT]


def test_startup_refusing_slave_is_named():
    line = line_of(slave("a"), slave("b"), slave("c"))
    line.segment.slaves[1].refused_states[AlState.OP] = 0x1A
    with pytest.raises(AlStatusError, match="slave 1002: refuses OP"):
        line.wait(line.core.bring_up(line.now_ns))
    line.segment.slaves[2].refused_states[AlState.OP] = 0x19
    with pytest.raises(BusError) as caught:
        line.wait(line.core.bring_up(line.now_ns))
    lines = str(caught.value).splitlines()
    assert lines[0] == "2 slaves have failed:"
    assert lines[1].startswith("  b (1002): refuses OP")
    assert lines[2].startswith("  c (1003): refuses OP")


def test_startup_slaves_that_fail_for_one_reason_are_one_line():
    line = line_of(*(slave(f"s{number}") for number in range(32)))
    for each in line.segment.slaves[3:]:
        each.refused_states[AlState.OP] = 0x19
    with pytest.raises(BusError) as caught:
        line.wait(line.core.bring_up(line.now_ns))
    assert str(caught.value) == (
        "29 slaves from s3 (1004) to s31 (1032): refuses OP and is in SAFEOP+ERROR:"
        " AL status code 0x0019, no valid outputs"
    )


def test_startup_refusing_slave_does_not_stop_the_others():
    line = line_of(slave("a"), slave("b"), slave("c"))
    line.segment.slaves[1].refused_states[AlState.OP] = 0x1A
    with pytest.raises(AlStatusError):
        line.wait(line.core.bring_up(line.now_ns))
    line.elapse(300 * MS)
    assert states(line) == [AlState.OP, AlState.SAFEOP, AlState.OP]
    line.segment.slaves[1].refused_states.clear()
    line.elapse_until(lambda: set(states(line)) == {AlState.OP})
    assert set(states(line)) == {AlState.OP}


def test_startup_slave_below_preop_keeps_its_part_of_the_image():
    line = line_of(slave("a"), slave("b"), slave("c"))
    line.segment.slaves[1].refused_states[AlState.PREOP] = 0x16
    with pytest.raises(AlStatusError, match="slave 1002: refuses PREOP"):
        line.wait(line.core.bring_up(line.now_ns))
    assert states(line) == [AlState.OP, AlState.INIT, AlState.OP]
    assert line.core.cycle.is_good
    line.segment.slaves[1].refused_states.clear()
    line.elapse_until(lambda: set(states(line)) == {AlState.OP})
    assert set(states(line)) == {AlState.OP}
    line.core.image.write(1002, "out", True)
    line.elapse(5 * MS)
    assert line.segment.slaves[1].device.dictionary.entry(0x7000, 1).value
    assert line.core.cycle.is_full


def test_startup_slave_with_too_much_process_data_is_left_out():
    line = line_of(slave("a"), slave("b", mailbox=None))
    image = line.segment.slaves[1].esc.eeprom.image
    content = sii.decode(image)
    huge = tuple(msgspec.structs.replace(each, length=1400) for each in content.sync_managers)
    octets = sii.encode(
        msgspec.structs.replace(content, sync_managers=huge, rx_pdos=(), tx_pdos=())
    )
    image[: len(octets)] = octets
    with pytest.raises(BusError, match="slave 1002: 2800 bytes of process data"):
        line.wait(line.core.bring_up(line.now_ns))
    assert line.segment.slaves[0].state is AlState.OP
    assert line.core.cycle.is_full


def test_startup_without_remaining_slaves_has_no_cycle():
    line = line_of(slave("a"))
    line.segment.slaves[0].refused_states[AlState.PREOP] = 0x16
    with pytest.raises(AlStatusError):
        line.wait(line.core.bring_up(line.now_ns))
    assert line.core.cycle is None


def test_startup_without_frames_fails():
    line = line_of(slave("a"))
    line.segment.cut(0)
    with pytest.raises(FrameLostError, match="check the cable"):
        line.wait(line.core.bring_up(line.now_ns))


def clocked(name):
    return slave(name, clock=ClockSpec(needs_sync0=True, drift_ppm=len(name) * 20))


def test_slaves_that_need_sync0_reach_op_with_their_clocks_together():
    line = line_of(
        clocked("a"),
        clocked("bb"),
        expected=[
            expect(clocked("a"), sync=OpMode()),
            expect(clocked("bb"), sync=OpMode(cycle0_ns=MS, shift0_ns=1000)),
        ],
        epoch_offset_ns=10**17,
    )
    line.wait(line.core.bring_up(line.now_ns))
    line.elapse_until(lambda: set(states(line)) == {AlState.OP})
    assert set(states(line)) == {AlState.OP}
    one, two = (each.esc.clock.system_time(line.now_ns) for each in line.segment.slaves)
    assert abs(one - two) < 1000
    assert abs(one - line.now_ns - 10**17) < 10 * MS
    line.segment.switch(1, on=False)
    line.elapse(100 * MS)
    line.segment.switch(1, on=True)
    line.elapse_until(lambda: set(states(line)) == {AlState.OP})
    assert set(states(line)) == {AlState.OP}
    one, two = (each.esc.clock.system_time(line.now_ns) for each in line.segment.slaves)
    assert abs(one - two) < 1000
    assert all(each.esc.clock.sync0_is_active for each in line.segment.slaves)


def test_startup_without_clocks_slaves_with_sync0_refuse():
    line = line_of(clocked("a"))
    with pytest.raises(AlStatusError, match="0x0030, invalid DC SYNC configuration"):
        line.wait(line.core.bring_up(line.now_ns))


def test_startup_bus_without_clocks_reaches_op():
    line = line_of(slave("a", clock=None), clocks=True)
    line.wait(line.core.bring_up(line.now_ns))
    assert states(line) == [AlState.OP]


def test_shut_down_bus_stays_in_init():
    line = line_of(*SLAVES)
    line.wait(line.core.bring_up(line.now_ns))
    assert line.core.cycle is not None
    line.wait(line.core.shut_down(line.now_ns))
    assert set(states(line)) == {AlState.INIT}
    assert (line.core.slaves, line.core.cycle) == ({}, None)
    line.elapse(500 * MS)
    assert set(states(line)) == {AlState.INIT}


def test_shut_down_reports_slaves_outside_of_init():
    line = line_of(slave("a"))
    line.wait(line.core.bring_up(line.now_ns))
    line.segment.slaves[0].refused_states[AlState.INIT] = 0x11
    with pytest.raises(StateTimeoutError, match="not in INIT within 5 s"):
        line.wait(line.core.shut_down(line.now_ns))


def test_200_slaves_come_to_op_while_the_round_trip_jumps():
    dice = random.Random(200)
    trip_ns = [MS // 10]

    def jump():
        if dice.random() < 0.02:
            trip_ns[0] = dice.choice((MS // 10, MS, 10 * MS, 30 * MS))
        return trip_ns[0]

    line = Slow(Master(), segment(*(slave(f"s{number}") for number in range(200))), jump)
    line.period_ns = 2 * MS
    line.wait(line.core.bring_up(line.now_ns), 30_000 * MS)
    assert {each.state for each in line.segment.slaves} == {AlState.OP}
    assert line.events() == []
    stats = line.core.stats()
    assert stats.link.late > 0
    assert stats.link.lost == 0
    assert stats.cycle.wkc_errors == 0
    line.elapse(200 * MS)
    assert line.events() == []
    assert {unit.state for unit in line.core.slaves.values()} == {AlState.OP}


def test_bring_up_with_one_frame_lost_fails_no_slave():
    for lost in range(0, 400, 17):
        line = Paced(Master(), segment(*(slave(f"s{number}") for number in range(5))))
        line.period_ns = 4 * MS
        line.lose_back = lambda number, lost=lost: number == lost
        line.wait(line.core.bring_up(line.now_ns))
        line.elapse(200 * MS)
        assert line.events() == []
        assert {unit.state for unit in line.core.slaves.values()} == {AlState.OP}


def test_bring_up_on_a_bus_that_falls_silent_blames_no_slave():
    line = Paced(Master(), segment(*(slave(f"s{number}") for number in range(5))))
    line.lose_out = lambda number: number > 60
    with pytest.raises(FrameLostError) as caught:
        line.wait(line.core.bring_up(line.now_ns))
    assert "no frame came back" in str(caught.value)
    assert "slaves have failed" not in str(caught.value)
