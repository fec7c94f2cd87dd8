"""What an engine does between its cycles: it serves descriptors, for a bounded share of the time.

Without the bound somebody who sends without end would leave the cycles what he does not take, and a
process that never sleeps is stopped now and then by a kernel that limits real-time processes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from time import monotonic_ns

from eap.net.ticker import Ticker

WINDOW_NS = 20_000_000
SHARE_NS = 12_000_000
"""Of each window; then descriptors wait for the next one.  Cycles take frames all the while."""


class Arrivals:
    """Waits for cycles and serves *handlers* meanwhile; *ticker* is closed by its owner."""

    def __init__(self, ticker: Ticker, handlers: Mapping[int, Callable[[int], object]]) -> None:
        self._ticker = ticker
        self._handlers = handlers
        self._spent_ns = 0
        self._window_end_ns = 0
        self._is_open = False
        self._open()

    def wait(self, deadline_ns: int) -> bool:
        """Return True once *deadline_ns* has passed, False if something else was done first."""
        if self._is_open:
            if self._ticker.wait(deadline_ns):
                return True
            self._serve()
            return False
        is_due = self._ticker.wait(min(deadline_ns, self._window_end_ns))
        now_ns = monotonic_ns()
        if now_ns >= self._window_end_ns:
            self._open()
        return is_due and now_ns >= deadline_ns

    def _serve(self) -> None:
        begun_ns = monotonic_ns()
        if begun_ns >= self._window_end_ns:
            self._window_end_ns = begun_ns + WINDOW_NS
            self._spent_ns = 0
        for fd in self._ticker.arrivals():
            self._handlers[fd](monotonic_ns())
        self._spent_ns += monotonic_ns() - begun_ns
        if self._spent_ns > SHARE_NS:
            self._close()

    def _open(self) -> None:
        self._is_open = True
        for fd in self._handlers:
            self._ticker.register(fd)

    def _close(self) -> None:
        self._is_open = False
        for fd in self._handlers:
            self._ticker.unregister(fd)
