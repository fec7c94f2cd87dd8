from __future__ import annotations

import pytest

from devicebus.errors import FrameLostError, WorkingCounterError
from devicebus.master.access import DatagramReply, fprd, fpwr
from devicebus.master.procedure import Sleep, StepReplies, read, together, write


def finish(procedure, answer):
    with pytest.raises(StopIteration) as end:
        procedure.send(answer)
    return end.value.value


def test_reading_and_writing_check_the_working_counter():
    reading = read(1001, 0x130, 2)
    assert next(reading) == [fprd(1001, 0x130, 2)]
    assert finish(reading, StepReplies([DatagramReply(b"ab", 1)], 0)) == b"ab"
    writing = write(1001, 0x120, b"\1\0")
    assert next(writing) == [fpwr(1001, 0x120, b"\1\0")]
    assert finish(writing, StepReplies([DatagramReply(b"\1\0", 1)], 0)) is None
    for again, text in (
        (read(1001, 0x130, 2), "slave 1001: reading 0x130: working counter 0, expected 1"),
        (write(1002, 0x120, b"", "AL control"), "slave 1002: writing AL control"),
    ):
        next(again)
        with pytest.raises(WorkingCounterError, match=text):
            again.send(StepReplies([DatagramReply(b"", 0)], 0))


def sleeper(log, name, duration):
    _, now_ns = yield Sleep(duration)
    log.append((name, now_ns))
    return name


def test_procedures_together_share_their_accesses_and_sleep_as_long_as_the_shortest():
    log = []
    both = together([read(1, 0, 1), sleeper(log, "a", 5), read(2, 0, 2), sleeper(log, "b", 9)])
    assert next(both) == Sleep(0)
    assert both.send(StepReplies((), 100)) == [fprd(1, 0, 1), fprd(2, 0, 2)]
    assert both.send(StepReplies([DatagramReply(b"x", 1), DatagramReply(b"yz", 0)], 103)) == Sleep(
        2
    )
    assert both.send(StepReplies((), 105)) == Sleep(4)
    results = finish(both, StepReplies((), 120))
    assert (results[0], results[1], results[3]) == (b"x", "a", "b")
    assert isinstance(results[2], WorkingCounterError)
    assert log == [("a", 105), ("b", 120)]


def patient(station):
    try:
        yield [fprd(station, 0, 1)]
    except FrameLostError:
        yield Sleep(7)
    return station


def test_together_without_any_frame_back_blames_none_of_them():
    both = together([read(1, 0, 1), read(2, 0, 1)])
    next(both)
    both.send(StepReplies((), 0))
    with pytest.raises(FrameLostError, match="gone"):
        both.throw(FrameLostError("gone"))


def test_closing_closes_all():
    closed = []

    def endless():
        try:
            while True:
                yield [fprd(1, 0, 1)]
        finally:
            closed.append(True)

    both = together([endless(), endless()])
    next(both)
    both.send(StepReplies((), 0))
    both.close()
    assert closed == [True, True]


def test_nothing_together_ends_at_once():
    none = together([])
    next(none)
    assert finish(none, StepReplies((), 0)) == []
