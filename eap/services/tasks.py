"""Tasks owned by an object that lives longer than one block: kept, reported, ended together.

A TaskGroup ends with its block and with the first failure of a task.  Requests of clients, and
transfers that continue after their client has disconnected, need neither.  This is the only other
place that starts tasks (house rule, ``tools/check_tree.py``): the event loop keeps weak references
only, so a bare task can be collected, or its exception lost.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.services.limited_log import caused_by

T = TypeVar("T")

logger = logging.getLogger(__name__)


class TaskSet:
    """Tasks of one owner; *name* is for the log.

    Two kinds of tasks differ in where an exception goes: to the log, or to those that await it.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._tasks: set[asyncio.Task[Any]] = set()

    def __len__(self) -> int:
        return len(self._tasks)

    def start(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        """Start a task that nothing awaits; an exception is logged."""
        task = self.start_awaited(work)
        task.add_done_callback(self._report)
        return task

    def start_awaited(self, work: Coroutine[Any, Any, T]) -> asyncio.Task[T]:
        """Start a task whose result, or exception, is for those that await it."""
        # The set holds the strong reference that the loop does not.
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def wait_any(self) -> None:
        """Wait until one of the tasks has ended; return at once if there is none."""
        if self._tasks:
            await asyncio.wait(self._tasks, return_when=asyncio.FIRST_COMPLETED)

    def cancel(self) -> None:
        """Cancel all tasks."""
        for task in self._tasks:
            task.cancel()

    async def close(self) -> None:
        """Cancel all tasks, and wait until they have ended."""
        self.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _report(self, task: asyncio.Task[Any]) -> None:
        if not task.cancelled() and (exc := task.exception()) is not None:
            logger.error("%s: a task failed", self._name, exc_info=exc)


_RETRY_S = 1.0
"""Pause after an error of a socket."""


async def keep_serving(serve: Callable[[], Awaitable[None]]) -> None:
    """Call *serve* again after an error of a socket, which must end neither it nor this process."""
    while True:
        try:
            await serve()
        except* OSError as group:
            error = group.exceptions[0]
            cause = caused_by(("socket", str(error)), "sockets")
            logger.exception("socket error, trying again: %s", error, extra=cause)
        else:
            return
        await asyncio.sleep(_RETRY_S)


MAX_WAITING = 256

ResultT = TypeVar("ResultT")


class JobQueue:
    """Queue of jobs that run one at a time; *what* names them in messages.

    A job that has begun is finished even if its client disconnects: no change stays half done.
    """

    def __init__(self, what: str) -> None:
        self._what = what
        self._lock = asyncio.Lock()
        self._tasks = TaskSet(what)
        self._waiting = 0

    async def run(self, job: Callable[[], Coroutine[Any, Any, ResultT]]) -> ResultT:
        """Run *job* after those before it; return its result, or raise its exception.

        A job is dropped if its client disconnects before it begins.

        Raises:
            ControlError: too many jobs wait already.
        """
        if self._waiting >= MAX_WAITING:
            reason = f"{self._what}: {MAX_WAITING} requests wait already"
            raise ControlError(reason, code=ErrorCode.BUSY)
        self._waiting += 1
        try:
            await self._lock.acquire()
        finally:
            self._waiting -= 1
        task = self._tasks.start_awaited(job())
        # Not this coroutine: it may be cancelled before the job ends.
        task.add_done_callback(lambda _: self._lock.release())
        try:
            # Shielded: cancelling the client must not cancel a change that has begun.
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            task.add_done_callback(self._log_failure)
            raise

    def _log_failure(self, task: asyncio.Task[Any]) -> None:
        if not task.cancelled() and (exc := task.exception()) is not None:
            logger.warning("%s: a change failed after its client disconnected: %s", self._what, exc)
