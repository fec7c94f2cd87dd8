from __future__ import annotations

import weakref

import pytest

from devicebus.errors import BusError, FrameLostError, WorkingCounterError
from devicebus.master.link import BACKOFF_LIMIT_NS, RETRIES
from devicebus.master.procedure import Alarm, Sleep, StepReplies, Task, read, together, write
from devicebus.wire.datagram import DatagramReply, fprd, fpwr
from tests.support.busline import MS, Bench, answer


@pytest.fixture
def stopped():
    return []


@pytest.fixture
def task(stopped):
    return Task("reading", lambda: stopped.append(True))


def test_task_has_its_result_at_the_end(task):
    seen = []
    task.watch(seen.append)
    with pytest.raises(BusError, match="reading is not done yet"):
        task.result()
    assert (task.is_done, seen) == (False, [])
    task.finish(None)
    assert (task.is_done, task.result(), seen) == (True, None, [task])
    task.watch(seen.append)
    assert seen == [task, task]


def test_task_raises_its_error(task):
    task.fail(BusError("no"))
    assert task.is_done
    with pytest.raises(BusError, match="no"):
        task.result()


def test_task_cancel_stops_the_procedure_once(task, stopped):
    task.cancel()
    task.cancel()
    assert stopped == [True]
    with pytest.raises(BusError, match="reading was cancelled"):
        task.result()


def test_task_cancel_after_the_end_changes_nothing(task, stopped):
    task.finish(5)
    task.cancel()
    assert (task.result(), stopped) == (5, [])


def test_task_releases_its_procedure_at_the_end():
    class Behind:
        def stop(self):
            raise AssertionError

    behind = Behind()
    gone = weakref.ref(behind)
    done = Task("x", behind.stop)
    done.finish(1)
    del behind
    assert gone() is None


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


def test_together_without_procedures_ends_at_once():
    none = together([])
    next(none)
    assert finish(none, StepReplies((), 0)) == []


@pytest.fixture
def bench():
    return Bench()


def reply(bench, now_ns, **content):
    for frame in bench.frames_to_send(now_ns):
        bench.receive_frame(answer(frame, **content), now_ns)


def test_procedures_run_side_by_side(bench):
    tasks = [bench.runner.start(read(station, 0, 1), 0) for station in (1, 2, 3)]
    (frame,) = bench.frames_to_send(0)
    assert not any(task.is_done for task in tasks)
    bench.receive_frame(answer(frame, data=b"x"), 5)
    assert [task.result() for task in tasks] == [b"x"] * 3


def test_runner_error_of_a_procedure_is_its_task_error(bench):
    task = bench.runner.start(read(1, 0, 1), 0)
    reply(bench, 0, wkc=0)
    with pytest.raises(WorkingCounterError):
        task.result()


def test_runner_throws_lost_frames_into_the_procedure(bench):
    task = bench.runner.start(read(1, 0, 1), 0)
    for count in range(1 + RETRIES):
        bench.frames_to_send(count * BACKOFF_LIMIT_NS)
        bench.handle_timeout((count + 1) * BACKOFF_LIMIT_NS)
    with pytest.raises(FrameLostError):
        task.result()
    assert bench.next_timeout() is None


def test_sleepers_wake_in_the_order_of_their_times(bench):
    log = []

    def sleeper(duration):
        yield Sleep(0)
        _, now_ns = yield Sleep(duration)
        log.append((duration, now_ns))
        yield [fprd(1, 0, 1)]
        return duration

    tasks = [bench.runner.start(sleeper(each), 100) for each in (30, 10, 20)]
    assert bench.next_timeout() == 110
    bench.handle_timeout(109)
    assert log == []
    bench.handle_timeout(120)
    assert log == [(10, 120), (20, 120)]
    assert bench.next_timeout() == 130
    bench.handle_timeout(130)
    reply(bench, 130)
    assert [task.result() for task in tasks] == [30, 10, 20]


@pytest.mark.parametrize("asleep", [True, False])
def test_runner_cancelled_procedure_sends_nothing_more(bench, asleep):
    closed = []

    def endless():
        try:
            while True:
                yield Sleep(10) if asleep else [fprd(1, 0, 1)]
        finally:
            closed.append(True)

    task = bench.runner.start(endless(), 0)
    task.cancel()
    assert closed == [True]
    assert bench.next_timeout() is None
    bench.handle_timeout(10)
    assert bench.frames_to_send(10) == []


def test_alarm_ends_a_pause_once():
    bench = Bench()
    alarm, woken = Alarm(), []

    def procedure():
        for pause_ns in (100 * MS, 50 * MS):
            _, now_ns = yield Sleep(pause_ns, alarm)
            woken.append(now_ns)

    alarm.ring(5)
    task = bench.runner.start(procedure(), 0)
    alarm.ring(300 * MS)
    assert bench.next_timeout() == 100 * MS
    alarm.ring(20 * MS)
    assert bench.next_timeout() == 20 * MS
    bench.handle_timeout(20 * MS)
    assert (woken, bench.next_timeout()) == ([20 * MS], 70 * MS)
    bench.handle_timeout(70 * MS)
    assert (woken, task.is_done) == ([20 * MS, 70 * MS], True)
    alarm.ring(80 * MS)
    assert bench.next_timeout() is None
    bench.handle_timeout(400 * MS)
    assert woken == [20 * MS, 70 * MS]
