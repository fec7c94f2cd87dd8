from __future__ import annotations

import pytest

from devicebus.errors import WorkingCounterError
from devicebus.master.clocks import (
    Latched,
    drift_datagram,
    find_delays,
    read_difference,
    start_sync,
    stop_sync,
    synchronize,
)
from devicebus.master.scan import TopologyNode, scan
from devicebus.sim.segment import CABLE_NS, FORWARD_NS
from devicebus.sim.spec import ClockSpec
from devicebus.wire.register import Register
from eap.od.slave_config import SyncSignals
from tests.support.busline import MS, Bench, Line, run, segment, slave

HOP = CABLE_NS + FORWARD_NS
TIME = 800_000_000 * 1_000_000_000


def line_of(*slaves):
    line = Line(Bench(), segment(*slaves))
    return line, run(line, scan())


def clocked(name, start_ns=0, drift_ppm=0.0, **options):
    return slave(name, clock=ClockSpec(start_ns=start_ns, drift_ppm=drift_ppm), **options)


def times(line):
    return {
        each.device.name: each.esc.clock.system_time(line.now_ns) for each in line.segment.slaves
    }


def test_clocks_with_different_start_show_the_same_time():
    line, found = line_of(
        clocked("a", 5_000_000_000), clocked("b", 77), clocked("c", 123_456_789_012)
    )
    states = run(line, synchronize(found, TIME))
    assert [state.station for state in states] == [1001, 1002, 1003]
    shown = times(line)
    assert abs(shown["a"] - TIME) < 100 * MS
    assert max(shown.values()) - min(shown.values()) < 3 * HOP


def test_delays_along_a_line_with_branches():
    line, found = line_of(
        clocked("a"),
        clocked("branch", after="a", port=3),
        clocked("b", after="a"),
        slave("none", clock=None),
        clocked("c"),
    )
    by_name = {
        slave.name: state.delay_ns
        for state in run(line, synchronize(found, TIME))
        for slave in found
        if slave.station == state.station
    }
    assert by_name["a"] == 0
    assert by_name["branch"] == pytest.approx(HOP, abs=FORWARD_NS)
    assert by_name["b"] == pytest.approx(3 * HOP, abs=2 * FORWARD_NS)
    assert by_name["b"] < by_name["c"]
    assert "none" not in by_name


def test_clocks_receive_times_wrap_at_32_bits():
    nodes = {
        0: TopologyNode((0, 1), None, 0, 0),
        1: TopologyNode((0,), 0, 1, 0),
    }
    start = 0xFFFF_FF00
    latched = {
        0: Latched((start, start + 700 & 0xFFFF_FFFF, 0, 0), start),
        1: Latched((50, 0, 0, 0), 50),
    }
    assert find_delays(nodes, latched) == {0: 0, 1: 350}


def test_clocks_bus_without_clocks_is_not_set():
    line, found = line_of(slave("a", clock=None))
    assert run(line, synchronize(found, TIME)) == ()


@pytest.mark.parametrize("back", [0, 1])
def test_clocks_only_the_returned_slave_is_set(back):
    line, found = line_of(clocked("a", 5), clocked("b", 77))
    run(line, synchronize(found, TIME))
    at = Register.DC_SYSTEM_TIME_OFFSET
    memory = [each.esc.memory for each in line.segment.slaves]
    memory[back][at : at + 8] = bytes(8)
    before = bytes(memory[1 - back][at : at + 8])
    run(line, synchronize(found, 0, only=frozenset((1001 + back,))))
    assert memory[1 - back][at : at + 8] == before
    shown = times(line)
    assert abs(shown["a"] - shown["b"]) < 2 * HOP


def test_clocks_slave_behind_an_unknown_one_has_no_delay():
    nodes = {2: TopologyNode((0,), 1, 1, 0)}
    assert find_delays(nodes, {2: Latched((5, 0, 0, 0), 5)}) == {2: 0}


def test_drift_is_taken_out_by_the_datagram_of_every_cycle():
    line, found = line_of(clocked("a"), clocked("b", drift_ppm=50))
    run(line, synchronize(found, TIME))

    def steer():
        yield [drift_datagram(1001)]

    for _ in range(3000):
        run(line, steer())
        line.elapse(MS)
    assert abs(run(line, read_difference(1002))) < 100
    shown = times(line)
    assert abs(shown["a"] - shown["b"]) < 2 * HOP


def test_differences_have_a_sign():
    line, _ = line_of(clocked("a"))
    at = Register.DC_SYSTEM_TIME_DIFFERENCE
    memory = line.segment.slaves[0].esc.memory
    memory[at : at + 4] = b"\x05\0\0\x80"
    assert run(line, read_difference(1001)) == -5
    memory[at : at + 4] = b"\x05\0\0\0"
    assert run(line, read_difference(1001)) == 5


SIGNALS = SyncSignals(activate=0x0300, cycle0_ns=MS, shift0_ns=250_000)


def test_sync0_starts_at_a_whole_cycle_plus_shift():
    line, found = line_of(clocked("a"))
    run(line, synchronize(found, TIME))
    start = run(line, start_sync(1001, SIGNALS))
    assert start % MS == 250_000
    shown = times(line)["a"]
    assert shown + 90 * MS < start < shown + 102 * MS
    clock = line.segment.slaves[0].esc.clock
    assert clock.sync0_is_active
    assert clock.take_sync0(line.now_ns + 110 * MS) >= 8
    assert not clock.sync1_is_active


def test_sync1_follows_sync0_by_its_register():
    line, found = line_of(clocked("a"))
    run(line, synchronize(found, TIME))
    both = SyncSignals(activate=0x0730, cycle0_ns=MS, cycle1_ns=MS + 20_000)
    run(line, start_sync(1001, both))
    esc = line.segment.slaves[0].esc
    assert esc.memory[Register.DC_CYCLIC_UNIT] == 0x30
    assert esc.clock.sync1_is_active
    # Every second SYNC0 pulse has a SYNC1.
    later = line.now_ns + 110 * MS
    assert esc.clock.take_sync0(later) in {2 * esc.clock.take_sync1(later) - n for n in (0, 1)}
    run(line, stop_sync(1001, 0))
    assert not esc.clock.sync0_is_active


def test_clocks_lost_slave_is_named():
    line, found = line_of(clocked("a"), clocked("b"))
    line.segment.cut(1)
    with pytest.raises(WorkingCounterError, match="slave 1002: reading receive times"):
        run(line, synchronize(found, TIME))
