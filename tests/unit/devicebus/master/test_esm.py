from __future__ import annotations

import pytest

from devicebus.errors import AlStatusError, BusError, StateTimeoutError, WorkingCounterError
from devicebus.master.esm import TIMEOUT_NS, acknowledge, change_state, path, read_status
from devicebus.master.scan import assign_stations
from devicebus.sim.slave import ALLOWED
from devicebus.wire.alstatus import AlState
from devicebus.wire.datagram import Command, DatagramReply
from devicebus.wire.register import AlStatus
from tests.support.busline import MS, Bench, Line, drive, run, segment, slave

INIT, PREOP, BOOT, SAFEOP, OP = (
    AlState.INIT, AlState.PREOP, AlState.BOOT, AlState.SAFEOP, AlState.OP,
)  # fmt: skip


@pytest.mark.parametrize(
    ("current", "target", "expected"),
    [
        (INIT, INIT, ()),
        (INIT, OP, (PREOP, SAFEOP, OP)),
        (SAFEOP, OP, (OP,)),
        (OP, PREOP, (PREOP,)),
        (OP, INIT, (INIT,)),
        (INIT, BOOT, (BOOT,)),
        (OP, BOOT, (INIT, BOOT)),
        (BOOT, SAFEOP, (INIT, PREOP, SAFEOP)),
        (BOOT, INIT, (INIT,)),
        (BOOT, BOOT, ()),
    ],
)
def test_esm_path_between_states(current, target, expected):
    assert path(current, target) == expected


@pytest.mark.parametrize("current", list(AlState))
@pytest.mark.parametrize("target", list(AlState))
def test_esm_every_path_has_allowed_steps(current, target):
    for step in path(current, target):
        assert step in ALLOWED[current]
        current = step
    assert current is target


@pytest.fixture
def line():
    """A slave without a mailbox, which needs nothing to reach PREOP."""
    line = Line(Bench(), segment(slave("a", mailbox=None), slave("b")))
    run(line, assign_stations([(0, 1001), (1, 1002)]))
    return line


def test_change_state_reaches_the_state(line):
    run(line, change_state(1001, PREOP))
    assert run(line, read_status(1001)).state == PREOP
    before = line.frames
    run(line, change_state(1001, PREOP))
    assert line.frames == before + 1


def test_change_state_refused_reports_code_text_and_state(line):
    with pytest.raises(AlStatusError) as caught:
        run(line, change_state(1002, PREOP))
    assert str(caught.value) == (
        "slave 1002: refuses PREOP and is in INIT+ERROR: AL status code 0x0016,"
        " invalid mailbox configuration for PreOp"
    )
    assert (caught.value.code, caught.value.state) == (0x16, INIT)


def test_change_state_acknowledges_an_error_first(line):
    with pytest.raises(AlStatusError):
        run(line, change_state(1002, OP))
    assert run(line, read_status(1002)).error
    assert run(line, acknowledge(1002)) is INIT
    assert not run(line, read_status(1002)).error
    line.segment.slaves[0].refused_states[PREOP] = 0x8001
    with pytest.raises(AlStatusError, match="0x8001, code 0x8001 of the vendor"):
        run(line, change_state(1001, PREOP))
    line.segment.slaves[0].refused_states.clear()
    run(line, change_state(1001, PREOP))


def test_esm_slave_without_answer(line):
    with pytest.raises(WorkingCounterError, match="slave 1003"):
        run(line, change_state(1003, PREOP))


def stuck(state, *, error=0, code=0):
    octets = AlStatus(state, error=error, code=code).encode()
    return lambda access: DatagramReply(
        octets if access.command is Command.FPRD else access.data, 1
    )


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({}, "slave 7: still in INIT, expected SAFEOP within 10000 ms"),
        ({"timeout_ns": 3 * MS}, "expected SAFEOP within 3 ms"),
    ],
)
def test_change_state_times_out(options, text):
    with pytest.raises(StateTimeoutError, match=text):
        drive(change_state(7, SAFEOP, **options), stuck(INIT))


def test_change_state_has_a_time_out_for_every_state():
    assert set(TIMEOUT_NS) == set(AlState)


def test_acknowledge_times_out():
    with pytest.raises(
        StateTimeoutError,
        match=r"slave 7: keeps its error 0x001B .sync manager watchdog. in SAFEOP",
    ):
        drive(acknowledge(7), stuck(SAFEOP, error=1, code=0x1B))


def test_acknowledge_refuses_an_undefined_state():
    with pytest.raises(BusError, match="slave 7: state 5 is no AL state"):
        drive(change_state(7, OP), stuck(5))


def test_acknowledge_in_device_emulation_ignores_the_mirrored_bit():
    written = [b"\x11\0"]

    def emulate(access):
        if access.command is Command.FPWR:
            written.append(access.data)
        return DatagramReply(
            written[-1].ljust(6, b"\0") if access.command is Command.FPRD else b"", 1
        )

    assert drive(acknowledge(7), emulate) is INIT
    assert written[-1] == b"\1\0"
