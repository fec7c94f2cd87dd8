"""Faults of a running plant: what is said of several tries."""

from __future__ import annotations

from tools.bench.recovery import FAULT_MS, Times, figure

MS = 1_000_000


def test_median_and_longest_are_reported() -> None:
    times = [Times(2 * MS, 30 * MS), Times(9 * MS, 50 * MS), Times(3 * MS, 31 * MS)]
    found = figure("no power", times)
    assert found.name == f"no power for {FAULT_MS} ms"
    assert found.measured == (
        "median 31 ms, longest 50 ms after its end (seen within 9 ms)"
    )  # fmt: skip
