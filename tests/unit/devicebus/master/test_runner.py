from __future__ import annotations

import pytest

from devicebus.errors import FrameLostError, WorkingCounterError
from devicebus.master.access import fprd
from devicebus.master.link import RETRIES
from devicebus.master.procedure import Sleep, read
from devicebus.master.roundtrip import BACKOFF_LIMIT_NS
from tests.support.busline import Bench, answer


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


def test_errors_of_a_procedure_are_those_of_its_task(bench):
    task = bench.runner.start(read(1, 0, 1), 0)
    reply(bench, 0, wkc=0)
    with pytest.raises(WorkingCounterError):
        task.result()


def test_lost_frames_are_thrown_into_it(bench):
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
def test_a_cancelled_procedure_is_closed_and_sends_nothing_more(bench, asleep):
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
