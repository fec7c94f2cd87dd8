"""Jobs that are done one after the other, and to their ends, whoever waits for them.

A client that leaves in the middle of a change must not leave half of it behind: what has begun is
finished, only its result is for nobody then.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from typing import Any, TypeVar

from eap.control.protocol import ErrorCode
from eap.errors import ControlError
from eap.services.tasks import TaskSet

MAX_WAITING = 256

ResultT = TypeVar("ResultT")

logger = logging.getLogger(__name__)


class Jobs:
    """A row of jobs; *what* they are about is for the refusal when it is full."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._lock = asyncio.Lock()
        self._tasks = TaskSet(what)
        self._waiting = 0

    async def do(self, job: Callable[[], Coroutine[Any, Any, ResultT]]) -> ResultT:
        """Wait for the turn and the end of *job*; return and raise what it does.

        Who leaves before its turn wants it no more.

        Raises:
            ControlError: too many wait already.
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
        task.add_done_callback(lambda _: self._lock.release())
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            task.add_done_callback(self._tell_nobody)
            raise

    def _tell_nobody(self, task: asyncio.Task[Any]) -> None:
        if not task.cancelled() and (exc := task.exception()) is not None:
            logger.warning("%s: a change nobody waits for failed: %s", self._what, exc)
