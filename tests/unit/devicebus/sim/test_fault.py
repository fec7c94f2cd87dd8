"""Faults of frames and cables, by script and by command, in virtual time."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.build import build_slave
from devicebus.sim.fault import FaultySegment
from devicebus.sim.segment import Segment
from devicebus.sim.spec import FaultKind, FaultSpec
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, encode_frame, iter_datagrams
from devicebus.wire.register import Register
from tests.support.bus import datagram, generic

MS = 1_000_000


def fault(kind, **more) -> FaultSpec:
    return FaultSpec(kind=FaultKind(kind), **more)


def make(*script) -> FaultySegment:
    slaves = [build_slave(generic(name)) for name in ("a", "b", "c")]
    return FaultySegment(Segment(slaves), script)


def exchange(faulty, now_ns=0, command=Command.BRD, ado=0, size=1, adp=0):
    """Send one datagram; return (working counter, data) of each frame that is back now."""
    frame = bytearray(encode_frame([datagram(command, adp, ado, bytes(size))]))
    faulty.receive_frame(frame, now_ns, origin="me")
    return answers(faulty, now_ns)


def answers(faulty, now_ns):
    found = []
    for out in faulty.frames_to_send(now_ns):
        assert out.origin == "me"
        found += [(wkc, bytes(data)) for _, data, wkc in iter_datagrams(out.frame)]
    return found


def wkcs(faulty, now_ns=0):
    return [wkc for wkc, _ in exchange(faulty, now_ns)]


def test_without_faults_every_frame_is_back_at_once():
    faulty = make()
    assert wkcs(faulty) == [3]
    assert faulty.next_timeout() is None


def test_every_third_frame_is_lost():
    faulty = make(fault("loss", every=3))
    assert [wkcs(faulty) for _ in range(6)] == [[3], [3], [], [3], [3], []]


def test_frames_are_late_and_keep_their_order():
    faulty = make(fault("delay", delay_us=500, for_ms=1))
    assert wkcs(faulty) == []
    assert exchange(faulty, MS - 1, ado=4) == [(3, b"\x11")]
    assert faulty.next_timeout() == MS
    assert wkcs(faulty, MS) == [3]
    assert answers(faulty, MS + 499_999) == [(3, b"\x08")]


def test_wrong_working_counter():
    faulty = make(fault("wkc", every=2))
    assert [wkcs(faulty) for _ in range(4)] == [[3], [2], [3], [2]]


def test_wrong_working_counter_in_each_datagram():
    faulty = make(fault("wkc"))
    datagrams = [datagram(Command.BRD, 0, 0, b"\0"), datagram(Command.NOP, 0, 0, b"")]
    faulty.receive_frame(bytearray(encode_frame(datagrams)), 0, origin="me")
    assert answers(faulty, 0) == [(2, b"\x11"), (0, b"")]


def test_damaged_frames_are_counted_where_they_start():
    faulty = make(fault("corrupt", slave="b", for_ms=1))
    assert wkcs(faulty) == []
    assert wkcs(faulty) == []
    counters = [
        exchange(faulty, MS, Command.APRD, at, 1, -n & 0xFFFF)[0][1][0]
        for n in range(3)
        for at in (Register.RX_ERROR, Register.FORWARDED_RX_ERROR)
    ]
    assert counters == [0, 0, 2, 0, 0, 2]


def test_damaged_frame_is_taken_in_front_of_the_damage_only():
    faulty = make(fault("corrupt", slave="b", for_ms=1))
    assert exchange(faulty, 0, Command.BWR, Register.STATION_ADDRESS, 2) == []
    frame = bytearray(encode_frame([datagram(Command.BWR, 0, 0x1F00, b"\x55")]))
    faulty.receive_frame(frame, 0)
    memory = [slave.esc.peek(0x1F00, 1) for slave in faulty.segment.slaves]
    assert memory == [b"\x55", b"\0", b"\0"]


def test_damage_where_no_frame_comes_hurts_nobody():
    faulty = make(fault("corrupt", slave="c", for_ms=1), fault("cut", slave="b", for_ms=1))
    faulty.handle_timeout(0)
    assert wkcs(faulty) == []
    assert faulty.segment.slaves[2].esc.peek(Register.RX_ERROR, 1) == b"\0"


def test_cut_by_script_is_mended_in_time():
    faulty = make(fault("cut", slave="b", at_ms=10, for_ms=5))
    assert wkcs(faulty, 7) == [3]
    assert faulty.next_timeout() == 10 * MS + 7
    assert wkcs(faulty, 10 * MS + 7) == [1]
    assert wkcs(faulty, 15 * MS + 6) == [1]
    assert wkcs(faulty, 15 * MS + 7) == [3]
    lost = exchange(faulty, 16 * MS, Command.APRD, Register.LOST_LINK, 4)
    assert lost == [(1, b"\0\1\0\0")]


def test_power_by_command():
    faulty = make()
    spec = fault("power", slave="c")
    faulty.begin(spec, 0)
    assert wkcs(faulty) == [2]
    faulty.end(spec, 0)
    assert wkcs(faulty) == [3]


def test_command_with_a_time_counts_from_now():
    faulty = make()
    faulty.handle_timeout(0)
    faulty.begin(fault("cut", slave="a", at_ms=1, for_ms=1), 5 * MS)
    assert [wkcs(faulty, at * MS) for at in (5, 6, 7)] == [[3], [], [3]]


def test_fault_inside_a_slave():
    faulty = make(fault("refuse", slave="a", state="PREOP", code=0x8000))
    faulty.handle_timeout(0)
    assert faulty.segment.slaves[0].refuses == {AlState.PREOP: 0x8000}


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (fault("cut", slave="x"), r"no slave 'x' \(one of a, b, c\)"),
        (fault("corrupt"), "fault corrupt: it needs a slave"),
        (fault("sdo", slave="a", object="x"), "not INDEX"),
        (fault("refuse", slave="a", state="RUN"), "no state 'RUN'"),
    ],
)
def test_fault_that_cannot_be(spec, message):
    with pytest.raises(ValueError, match=message):
        make(spec)
    with pytest.raises(ValueError, match=message):
        make().begin(spec, 0)
