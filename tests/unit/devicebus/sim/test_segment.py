"""Segments: wiring, cuts, power, rings, and the times at which frames pass."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.sim.devices.build import build_slave
from devicebus.sim.segment import (
    CABLE_NS,
    FORWARD_NS,
    Cable,
    SegmentEnd,
    SimulatedSegment,
    dl_status,
    trace_path,
)
from devicebus.sim.spec import ClockSpec
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, encode_frame, iter_datagrams
from devicebus.wire.register import Register
from tests.support.bus import STATION, Bench, datagram, generic, send

HOP = FORWARD_NS + CABLE_NS


def links(*cables, ring_end=None, master=True):
    found = {(0, 0): SegmentEnd.PRIMARY} if master else {}
    for child, parent, port in cables:
        found[child, 0] = parent, port
        found[parent, port] = child, 0
    if ring_end is not None:
        found[ring_end] = SegmentEnd.SECONDARY
    return found


def test_segment_line_is_processed_in_order():
    path = trace_path(links((1, 0, 1), (2, 1, 1)), (0, 0))
    assert (path.order, path.exit, path.closed_at) == ((0, 1, 2), SegmentEnd.PRIMARY, None)
    assert path.arrivals == {
        (0, 0): 0, (1, 0): HOP, (2, 0): 2 * HOP, (1, 1): 3 * HOP, (0, 1): 4 * HOP,
    }  # fmt: skip


def test_branches_go_in_the_order_3_1_2():
    path = trace_path(links((1, 0, 1), (2, 0, 2), (3, 0, 3), (4, 3, 1)), (0, 0))
    assert path.order == (0, 3, 4, 1, 2)


def test_single_slave():
    path = trace_path(links(), (0, 0))
    assert (path.order, path.arrivals) == ((0,), {(0, 0): 0})


def test_segment_closed_ring_is_processed_from_one_end():
    ring = links((1, 0, 1), (2, 1, 1), ring_end=(2, 1))
    assert trace_path(ring, (0, 0)).order == (0, 1, 2)
    assert trace_path(ring, (0, 0)).exit is SegmentEnd.SECONDARY
    back = trace_path(ring, (2, 1))
    assert (back.order, back.exit) == ((), SegmentEnd.PRIMARY)


def test_broken_ring_is_worked_off_from_both_sides():
    ring = links((1, 0, 1), (3, 2, 1), ring_end=(3, 1))
    first = trace_path(ring, (0, 0))
    assert (first.order, first.exit, first.closed_at) == ((0, 1), SegmentEnd.PRIMARY, None)
    second = trace_path(ring, (3, 1))
    assert (second.order, second.exit, second.closed_at) == ((2, 3), SegmentEnd.SECONDARY, 0)


def test_long_line_needs_no_deep_stack():
    cables = [(n, n - 1, 1) for n in range(1, 3000)]
    assert trace_path(links(*cables), (0, 0)).order == tuple(range(3000))


def test_dl_status_of_a_captured_controller():
    # SOEM with one LAN9252, frame 94 of the capture in tests/vectors: 1756.
    assert dl_status(frozenset({0})) == 0x5617
    assert dl_status(frozenset({0, 1})) == 0x5A37


def count(bench_or_segment) -> int:
    segment = getattr(bench_or_segment, "segment", bench_or_segment)
    return send(segment, Command.BRD, 0, 0, b"\0").wkc


def line(number: int) -> Bench:
    return Bench(*(generic(f"slave {n}") for n in range(number)))


def test_every_slave_answers():
    assert count(line(4)) == 4


def test_segment_without_slaves_loses_frames():
    frame = bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")]))
    assert SimulatedSegment([]).process_frame(frame, 0) is None


def test_segment_cut_cable_hides_the_slaves_behind():
    bench = line(4)
    bench.segment.cut(2)
    assert count(bench) == 2
    status = bench.read(Register.DL_STATUS, 2, STATION + 1).data
    assert status == (0x5617).to_bytes(2, "little")
    bench.segment.mend(2)
    assert count(bench) == 4
    status = bench.read(Register.DL_STATUS, 2, STATION + 1).data
    assert status == (0x5A37).to_bytes(2, "little")


def test_cut_at_the_master_loses_frames():
    bench = line(2)
    bench.segment.cut(0)
    frame = bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")]))
    assert bench.segment.process_frame(frame, 0) is None


def test_segment_slave_returns_reset_after_power_off():
    bench = line(3)
    bench.bring(AlState.PREOP, 1)
    bench.segment.switch(1, on=False)
    assert count(bench) == 1
    bench.segment.switch(1, on=True)
    assert count(bench) == 3
    assert bench.read(Register.AL_STATUS, 2, STATION + 1).wkc == 0
    assert bench.send(Command.APRD, 0xFFFF, Register.AL_STATUS, bytes(2)).data == b"\x01\x00"
    assert bench.read(Register.AL_STATUS, 2, STATION + 2).wkc == 1


def test_segment_closed_port_hides_the_slaves_behind():
    bench = line(3)
    assert bench.write(Register.DL_CONTROL + 1, b"\x0c") == 1
    assert count(bench) == 1
    bench.write(Register.DL_CONTROL + 1, b"\x00")
    assert count(bench) == 3


def test_branches():
    specs = [generic(f"slave {n}") for n in range(4)]
    cables = [Cable(1, 0, 1), Cable(2, 1, 1), Cable(3, 0, 3)]
    bench = Bench(*specs, cables=cables)
    stations = [bench.send(Command.APRD, -n & 0xFFFF, 0x10, bytes(2)).wkc for n in range(4)]
    assert stations == [1, 1, 1, 1]
    second = bench.segment.slaves[3].esc
    assert bench.send(Command.APWR, 0xFFFF, 0x1F00, b"x").wkc == 1
    assert second.peek(0x1F00, 1) == b"x"


def test_receive_times_follow_the_wiring():
    bench = line(3)
    bench.now_ns = 5_000_000
    assert bench.send(Command.BWR, 0, Register.DC_RECEIVE_TIME, bytes(4)).wkc == 3
    times = [
        [int.from_bytes(bench.read(Register.DC_RECEIVE_TIME + 4 * port, 4, STATION + n).data,
                        "little") for port in range(2)]
        for n in range(3)
    ]  # fmt: skip
    start = times[0][0]
    assert times == [
        [start, start + 4 * HOP],
        [times[1][0], times[1][0] + 2 * HOP],
        [times[2][0], 0],
    ]


def test_segment_broken_ring_works_from_both_ends():
    slaves = [build_slave(generic(f"slave {n}")) for n in range(4)]
    segment = SimulatedSegment(slaves, ring_end=(3, 1))

    def send_at(side):
        frame = bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0")]))
        out = segment.process_frame(frame, 0, side)
        return out, next(iter_datagrams(frame)).wkc

    assert send_at(SegmentEnd.PRIMARY) == (SegmentEnd.SECONDARY, 4)
    assert send_at(SegmentEnd.SECONDARY) == (SegmentEnd.PRIMARY, 0)
    segment.cut(1)
    assert send_at(SegmentEnd.PRIMARY) == (SegmentEnd.PRIMARY, 1)
    assert send_at(SegmentEnd.SECONDARY) == (SegmentEnd.SECONDARY, 3)
    segment.cut(0)
    assert send_at(SegmentEnd.PRIMARY) == (None, 0)


def test_circulating_frame_is_taken_out_of_a_broken_ring():
    slaves = [build_slave(generic(f"slave {n}")) for n in range(2)]
    segment = SimulatedSegment(slaves, ring_end=(1, 1))
    segment.cut(1)
    frame = bytearray(encode_frame([datagram(Command.BRD, 0, 0, b"\0", circulating=1)]))
    assert segment.process_frame(frame, 0, SegmentEnd.SECONDARY) is None


def test_slaves_look_at_the_time_between_frames():
    bench = line(1)
    assert bench.segment.next_timeout() is None
    bench.bring(AlState.OP)
    bench.cycle()
    deadline = bench.segment.next_timeout()
    assert deadline == 100_000_000
    bench.segment.handle_timeout(deadline)
    assert bench.slaves[0].state is AlState.SAFEOP


@pytest.mark.parametrize("late_ns", [0, 100, 999_999, 5_000_000])
def test_next_timeout_is_never_over(late_ns):
    bench = line(2)
    bench.bring(AlState.OP)
    bench.cycle()
    bench.now_ns = bench.segment.next_timeout() - 1
    bench.read(Register.AL_STATUS, 6)
    bench.now_ns += 1 + late_ns
    bench.segment.handle_timeout(bench.now_ns)
    due = bench.segment.next_timeout()
    while due is not None:
        assert due > bench.now_ns
        bench.now_ns = due
        bench.segment.handle_timeout(due)
        due = bench.segment.next_timeout()
    assert bench.slaves[0].state is AlState.SAFEOP


def test_segment_slave_without_power_has_no_timer():
    bench = line(2)
    bench.bring(AlState.OP)
    bench.cycle()
    bench.segment.switch(0, on=False)
    assert bench.segment.next_timeout() is None


def test_segment_clocks_follow_the_reference():
    slow = ClockSpec(drift_ppm=-80, start_ns=123_456_789)
    bench = Bench(generic("a"), generic("b", clock=slow), generic("c"), cable_ns=700)
    for number in (1, 2):
        delay = number * (FORWARD_NS + 700)
        station = STATION + number
        bench.write(Register.DC_SYSTEM_TIME_DELAY, delay.to_bytes(4, "little"), station)
        there = bench.slaves[number].esc.clock.local_time(0)
        bench.write(Register.DC_SYSTEM_TIME_OFFSET, (-there % (1 << 64)).to_bytes(8, "little"),
                    station)  # fmt: skip
    for _ in range(3000):
        bench.now_ns += 1_000_000
        bench.send(Command.FRMW, STATION, Register.DC_SYSTEM_TIME, bytes(8))
    times = [slave.esc.clock.system_time(bench.now_ns) for slave in bench.slaves]
    assert max(times) - min(times) < 20
    read = [bench.read(Register.DC_SYSTEM_TIME, 8, STATION + n).data for n in range(3)]
    shown = [int.from_bytes(octets, "little") for octets in read]
    assert max(shown) - min(shown) < 20


@pytest.mark.parametrize("frames", [1, 3])
def test_same_run_gives_the_same_frames(frames):
    def run():
        bench = line(2)
        bench.bring(AlState.OP)
        return [bench.cycle(outputs=bytes((n, 0, 0))) for n in range(frames)]

    assert run() == run()


PLACES = st.one_of(
    st.sampled_from((0x10, 0x100, 0x120, 0x200, 0x300, 0x500, 0x502, 0x600, 0x800, 0x808, 0x80E,
                     0x900, 0x910, 0x920, 0x980, 0x9A0, 0xFFE, 0x1000, 0x1100, 0x1200)),
    st.integers(0, 0xFFFF),
)  # fmt: skip


@given(
    st.lists(
        st.tuples(
            st.sampled_from(Command),
            st.sampled_from((0, 0xFFFF, STATION, STATION + 1)),
            PLACES,
            st.binary(max_size=64),
            st.sampled_from((0, 1000, 10**9)),
        ),
        max_size=30,
    )
)
def test_segment_survives_any_frame(steps):
    bench = line(2)
    bench.bring(AlState.OP)
    for command, adp, ado, data, pause_ns in steps:
        bench.now_ns += pause_ns
        frame = bytearray(encode_frame([datagram(command, adp, ado, data)]))
        bench.segment.process_frame(frame, bench.now_ns)
    for number in range(2):
        bench.segment.switch(number, on=False)
        bench.segment.switch(number, on=True)
    assert count(bench) == 2


def test_pdo_assignment_by_complete_access():
    bench = line(1)
    bench.bring(AlState.PREOP)
    dictionary = bench.slaves[0].device.dictionary
    dictionary.download_complete(0x1C13, 0, b"\0\0", bench.slaves[0].device.od_state())
    bench.set_channels(0, 2)
    bench.ask(AlState.SAFEOP)
    assert bench.status() == (AlState.PREOP | 0x10, 0x1E)
    dictionary.download_complete(0x1C13, 0, b"\1\0\0\x1a", bench.slaves[0].device.od_state())
    bench.ask(AlState.SAFEOP | 0x10)
    assert bench.status() == (AlState.SAFEOP, 0)


@pytest.mark.parametrize("was_late", [True, False])
def test_outputs_that_waited_for_a_late_process_keep_the_watchdog_alive(was_late):
    bench = line(1)
    bench.bring(AlState.OP)
    bench.cycle()
    bench.now_ns = 150_000_000  # the watchdog ran out 50 ms ago
    if was_late:
        bench.segment.postpone_timeouts(bench.now_ns)
    bench.send(Command.BRD, 0, 0, b"\0")
    bench.now_ns += 5_000_000
    bench.cycle()
    bench.now_ns += 50_000_000
    assert bench.status()[0] == (AlState.OP if was_late else AlState.SAFEOP | 0x10)


def test_postponed_watchdog_still_runs_out():
    bench = line(1)
    bench.bring(AlState.OP)
    bench.cycle()
    bench.now_ns = 150_000_000
    bench.segment.postpone_timeouts(bench.now_ns)
    assert bench.status()[0] == AlState.OP
    bench.now_ns = bench.segment.next_timeout()
    assert bench.status()[0] == AlState.SAFEOP | 0x10
