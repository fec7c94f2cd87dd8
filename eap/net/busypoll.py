"""Event loop that polls its descriptors for some microseconds before it sleeps.

A client that waits for each answer sends the next request at once, and a router that forwards it
soon gets the answer.  Both arrive sooner than a process can sleep and be woken, which takes as long
as the answer itself.  So after an event that came quickly the loop polls before it sleeps.

A sender on the same processor cannot run during a poll.  So each fruitless poll doubles the number
of waits without polling.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextvars import Context
from selectors import EVENT_READ, EpollSelector, SelectorKey
from time import monotonic_ns
from typing import TypeAlias, TypeVarTuple, Unpack

QUICK_NS = 120_000
"""Events that come within this time after the end of the work before are quick."""
SPIN_LIMIT_NS = 60_000
"""Time limit of one poll."""
# A quick sender may have been interrupted.
MAX_FRUITLESS = 2
"""Fruitless polls in a row before backing off."""
MAX_BACKOFF = 1024
"""Most waits without a poll after many fruitless polls."""
MAX_ROUNDS = 32
"""Limit of the events in a row that are handled without the loop."""
_LONG_NS = 1_000_000_000

_Ts = TypeVarTuple("_Ts")
Event: TypeAlias = tuple[SelectorKey, int]
Watcher: TypeAlias = Callable[[], object]
"""Handles what waits in a descriptor; returns a true value if there was something."""


class BusyPollSelector(EpollSelector):
    """Selector that polls before it sleeps, and handles what arrives without a round of the loop.

    A descriptor that is registered with a function as data belongs to that function, which is
    called when something arrives.  Readers of asyncio are called in the same way.

    Args:
        report: Called with the error of such a function.
        clock: The monotonic clock, in nanoseconds.

    Attributes:
        has_work: Whether such a function gave the loop something to do.
    """

    def __init__(
        self, report: Callable[[Exception], object], clock: Callable[[], int] = monotonic_ns
    ) -> None:
        super().__init__()
        self.has_work = False
        self._report = report
        self._clock = clock
        self._is_quick = False
        self._retries = 0
        self._skipped = 0
        self._backoff = 1
        self._latest: Watcher | None = None

    def unwatch(self, fd: int) -> None:
        """Forget a descriptor with a function; harmless for another one."""
        key = self.get_map().get(fd)
        if key is not None and callable(key.data):
            self.unregister(fd)
            if key.data is self._latest:
                self._latest = None

    def select(self, timeout: float | None = None) -> list[Event]:
        """Return what the loop has to handle within *timeout* seconds, None for any time."""
        # Without a time-out of its own the loop has work, which is not delayed.
        if timeout is not None and timeout <= 0:
            return self._handle(super().select(0))
        began_ns = self._clock()
        end_ns = began_ns + (_LONG_NS if timeout is None else int(timeout * 1e9))
        self.has_work = False
        for _ in range(MAX_ROUNDS):
            events = self._poll(began_ns, end_ns)
            if self.has_work:
                break
            if not events:
                left_ns = end_ns - self._clock()
                if left_ns <= 0:
                    break
                events = super().select(None if timeout is None else left_ns / 1e9)
                if not events:
                    break
            self._is_quick = self._clock() - began_ns < QUICK_NS
            others = self._handle(events)
            if others or self.has_work:
                return others
            # All was handled here: the loop would only come back.
            began_ns = self._clock()
        return []

    def _poll(self, began_ns: int, end_ns: int) -> list[Event]:
        """Poll where the next event is probably near; return the events, if there are any.

        The function that was called last is called again, which takes less time than to find out
        that it has something to do.
        """
        if self._skipped:
            self._skipped -= 1
            return []
        if not (self._is_quick or self._retries):
            return []
        clock, select = self._clock, super().select
        limit_ns = min(end_ns, began_ns + SPIN_LIMIT_NS)
        calls = 0
        while clock() <= limit_ns and calls < MAX_ROUNDS:
            if self._latest is not None and self._call(self._latest):
                self._retries, self._backoff = MAX_FRUITLESS, 1
                if self.has_work:
                    return []
                limit_ns = min(end_ns, clock() + SPIN_LIMIT_NS)
                calls += 1
            elif events := select(0):
                self._retries, self._backoff = MAX_FRUITLESS, 1
                return events
        self._is_quick = False
        if calls:
            return []
        # A quick sender has some more chances.
        if self._retries:
            self._retries -= 1
        else:
            self._skipped, self._backoff = self._backoff, min(2 * self._backoff, MAX_BACKOFF)
        return []

    def _handle(self, events: list[Event]) -> list[Event]:
        """Handle the events of watched descriptors and of readers; return the others."""
        if len(events) == 1:
            return [] if self._handle_one(*events[0]) else events
        others = [
            event for event in events if self._is_current(event[0]) and not self._handle_one(*event)
        ]
        return [event for event in others if self._is_current(event[0])]

    def _is_current(self, key: SelectorKey) -> bool:
        """Return whether an event is still for the one who registered the descriptor."""
        # Another event may have closed it, and a new descriptor may have its number.  An event that
        # is left out comes again.
        return self.get_map().get(key.fd) is key

    def _handle_one(self, key: SelectorKey, mask: int) -> bool:
        """Handle an event, unless it is for the loop; return whether it was not."""
        if callable(key.data):
            self._latest = key.data
            self._call(key.data)
            return True
        self._latest = None
        reader, _ = key.data
        if mask != EVENT_READ or not isinstance(reader, asyncio.Handle):
            return False
        # The loop would do the same, after two more steps for each event.
        reader._run()  # noqa: SLF001
        return True

    def _call(self, watcher: Watcher) -> bool:
        try:
            return bool(watcher())
        except Exception as exc:  # noqa: BLE001  as the loop does with its callbacks
            self._report(exc)
            return False


class BusyPollLoop(asyncio.SelectorEventLoop):
    """Event loop with such a selector."""

    def __init__(self) -> None:
        self._polling = BusyPollSelector(self._report)
        super().__init__(self._polling)

    def watch(self, fd: int, handle: Watcher) -> None:
        """Call *handle* whenever something waits in *fd*; no other event of it is noticed.

        It may be called although nothing waits there.
        """
        self._polling.register(fd, EVENT_READ, handle)

    def unwatch(self, fd: int) -> None:
        """Undo :meth:`watch`; harmless for a descriptor that is not watched."""
        if not self.is_closed():
            self._polling.unwatch(fd)

    def call_soon(
        self,
        callback: Callable[[Unpack[_Ts]], object],
        *args: *_Ts,
        context: Context | None = None,
    ) -> asyncio.Handle:
        """Call *callback* in the next round (asyncio)."""
        self._polling.has_work = True
        return super().call_soon(callback, *args, context=context)

    def call_at(
        self,
        when: float,
        callback: Callable[[Unpack[_Ts]], object],
        *args: *_Ts,
        context: Context | None = None,
    ) -> asyncio.TimerHandle:
        """Call *callback* at a time (asyncio)."""
        self._polling.has_work = True
        return super().call_at(when, callback, *args, context=context)

    def _read_from_self(self) -> None:
        # Signals and other threads schedule without call_soon(), and wake the loop by this reader.
        self._polling.has_work = True
        super()._read_from_self()  # type: ignore[misc]

    def _report(self, error: Exception) -> None:
        self.call_exception_handler({"message": "exception in a watcher", "exception": error})
