"""Results of benchmarks: figures with their targets, and the tables that show them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from enum import StrEnum
from statistics import median

import msgspec


class Decision(StrEnum):
    """Result of a comparison with a target."""

    OK = "ok"
    MISSED = "missed"
    REPORTED = ""
    """There is no target."""
    SKIPPED = "skipped"


class BarKind(StrEnum):
    """Owner of a bar of a chart."""

    OURS = "ours"
    PEER = "peer"
    LIMIT = "limit"
    """The least that a raw loop or an echo does with the same bytes."""


class Bar(msgspec.Struct, frozen=True):
    """One value in a chart."""

    name: str
    value: float
    kind: BarKind


class Comparison(msgspec.Struct, frozen=True):
    """Values of one quantity side by side, as a chart shows them.

    Attributes:
        bars: Ours first.
        target: Value that ours should reach, in the same unit, if there is one.
    """

    title: str
    unit: str
    bars: tuple[Bar, ...]
    target: float | None = None


class Figure(msgspec.Struct, frozen=True):
    """One line of a table.

    Attributes:
        value: Number behind *measured*, where there is one.
        limit: The machine's own limit, which bounds the figure; a figure with one is among the
            targets of the project.
        comparison: Values behind it, for a chart.
    """

    name: str
    measured: str
    target: str = ""
    decision: Decision = Decision.REPORTED
    value: float | None = None
    limit: str = ""
    comparison: Comparison | None = None

    def compared(
        self, title: str, unit: str, bars: Iterable[Bar], target: float | None = None
    ) -> Figure:
        """Return the figure with the values behind it."""
        return msgspec.structs.replace(
            self, comparison=Comparison(title, unit, tuple(bars), target)
        )


class SkippedError(Exception):
    """This machine lacks what a benchmark needs; the message says what."""


def at_least(
    name: str, value: float, target: float, detail: str = "", *, unit: str = "", limit: str = ""
) -> Figure:
    """Return a figure that should not be smaller than *target*; a ratio without *unit*."""
    decision = Decision.OK if value >= target else Decision.MISSED
    shown = _with(_shown(value, unit), detail)
    return Figure(name, shown, f"≥ {target:g}{unit}", decision, value, limit)


def at_most(
    name: str, value: float, target: float, unit: str = "", detail: str = "", *, limit: str = ""
) -> Figure:
    """Return a figure that should not be larger than *target*; a ratio without *unit*."""
    decision = Decision.OK if value <= target else Decision.MISSED
    shown = _with(_shown(value, unit), detail)
    return Figure(name, shown, f"≤ {target:g}{unit}", decision, value, limit)


def report(name: str, measured: str, value: float | None = None) -> Figure:
    """Return a figure without a target."""
    return Figure(name, measured, value=value)


def skipped(name: str, reason: object) -> Figure:
    """Return the row of a benchmark that could not run."""
    return Figure(name, str(reason), decision=Decision.SKIPPED)


def percentile(values: Sequence[int], share: float) -> int:
    """Return the smallest value that at least *share* of *values* do not exceed."""
    ordered = sorted(values)
    return ordered[max(math.ceil(len(ordered) * share), 1) - 1]


def median_ratio(pairs: Iterable[tuple[float, float]]) -> float:
    """Return the median of ours divided by the reference of the same round."""
    return median(ours / reference for ours, reference in pairs)


def text_table(figures: Sequence[Figure], *, limits: bool = False) -> str:
    """Return *figures* in aligned columns, with that of the limits if wanted."""
    rows = _rows(figures, limits=limits)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)


def markdown_table(figures: Sequence[Figure], *, limits: bool = False) -> str:
    """Return *figures* as a table of Markdown, with the column of the limits if wanted."""
    head, *rows = (f"| {' | '.join(row)} |" for row in _rows(figures, limits=limits))
    return "\n".join([head, "|" + "---|" * (head.count("|") - 1), *rows])


def replace_between(text: str, begin: str, end: str, new: str) -> str:
    """Return *text* with what stands between the lines *begin* and *end* replaced.

    Raises:
        ValueError: one of the two markers is missing.
    """
    head, found, rest = text.partition(begin)
    _, found_end, tail = rest.partition(end)
    if not found or not found_end:
        raise ValueError(f"the markers {begin} and {end} are missing")
    return f"{head}{begin}\n{new}\n{end}{tail}"


def _rows(figures: Sequence[Figure], *, limits: bool) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = [("figure", "target", "measured", "result", "limit")]
    rows += [(f.name, f.target, f.measured, f.decision.value, f.limit) for f in figures]
    return rows if limits else [row[:-1] for row in rows]


def _shown(value: float, unit: str) -> str:
    return f"{value:.3g}{unit}" if unit else f"{value:.2f}"


def _with(shown: str, detail: str) -> str:
    return f"{shown} ({detail})" if detail else shown
