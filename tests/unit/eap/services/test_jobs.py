"""JobQueue one after the other, to their ends."""

from __future__ import annotations

import asyncio

import pytest

from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.services import tasks as module
from eap.services.tasks import JobQueue


def play(script):
    async def run():
        return await script(JobQueue("station a"))

    return asyncio.run(run())


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
