"""The timer of a router: the running loop calls it when it has something to do."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

_SHORTEST_WAIT_S = 0.001
_MOMENT_S = 0.02
"""How late a time-out may be noticed."""


class RouterTimer:
    """Has something handled in time, from :meth:`start` to :meth:`stop`.

    Args:
        next_timeout: Returns when the next thing is due, in nanoseconds of the monotonic clock, or
            None for never.
        handle: Called then, or a bit earlier or later; it has the timer set again.
    """

    def __init__(self, next_timeout: Callable[[], int | None], handle: Callable[[], None]) -> None:
        self._next_timeout = next_timeout
        self._handle = handle
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._is_soon = False

    def start(self) -> None:
        """Begin, in the running loop."""
        self._loop = asyncio.get_running_loop()
        self.set()

    def stop(self) -> None:
        """Call nobody any more."""
        self._loop = None
        if self._timer is not None:
            self._timer.cancel()

    def set(self) -> None:
        """Call when the next thing is due."""
        at_ns = self._next_timeout()
        if at_ns is None or self._loop is None:
            return
        if self._timer is not None:
            if self._is_soon or self._timer.when() <= at_ns / 1e9:
                return
            self._timer.cancel()
        at_s = max(at_ns / 1e9, self._loop.time() + _SHORTEST_WAIT_S)
        self._timer = self._loop.call_at(at_s, self._ring)

    def set_soon(self) -> None:
        """Call after a moment, as something may be due earlier than it was.

        That is cheap; when exactly it is due is looked up then, and not for each packet.
        """
        if self._is_soon or self._loop is None:
            return
        self._is_soon = True
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self._loop.call_later(_MOMENT_S, self._ring)

    def _ring(self) -> None:
        self._timer = None
        self._is_soon = False
        self._handle()
