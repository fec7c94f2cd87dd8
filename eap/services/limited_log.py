"""Log handler with limits for the lines that peers can cause.

A log line that a peer can cause is written with ``extra=caused_by(cause, source)``.  The handler
writes the first line of a cause at once, counts those that follow, and writes one line with their
number for each period.  All other lines are written as they are: of two states that alternate both
stay visible.
"""

from __future__ import annotations

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable, Hashable
from time import monotonic
from typing import Any, TextIO

from eap.net.limits import Rate, SourceRateLimiter, SourceRates

PERIOD_S = 60.0
"""Time for which lines of one cause are counted before their number is written."""
MAX_CAUSES = 256
MAX_SOURCES = 256
RATES = SourceRates(
    source=Rate(20, 2.0), known=Rate(100, 20.0), new=Rate(100, 20.0), local=Rate(100, 20.0)
)
"""Limits of lines with different causes."""
_FLUSH_S = 5.0


def caused_by(cause: Hashable, source: str) -> dict[str, Any]:
    """Return the *extra* of a log line that a peer caused.

    Args:
        cause: Equal for lines that report the same thing, even if their texts differ.
        source: Peer that caused it, without its port.
    """
    return {"cause": cause, "source": source}


class _Counted:
    """Lines since *since_s* that were not written: their number, and the latest of them."""

    def __init__(self, since_s: float) -> None:
        self.since_s = since_s
        self.count = 0
        self.latest: logging.LogRecord | None = None

    def add(self, record: logging.LogRecord) -> None:
        self.count += 1
        self.latest = record


class LimitedLogHandler(logging.StreamHandler[TextIO]):
    """Log handler that writes lines of one cause once for each period.

    Args:
        stream: Where lines go; None for stderr.
        clock: In seconds.
    """

    def __init__(
        self, stream: TextIO | None = None, *, clock: Callable[[], float] = monotonic
    ) -> None:
        super().__init__(stream)
        self._clock = clock
        self._causes: OrderedDict[Hashable, _Counted] = OrderedDict()
        self._limiter = SourceRateLimiter(RATES, MAX_SOURCES, clock())
        self._left_out: _Counted | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line, or count it."""
        cause: Hashable = getattr(record, "cause", None)
        # Lines that no peer can cause are not limited.
        if cause is None:
            super().emit(record)
            return
        now_s = self._clock()
        self._write_counted(now_s - PERIOD_S, now_s)
        known = self._causes.get(cause)
        if known is not None:
            known.add(record)
        elif self._limiter.take(record.source, now_s):  # type: ignore[attr-defined]
            super().emit(record)
            self._remember(cause, now_s)
        else:
            self._left_out = self._left_out or _Counted(now_s)
            self._left_out.add(record)

    async def serve(self) -> None:
        """Write counts at the end of their periods, until cancelled."""
        while True:
            await asyncio.sleep(_FLUSH_S)
            self.write_counted()

    def write_counted(self) -> None:
        """Write the counts whose periods are over."""
        with self._locked():
            now_s = self._clock()
            self._write_counted(now_s - PERIOD_S, now_s)

    def close(self) -> None:
        """Write all counts: no line follows."""
        with self._locked():
            now_s = self._clock()
            self._write_counted(now_s, now_s)
        super().close()

    def _locked(self) -> Any:
        assert self.lock is not None  # noqa: S101  logging makes one for each handler
        return self.lock

    def _write_counted(self, until_s: float, now_s: float) -> None:
        """Write the counts that began at *until_s* or earlier."""
        while self._causes:
            cause, counted = next(iter(self._causes.items()))
            if counted.since_s > until_s:
                break
            del self._causes[cause]
            if counted.count:
                self._write_repeats(counted, now_s)
                self._remember(cause, now_s)
        left_out = self._left_out
        if left_out is not None and left_out.since_s <= until_s:
            self._left_out = None
            self._write(left_out, f"the last of {left_out.count} lines left out", now_s)

    def _remember(self, cause: Hashable, now_s: float) -> None:
        if len(self._causes) >= MAX_CAUSES:
            _, oldest = self._causes.popitem(last=False)
            self._write_repeats(oldest, now_s)
        self._causes[cause] = _Counted(now_s)

    def _write_repeats(self, counted: _Counted, now_s: float) -> None:
        times = "once" if counted.count == 1 else f"{counted.count} times"
        self._write(counted, f"repeated {times}", now_s)

    def _write(self, counted: _Counted, text: str, now_s: float) -> None:
        latest = counted.latest
        if latest is None:
            return
        seconds = max(1, round(now_s - counted.since_s))
        line = f"{latest.getMessage()}; {text} in {seconds} s"
        super().emit(logging.makeLogRecord(vars(latest) | {"msg": line, "args": ()}))
