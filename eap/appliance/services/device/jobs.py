"""Jobs that are done one after the other, and to their ends, whoever waits for them.

A client that leaves in the middle of a change must not leave half of it behind: what has begun is
finished, only its result is for nobody then.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar

from eap.appliance.control import ErrorCode
from eap.errors import ControlError

MAX_WAITING = 256

ResultT = TypeVar("ResultT")

logger = logging.getLogger(__name__)


class Jobs:
    """A queue of jobs; *what* they are about is for the refusal when it is full."""

    def __init__(self, what: str) -> None:
        self._what = what
        self._queue: asyncio.Queue[tuple[Callable[[], Awaitable[Any]], asyncio.Future[Any]]]
        self._queue = asyncio.Queue(MAX_WAITING)

    async def do(self, job: Callable[[], Awaitable[ResultT]]) -> ResultT:
        """Wait for the turn and the end of *job*; return and raise what it does.

        Raises:
            ControlError: too many wait already.
        """
        future: asyncio.Future[ResultT] = asyncio.get_running_loop().create_future()
        try:
            self._queue.put_nowait((job, future))
        except asyncio.QueueFull:
            reason = f"{self._what}: {MAX_WAITING} requests wait already"
            raise ControlError(reason, code=ErrorCode.BUSY) from None
        return await future

    async def serve(self) -> None:
        """Do jobs until cancelled."""
        while True:
            job, future = await self._queue.get()
            if future.cancelled():
                continue
            try:
                result = await job()
            except Exception as exc:  # noqa: BLE001  it belongs to who waits
                if not future.cancelled():
                    future.set_exception(exc)
                else:
                    logger.warning("%s: a change nobody waits for failed: %s", self._what, exc)
            else:
                if not future.cancelled():
                    future.set_result(result)
