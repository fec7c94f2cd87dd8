"""Event loop with a clock of its own, which jumps to the next timer whenever nothing else is due.

Time-outs and periods cost no time, and a machine that is busy makes no difference.  For scenes
whose sockets are Unix sockets inside one loop: what other processes or the IP stack do takes real
time, during which this clock goes on to the end.
"""

from __future__ import annotations

import asyncio
import selectors
import sys
import time
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from types import ModuleType
from typing import Any, TypeVar

T = TypeVar("T")

_TICK_S = 1e-6
"""Duration of one look at the sockets, so that loops that only look come to an end."""


class _JumpingSelector(selectors.DefaultSelector):
    """Selector that lets time pass instead of waiting.

    Attributes:
        now_s: The time.
    """

    def __init__(self) -> None:
        super().__init__()
        self.now_s = time.monotonic()

    def select(self, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        """Return what is readable or writable; without timers as usual."""
        self.now_s += _TICK_S
        if timeout is None:
            return super().select(None)
        ready = super().select(0)
        if not ready:
            self.now_s += max(timeout, 0)
        return ready


class _VirtualLoop(asyncio.SelectorEventLoop):
    def __init__(self) -> None:
        self._jumping = _JumpingSelector()
        super().__init__(self._jumping)

    def time(self) -> float:
        """Return the time of this loop."""
        return self._jumping.now_s

    def run_in_executor(
        self, executor: Executor | None, func: Callable[..., T], *args: Any
    ) -> asyncio.Future[T]:
        """Call *func* at once, in the thread of this loop: for another one no clock would wait."""
        future: asyncio.Future[T] = self.create_future()
        try:
            future.set_result(func(*args))
        except Exception as exc:  # noqa: BLE001  it is raised where the future is awaited
            future.set_exception(exc)
        return future


def run_virtual(scene: Coroutine[Any, Any, T]) -> T:
    """Run *scene* as ``asyncio.run`` does; our modules read the clock of the loop."""
    with asyncio.Runner(loop_factory=_VirtualLoop) as runner, _clock_of(runner.get_loop()):
        return runner.run(scene)


_CLOCKS = time.monotonic, time.monotonic_ns
_seen: set[str] = set()
_users: list[tuple[str, str]] = []
"""Modules of ours that import a clock, with its name, among the thousands that were *seen*."""


def _real_clocks() -> list[tuple[ModuleType, Callable[[], float]]]:
    """Return each module of ours that has a clock as its own, with this clock."""
    for name in sys.modules.keys() - _seen:
        _seen.add(name)
        if name.startswith(("eap.", "tests.")) and name != __name__:
            own = vars(sys.modules[name])
            _users.extend((name, each.__name__) for each in _CLOCKS if each.__name__ in own)
    found = [(sys.modules.get(name), clock) for name, clock in _users]
    return [
        (module, real)
        for module, clock in found
        for real in _CLOCKS
        if module is not None and vars(module).get(clock) is real
    ]


@contextmanager
def _clock_of(loop: asyncio.AbstractEventLoop) -> Iterator[None]:
    clocks: dict[Callable[[], float], Callable[[], float]] = {
        time.monotonic: loop.time,
        time.monotonic_ns: lambda: round(loop.time() * 1e9),
    }
    found = _real_clocks()
    for module, real in found:
        setattr(module, real.__name__, clocks[real])
    try:
        yield
    finally:
        for module, real in found:
            setattr(module, real.__name__, real)
