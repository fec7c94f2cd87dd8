"""Charts as lines and texts, for every kind of picture: a panel a unit, one axis of time."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from math import ceil, floor, log10
from typing import NamedTuple

from eap.recording.series import Point, Series, lines

_NS = 1_000_000_000
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d00", "#7f7f7f")
"""Colours that people with colour blindness can tell apart (Okabe and Ito), and two more."""
_STEPS_S = (
    1e-6, 2e-6, 5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05,
    0.1, 0.2, 0.5, 1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600,
    43200, 86400,
)  # fmt: skip


class AxisTick(NamedTuple):
    """A mark on an axis."""

    at: float
    text: str


class ChartPanel(NamedTuple):
    """Series of one unit, and the range of their values."""

    unit: str
    series: list[Series]
    low: float
    high: float


class TimeAxis(NamedTuple):
    """Range of times in nanoseconds; of several recordings it counts from their begins."""

    from_ns: int
    until_ns: int
    is_relative: bool


def panels_of(series: Iterable[Series]) -> list[ChartPanel]:
    """Return a panel for each unit, and one for truth values, with room around the values."""
    by_unit: dict[tuple[str, bool], list[Series]] = {}
    for each in series:
        # Values of different units would flatten each other.
        by_unit.setdefault((each.unit, each.is_step), []).append(each)
    found = []
    for (unit, _), members in by_unit.items():
        low = min((value for each in members for value in each.finite()), default=0.0)
        high = max((value for each in members for value in each.finite()), default=1.0)
        # A constant has room around it, too.
        room = (high - low) * 0.05 or abs(high) * 0.1 or 1.0
        found.append(ChartPanel(unit, members, low - room, high + room))
    return found


def time_axis(series: Sequence[Series], *, is_relative: bool) -> TimeAxis | None:
    """Return the range of all times; None if there is no value."""
    ends = [(each.times[0], each.times[-1]) for each in series if each.times]
    if not ends:
        return None
    first, last = min(low for low, _ in ends), max(high for _, high in ends)
    # A single moment has a length, too: times are divided by it.
    return TimeAxis(first, max(last, first + 1), is_relative)


def value_ticks(low: float, high: float, count: int) -> list[AxisTick]:
    """Return about *count* round values between *low* and *high*."""
    step = _round_step((high - low) / max(count, 1))
    # A margin, because 0.3 / 0.1 is below 3.
    first, last = ceil(low / step - 1e-6), floor(high / step + 1e-6)
    digits = max(0, -floor(log10(step)))
    ticks = []
    for number in range(first, last + 1):
        at = number * step
        is_plain = step >= 1e-4 and abs(at) < 1e7
        ticks.append(AxisTick(at, f"{at:.{digits}f}" if is_plain else f"{at:.3g}"))
    return ticks


def _round_step(step: float) -> float:
    power = 10.0 ** floor(log10(step))
    return next(factor * power for factor in (1, 2, 5, 10) if factor * power >= step * 0.999)


def time_ticks(axis: TimeAxis, count: int) -> list[AxisTick]:
    """Return about *count* round times, in nanoseconds, with local times or seconds as texts."""
    span_s = (axis.until_ns - axis.from_ns) / _NS
    step_s = next((each for each in _STEPS_S if each >= span_s / max(count, 1)), _STEPS_S[-1])
    step_ns = max(1, round(step_s * _NS))
    # Local midnight is round, not that of UTC.
    zone_ns = 0 if axis.is_relative else _zone_ns(axis.from_ns)
    first = -(-(axis.from_ns + zone_ns) // step_ns)
    last = (axis.until_ns + zone_ns) // step_ns
    times = [number * step_ns - zone_ns for number in range(first, last + 1)]
    return [AxisTick(at, _time_text(at, step_s, axis)) for at in times]


def _zone_ns(at_ns: int) -> int:
    offset = datetime.fromtimestamp(at_ns // _NS, UTC).astimezone().utcoffset()
    return 0 if offset is None else round(offset.total_seconds()) * _NS


def _time_text(at_ns: int, step_s: float, axis: TimeAxis) -> str:
    digits = max(0, -floor(log10(step_s))) if step_s < 1 else 0
    if axis.is_relative:
        return f"{at_ns / _NS:.{digits}f} s"
    at = datetime.fromtimestamp(at_ns // _NS, UTC).astimezone()
    fraction = f"{at_ns % _NS:09}"[:digits]
    if step_s >= 86400:
        return f"{at:%d.%m.}"
    return f"{at:%H:%M:%S}.{fraction}" if digits else f"{at:%H:%M:%S}"


class ChartLine(NamedTuple):
    """A straight line; *kind* is ``grid`` or ``axis``."""

    kind: str
    x1: float
    y1: float
    x2: float
    y2: float


class ChartText(NamedTuple):
    """A text at its base line; *anchor* is ``start``, ``middle`` or ``end``.

    *color* is the number of a series.
    """

    x: float
    y: float
    text: str
    anchor: str = "start"
    color: int | None = None


class ChartPath(NamedTuple):
    """Connected points of a series."""

    points: list[tuple[float, float]]
    color: int


class Drawing(NamedTuple):
    """A picture of some size in pixels."""

    width: int
    height: int
    lines: list[ChartLine]
    texts: list[ChartText]
    paths: list[ChartPath]


_LEFT, _RIGHT, _TOP, _BOTTOM, _LEGEND = 72, 16, 34, 30, 20
LETTER = 7
"""Width of a letter, about."""


def draw(title: str, series: Sequence[Series], axis: TimeAxis, width: int, height: int) -> Drawing:
    """Return the chart of *series*."""
    panels = panels_of(series)
    drawing = Drawing(width, height, [], [ChartText(_LEFT, 20, title)], [])
    numbers = {id(each): number for number, each in enumerate(series)}
    room = (height - _TOP - _BOTTOM) / len(panels)
    ticks = time_ticks(axis, (width - _LEFT - _RIGHT) // 110)
    for number, panel in enumerate(panels):
        top = _TOP + number * room + _LEGEND
        bottom = _TOP + (number + 1) * room - 8
        _draw_panel(drawing, panel, axis, ticks, top, bottom, numbers)
    for tick in ticks:
        x = _x(tick.at, axis, width)
        drawing.texts.append(ChartText(x, height - 12, tick.text, "middle"))
    return drawing


def _x(at_ns: float, axis: TimeAxis, width: int) -> float:
    share = (at_ns - axis.from_ns) / (axis.until_ns - axis.from_ns)
    return _LEFT + share * (width - _LEFT - _RIGHT)


def _draw_panel(
    drawing: Drawing,
    panel: ChartPanel,
    axis: TimeAxis,
    ticks: Sequence[AxisTick],
    top: float,
    bottom: float,
    numbers: dict[int, int],
) -> None:
    right = drawing.width - _RIGHT

    def y_of(value: float) -> float:
        # Infinities end at the edge.
        share = (value - panel.low) / (panel.high - panel.low)
        return bottom - min(max(share, 0.0), 1.0) * (bottom - top)

    for tick in value_ticks(panel.low, panel.high, max(2, int((bottom - top) / 40))):
        y = y_of(tick.at)
        drawing.lines.append(ChartLine("grid", _LEFT, y, right, y))
        drawing.texts.append(ChartText(_LEFT - 8, y + 4, tick.text, "end"))
    for tick in ticks:
        x = _x(tick.at, axis, drawing.width)
        drawing.lines.append(ChartLine("grid", x, top, x, bottom))
    drawing.lines.append(ChartLine("axis", _LEFT, bottom, right, bottom))
    drawing.lines.append(ChartLine("axis", _LEFT, top, _LEFT, bottom))
    drawing.texts.append(ChartText(_LEFT - 8, top - 7, panel.unit, "end"))
    x = float(_LEFT)
    inner = right - _LEFT
    for place, series in enumerate(panel.series):
        number = numbers[id(series)]
        end = x + (len(series.name) + 2) * LETTER
        if end <= right:
            drawing.texts.append(ChartText(x, top - 7, series.name, "start", number))
        elif x < right:
            more = f"… {len(panel.series) - place} more"
            drawing.texts.append(ChartText(right, top - 7, more, "end"))
        x = end if end <= right else float(right)
        for line in lines(series, axis.from_ns, axis.until_ns, inner):
            points = [(_LEFT + point.x, y_of(point.value)) for point in line]
            if len(points) == 1:
                # A lone value is a short line.
                points.append((points[0][0] + 1, points[0][1]))
            drawing.paths.append(ChartPath(points, number))


def braille(
    series: Sequence[Series], panel: ChartPanel, axis: TimeAxis, width: int, height: int
) -> list[list[tuple[str, int | None]]]:
    """Return *height* rows of *width* characters, each with the number of its series.

    A character of braille has two columns and four rows of dots (Unicode, U+2800).
    """
    dots = [[0] * width for _ in range(height)]
    owners: list[list[int | None]] = [[None] * width for _ in range(height)]
    numbers = {id(each): number for number, each in enumerate(series)}
    for each in panel.series:
        for line in lines(each, axis.from_ns, axis.until_ns, 2 * width - 1):
            for x, y in _dots(line, panel, 4 * height - 1):
                row, column = y // 4, min(x, 2 * width - 1) // 2
                dots[row][column] |= _DOTS[y % 4][x % 2]
                owners[row][column] = numbers[id(each)]
    return [
        [(chr(0x2800 + bits) if bits else " ", owner) for bits, owner in zip(row, own, strict=True)]
        for row, own in zip(dots, owners, strict=True)
    ]


_DOTS = ((0x01, 0x08), (0x02, 0x10), (0x04, 0x20), (0x40, 0x80))
"""Bits of the dots, by row and column."""


def _dots(line: Sequence[Point], panel: ChartPanel, bottom: int) -> Iterable[tuple[int, int]]:
    """Yield the dots of a line, with those between its points."""
    last: tuple[int, int] | None = None
    for point in line:
        share = (point.value - panel.low) / (panel.high - panel.low)
        x, y = int(point.x), bottom - round(min(max(share, 0.0), 1.0) * bottom)
        if last is None:
            yield x, y
        else:
            count = max(abs(x - last[0]), abs(y - last[1]), 1)
            # Without gaps, however steep the line is.
            for step in range(1, count + 1):
                yield (
                    last[0] + (x - last[0]) * step // count,
                    last[1] + (y - last[1]) * step // count,
                )
        last = x, y
