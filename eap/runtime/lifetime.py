"""Life of an optional process that runs with asyncio."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable

from eap.runtime.startup import LIFE_PERIOD_S


async def wait_for_end(ended: asyncio.Event, parent: int, beat: Callable[[], None]) -> None:
    """Return when the process is to end: by SIGINT or SIGTERM, or as its supervisor has gone.

    Args:
        ended: Set by the signals; others may set it, too.
        parent: Process id of the supervisor; 0 for none.
        beat: Called every ``LIFE_PERIOD_S``.
    """
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    # A supervisor that was killed sends no signal: its children get another parent.
    while not ended.is_set() and (not parent or os.getppid() == parent):
        beat()
        try:
            async with asyncio.timeout(LIFE_PERIOD_S):
                await ended.wait()
        except TimeoutError:
            continue
