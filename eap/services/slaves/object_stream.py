"""An object on its way from a slave to a reader that takes it piece by piece."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from typing import Any

from eap.services.tasks import TaskSet


class ObjectStream:
    """Octets of an object, from the moment when its size is known.

    Args:
        size: Octets of all of it.
        data: The first ones; all of them unless :meth:`follow` brings the rest.

    Attributes:
        size: As given.
        done: Octets that the reader has taken.
    """

    def __init__(self, size: int, data: bytes) -> None:
        self.size = size
        self.done = 0
        self._data = bytearray(data)
        self._changed = asyncio.Event()
        self._task: asyncio.Task[object] | None = None

    def follow(self, rest: Coroutine[Any, Any, object]) -> asyncio.Task[object]:
        """Start the task that reads the rest at the slave's speed and gives it to :meth:`take`."""
        self._task = TaskSet("upload").start_awaited(rest)
        self._task.add_done_callback(lambda _: self._changed.set())
        return self._task

    def take(self, piece: bytes) -> None:
        """Add the next octets."""
        self._data += piece
        self._changed.set()

    async def read(self, size: int) -> bytes:
        """Return the next *size* octets, fewer only at the end; cancelling it takes nothing.

        Raises:
            EapError: that has ended the upload, as SlaveAccess says.
        """
        end = min(self.done + size, self.size)
        while len(self._data) < end and self._task is not None:
            if self._task.done():
                self._task.result()
                break
            self._changed.clear()
            await self._changed.wait()
        data = bytes(self._data[self.done : end])
        self.done = end
        return data

    def close(self) -> None:
        """End the upload, at the slave too if it is not complete there."""
        task, self._task = self._task, None
        if task is None or task.cancelled():
            return
        if task.done():
            task.exception()  # the reader has it, or does not want it any more
        else:
            task.cancel()
