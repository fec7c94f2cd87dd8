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


class Figure(msgspec.Struct, frozen=True):
    """One line of the table; *value* is the number behind *measured*, where there is one."""

    name: str
    measured: str
    target: str = ""
    decision: Decision = Decision.REPORTED
    value: float | None = None


class SkippedError(Exception):
    """This machine lacks what a benchmark needs; the message says what."""


def at_least(name: str, value: float, target: float, detail: str = "") -> Figure:
    """Return a ratio that should not be smaller than *target*."""
    decision = Decision.OK if value >= target else Decision.MISSED
    return Figure(name, _with(f"{value:.2f}", detail), f"≥ {target:g}", decision, value)


def at_most(name: str, value: float, target: float, unit: str = "", detail: str = "") -> Figure:
    """Return a figure that should not be larger than *target*."""
    decision = Decision.OK if value <= target else Decision.MISSED
    shown = f"{value:.2f}" if not unit else f"{value:.3g}{unit}"
    return Figure(name, _with(shown, detail), f"≤ {target:g}{unit}", decision, value)


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


def text_table(figures: Sequence[Figure]) -> str:
    """Return *figures* in aligned columns."""
    rows = [("figure", "target", "measured", "result")]
    rows += [(f.name, f.target, f.measured, f.decision.value) for f in figures]
    widths = [max(len(row[column]) for row in rows) for column in range(4)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)) for row in rows]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines)


def markdown_table(figures: Sequence[Figure]) -> str:
    """Return *figures* as a table of Markdown."""
    rows = ["| figure | target | measured | result |", "|---|---|---|---|"]
    rows += [f"| {f.name} | {f.target} | {f.measured} | {f.decision.value} |" for f in figures]
    return "\n".join(rows)


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


def _with(shown: str, detail: str) -> str:
    return f"{shown} ({detail})" if detail else shown
