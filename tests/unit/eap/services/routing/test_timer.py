"""The timer of a router."""

from __future__ import annotations

import asyncio
from time import monotonic_ns

from eap.services.routing.station_router import RouterTimer
from tests.support.eventually import elapse

MS = 1_000_000


class Clock:
    """Something with a next time-out; it notes when it was called."""

    def __init__(self) -> None:
        self.due_ns: int | None = None
        self.rang_ns: list[int] = []
        self.rang = asyncio.Event()
        self.timer = RouterTimer(lambda: self.due_ns, self._handle)

    def set(self, in_ms: int) -> int:
        self.due_ns = monotonic_ns() + in_ms * MS
        self.timer.set()
        return self.due_ns

    def _handle(self) -> None:
        self.rang_ns.append(monotonic_ns())
        self.due_ns = None
        self.rang.set()


def play(script):
    async def run():
        clock = Clock()
        async with asyncio.timeout(10):
            await script(clock)
        clock.timer.stop()

    asyncio.run(run())


def test_timer_fires_at_the_due_time():
    async def script(clock):
        clock.timer.start()
        clock.set(10_000)
        due_ns = clock.set(30)  # the earlier one counts
        clock.set(10_000)
        await clock.rang.wait()
        assert clock.rang_ns[0] >= due_ns - MS

    play(script)


def test_timer_overdue_does_not_keep_the_loop_busy():
    async def script(clock):
        clock.timer.start()
        clock.set(-1000)
        await asyncio.sleep(0)
        assert not clock.rang_ns
        await clock.rang.wait()

    play(script)


def test_timer_set_soon_is_shared():
    async def script(clock):
        clock.timer.start()
        clock.set(10_000)
        for _ in range(1000):
            clock.timer.set_soon()
            clock.set(1)  # it is looked up after the moment
        await clock.rang.wait()
        await elapse(0.05)
        assert len(clock.rang_ns) == 1

    play(script)


def test_timer_does_not_fire_before_start_and_after_stop():
    async def script(clock):
        clock.set(1)
        clock.timer.set_soon()
        await elapse(0.05)
        assert not clock.rang_ns
        clock.timer.start()
        clock.timer.stop()
        clock.set(1)
        await elapse(0.05)
        assert not clock.rang_ns

    play(script)


def test_timer_start_handles_what_was_due_before():
    async def script(clock):
        clock.set(1)
        clock.timer.start()
        await clock.rang.wait()

    play(script)
