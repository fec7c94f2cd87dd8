"""Past values of the variables of trends, in bounded memory."""

from __future__ import annotations

import math
from array import array
from typing import Any

MAX_POINTS = 1200
"""Pairs of points that are kept of a variable: its least and its largest value of each interval."""
_MIN_INTERVAL_S = 0.1


class VariableHistory:
    """Values of one variable over the last *window_s* seconds.

    Of each interval the least and the largest value are kept, so that a peak of one sample is in a
    trend of a day, too.  A time without a value is a gap.
    """

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s
        self._interval_s = max(window_s / MAX_POINTS, _MIN_INTERVAL_S)
        self._times = array("d")
        self._values = array("d")
        self._began_s = -math.inf
        self._low = self._high = (0.0, math.nan)

    def add(self, time_s: float, value: Any) -> None:
        """Add a value of *time_s*, a gap if it is no number."""
        number = float(value) if isinstance(value, int | float) else math.nan
        if time_s - self._began_s >= self._interval_s or time_s < self._began_s:
            self._close()
            self._began_s = time_s
            self._low = self._high = (time_s, number)
        elif math.isnan(self._low[1]) or number < self._low[1]:
            self._low = (time_s, number)
        if math.isnan(self._high[1]) or number > self._high[1]:
            self._high = (time_s, number)

    def points(self, since_s: float = -math.inf) -> tuple[list[float], list[float | None]]:
        """Return times (Unix) and values since *since_s*; a gap is None."""
        times, values = list(self._times), list(self._values)
        for time_s, value in self._pending():
            times.append(time_s)
            values.append(value)
        newest_s = times[-1] if times else 0.0
        first_s = max(since_s, newest_s - self.window_s)
        start = next((n for n, each in enumerate(times) if each >= first_s), len(times))
        shown = [None if math.isnan(value) else value for value in values[start:]]
        return [round(each, 3) for each in times[start:]], shown

    def _pending(self) -> list[tuple[float, float]]:
        if self._began_s == -math.inf:
            return []
        return sorted({self._low, self._high}) if self._low != self._high else [self._low]

    def _close(self) -> None:
        for time_s, value in self._pending():
            self._times.append(time_s)
            self._values.append(value)
        if len(self._times) > 2 * MAX_POINTS + 200:
            # In pieces: each removal moves the rest.
            del self._times[: -2 * MAX_POINTS], self._values[: -2 * MAX_POINTS]
