"""Values over time, and their reduction to what a screen can show."""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from math import isnan, nan
from typing import TYPE_CHECKING, NamedTuple

from eap.codec.basetypes import Block, Boolean, Text, WideChar
from eap.recording.rows import TimeWindow, ValueColumn, number_of

if TYPE_CHECKING:
    from eap.recording.export import Selection
    from eap.recording.recording_file import Recording

_GAP = 20
"""Times the usual distance of two values: a longer one is a gap, and the line is interrupted."""


@dataclass(slots=True)
class Series:
    """One value over time; times are nanoseconds, NaN is no value."""

    name: str
    unit: str
    is_step: bool = False
    times: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def add(self, at_ns: int, value: float | None) -> None:
        """Add a value that is newer than all others."""
        self.times.append(at_ns)
        self.values.append(nan if value is None else value)

    def shift(self, by_ns: int) -> None:
        """Move all times."""
        self.times = array("q", (each + by_ns for each in self.times))

    def finite(self) -> Iterator[float]:
        """Yield all values that are finite numbers."""
        # NaN is no value; an infinite one would leave no scale for the others.
        return (each for each in self.values if each - each == 0)

    def usual_step_ns(self) -> int:
        """Return the median distance of two values, of at most 1000 of them."""
        count = min(len(self.times), 1000)
        # The median: an interruption lasts as long as it likes, and must not count.
        steps = sorted(self.times[n + 1] - self.times[n] for n in range(count - 1))
        return steps[len(steps) // 2] if steps else 0


def series_of(column: ValueColumn, label: str = "") -> Series | None:
    """Return an empty series for *column*; None for texts and bytes, which cannot be drawn."""
    if isinstance(column.kind, Block | Text | WideChar):
        return None
    return Series(label + column.name, column.unit, isinstance(column.kind, Boolean))


def read_series(
    recording: Recording, window: TimeWindow, selection: Selection, label: str = ""
) -> list[Series]:
    """Return the numbers among the selected columns, those of one name as one series."""
    found: dict[str, Series] = {}
    plans: dict[int, list[tuple[int, ValueColumn, Series]]] = {}
    for source, chosen in selection.items():
        for position, column in chosen.items():
            series = found.get(column.name) or series_of(column, label)
            if series is not None:
                found[column.name] = series
                plans.setdefault(source, []).append((position, column, series))
    for row in recording.rows(window, plans.keys()):
        for position, column, series in plans[row.source]:
            series.add(row.time_ns, number_of(column.kind, row.values[position]))
    return list(found.values())


class Point(NamedTuple):
    """A point of a line, in the unit of the screen and of the value."""

    x: float
    value: float


def lines(series: Series, from_ns: int, until_ns: int, width: int) -> list[list[Point]]:
    """Return the lines to draw on *width* columns, interrupted where values are missing.

    Of each column the smallest and the largest value are kept, in their order, so that a peak of
    one cycle is seen.
    """
    span = max(until_ns - from_ns, 1)
    gap_ns = _GAP * series.usual_step_ns()
    found: list[list[Point]] = []
    line: list[Point] = []
    last_ns: int | None = None
    column: _Column | None = None
    for at_ns, value in zip(series.times, series.values, strict=True):
        # A line across a gap would show values that nobody measured.
        is_gap = isnan(value) or (last_ns is not None and gap_ns and at_ns - last_ns > gap_ns)
        if is_gap and (line or column):
            found.append(line + (column.points() if column else []))
            line, column = [], None
        if isnan(value):
            continue
        last_ns = at_ns
        x = (at_ns - from_ns) / span * width
        if column is None or int(x) != column.number:
            if column is not None:
                line += column.points()
            column = _Column(int(x), Point(x, value))
        else:
            column.add(Point(x, value))
    if column is not None:
        line += column.points()
    if line:
        found.append(line)
    return [_steps(each) for each in found] if series.is_step else found


class _Column:
    """First, smallest, largest and last point of one column of the screen."""

    def __init__(self, number: int, first: Point) -> None:
        self.number = number
        self._first = self._low = self._high = self._last = first

    def add(self, point: Point) -> None:
        if point.value < self._low.value:
            self._low = point
        if point.value > self._high.value:
            self._high = point
        self._last = point

    def points(self) -> list[Point]:
        kept = {self._first, self._low, self._high, self._last}
        return sorted(kept)


def _steps(line: Sequence[Point]) -> list[Point]:
    """Return *line* with a value held until the next one."""
    found: list[Point] = []
    for point in line:
        # A slope would show a time at which a switch is neither on nor off.
        if found and found[-1].value != point.value:
            found.append(Point(point.x, found[-1].value))
        found.append(point)
    return found
