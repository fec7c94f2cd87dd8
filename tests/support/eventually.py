"""Waiting for conditions that other tasks, threads or processes bring about."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from time import monotonic, sleep


async def eventually(condition: Callable[[], object], timeout_s: float = 20.0) -> None:
    """Return when *condition* holds."""
    async with asyncio.timeout(timeout_s):
        while not condition():  # noqa: ASYNC110  what is waited for has no event
            await asyncio.sleep(0.001)


async def settle() -> None:
    """Let all run that is ready, with the data on sockets of this loop; only timers are left."""
    for _ in range(30):
        await asyncio.sleep(0)


async def elapse(duration_s: float) -> None:
    """Let the clock of the running loop jump, and all run that is due then."""
    loop = asyncio.get_running_loop()
    time = loop.time
    loop.time = lambda: time() + duration_s  # type: ignore[method-assign]
    await settle()


def wait_until(condition: Callable[[], object], timeout_s: float = 20.0) -> None:
    """Return when *condition* holds, for tests without a loop."""
    end_s = monotonic() + timeout_s
    while not condition():
        assert monotonic() < end_s, "it does not happen"
        sleep(0.001)
