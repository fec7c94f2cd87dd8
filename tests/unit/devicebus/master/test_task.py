from __future__ import annotations

import weakref

import pytest

from devicebus.errors import BusError
from devicebus.master.task import Task


@pytest.fixture
def stopped():
    return []


@pytest.fixture
def task(stopped):
    return Task("reading", lambda: stopped.append(True))


def test_a_result_is_there_once_it_is_done(task):
    seen = []
    task.watch(seen.append)
    with pytest.raises(BusError, match="reading is not done yet"):
        task.result()
    assert (task.is_done, seen) == (False, [])
    task.finish(None)
    assert (task.is_done, task.result(), seen) == (True, None, [task])
    task.watch(seen.append)
    assert seen == [task, task]


def test_what_went_wrong_is_raised(task):
    task.fail(BusError("no"))
    assert task.is_done
    with pytest.raises(BusError, match="no"):
        task.result()


def test_cancelling_stops_what_is_behind_it_once(task, stopped):
    task.cancel()
    task.cancel()
    assert stopped == [True]
    with pytest.raises(BusError, match="reading was cancelled"):
        task.result()


def test_cancelling_what_is_done_changes_nothing(task, stopped):
    task.finish(5)
    task.cancel()
    assert (task.result(), stopped) == (5, [])


def test_nothing_is_kept_of_what_was_behind_a_task_that_is_done():
    class Behind:
        def stop(self):
            raise AssertionError

    behind = Behind()
    gone = weakref.ref(behind)
    done = Task("x", behind.stop)
    done.finish(1)
    del behind
    assert gone() is None
