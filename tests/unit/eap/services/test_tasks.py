"""Task sets and job queues."""

from __future__ import annotations

import asyncio
import gc

import pytest

from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.services import tasks as module
from eap.services.tasks import JobQueue, TaskSet
from tests.support.virtualtime import run_virtual


async def fail() -> None:
    await asyncio.sleep(0)
    raise ValueError("broken")


def test_task_set_keeps_tasks_until_they_are_done():
    async def scene():
        tasks, done = TaskSet("test"), asyncio.Event()
        tasks.start(done.wait())
        gc.collect()
        await asyncio.sleep(0)
        assert len(tasks) == 1
        done.set()
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        assert len(tasks) == 0

    run_virtual(scene())


def test_task_set_logs_the_exception_of_a_task(caplog):
    async def scene():
        task = TaskSet("gateway bus0").start(fail())
        await asyncio.wait({task})
        await asyncio.sleep(0)

    run_virtual(scene())
    (record,) = caplog.records
    assert record.getMessage() == "gateway bus0: a task failed"
    assert record.exc_info is not None


def test_task_set_leaves_the_exception_to_those_that_await_it(caplog):
    async def scene():
        with pytest.raises(ValueError, match="broken"):
            await TaskSet("test").start_awaited(fail())
        await asyncio.sleep(0)

    run_virtual(scene())
    assert not caplog.records


def test_task_set_closed_has_ended_all_tasks(caplog):
    async def scene():
        tasks, ended = TaskSet("test"), []

        async def work() -> None:
            try:
                await asyncio.get_running_loop().create_future()
            finally:
                ended.append(1)

        started = [tasks.start(work()) for _ in range(2)]
        await asyncio.sleep(0)
        await tasks.close()
        assert ended == [1, 1]
        assert all(task.cancelled() for task in started)

    run_virtual(scene())
    assert not caplog.records


def play(script):
    async def run():
        return await script(JobQueue("station a"))

    return run_virtual(run())


def test_jobs_run_one_at_a_time():
    order = []

    async def job(number):
        order.append(("begin", number))
        await asyncio.sleep(0)
        order.append(("end", number))
        return number

    async def script(jobs):
        return await asyncio.gather(*(jobs.run(lambda n=n: job(n)) for n in range(3)))

    assert play(script) == [0, 1, 2]
    assert order == [(word, n) for n in range(3) for word in ("begin", "end")]


def test_job_failure_is_raised_to_its_client():
    async def fail():
        raise ZeroDivisionError

    async def script(jobs):
        with pytest.raises(ZeroDivisionError):
            await jobs.run(fail)
        return await jobs.run(lambda: asyncio.sleep(0, "next"))

    assert play(script) == "next"


@pytest.mark.parametrize("fails", [False, True])
def test_running_job_is_finished_after_its_client_disconnects(caplog, fails):
    done = []

    async def script(jobs):
        begun, go_on = asyncio.Event(), asyncio.Event()

        async def job():
            begun.set()
            await go_on.wait()
            done.append(1)
            if fails:
                raise ValueError("too late")

        waiting = asyncio.ensure_future(jobs.run(job))
        await begun.wait()
        waiting.cancel()
        go_on.set()
        await jobs.run(lambda: asyncio.sleep(0))
        assert waiting.cancelled()

    play(script)
    assert done == [1]
    said = "station a: a change failed after its client disconnected: too late" in caplog.text
    assert said is fails


def test_waiting_job_is_dropped_when_its_client_disconnects():
    async def script(jobs):
        done = []
        go_on = asyncio.Event()
        first = asyncio.ensure_future(jobs.run(go_on.wait))
        second = asyncio.ensure_future(jobs.run(lambda: asyncio.sleep(0, done.append(1))))
        await asyncio.sleep(0)
        second.cancel()
        go_on.set()
        await first
        await jobs.run(lambda: asyncio.sleep(0))
        return done

    assert play(script) == []


def test_job_queue_is_limited(monkeypatch):
    monkeypatch.setattr(module, "MAX_WAITING", 1)

    async def script(jobs):
        begun = asyncio.ensure_future(jobs.run(asyncio.Event().wait))
        await asyncio.sleep(0)
        waiting = asyncio.ensure_future(jobs.run(lambda: asyncio.sleep(0)))
        await asyncio.sleep(0)
        with pytest.raises(ControlError, match="station a: 1 requests wait") as caught:
            await jobs.run(lambda: asyncio.sleep(0))
        assert caught.value.code == ErrorCode.BUSY
        for each in (begun, waiting):
            each.cancel()

    play(script)
