from __future__ import annotations

import asyncio
import gc

import pytest

from eap.services.tasks import TaskSet


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

    asyncio.run(scene())


def test_task_set_logs_the_exception_of_a_task(caplog):
    async def scene():
        task = TaskSet("gateway bus0").start(fail())
        await asyncio.wait({task})
        await asyncio.sleep(0)

    asyncio.run(scene())
    (record,) = caplog.records
    assert record.getMessage() == "gateway bus0: a task failed"
    assert record.exc_info is not None


def test_task_set_leaves_the_exception_to_those_that_await_it(caplog):
    async def scene():
        with pytest.raises(ValueError, match="broken"):
            await TaskSet("test").start_awaited(fail())
        await asyncio.sleep(0)

    asyncio.run(scene())
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

    asyncio.run(scene())
    assert not caplog.records
