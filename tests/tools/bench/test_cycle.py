"""Figures of a run of cycles, and faults that end it."""

from __future__ import annotations

from typing import Any

import pytest

from tools.bench.cycle import SLAVES, figures
from tools.bench.figures import Decision, Figure

TIMES = {"p50": 20_000, "p99": 50_000, "max": 200_000}


def shown(**busy: int) -> dict[str, Figure]:
    noted: dict[str, Any] = {
        "cycles": 5000, "wkc_errors": 0, "lost": 0, "skipped": 0, "skipped_by_work": 0,
        "unanswered": 0, "cpu": 0.25, "late_ns": TIMES, "trip_ns": TIMES,
    }  # fmt: skip
    answer = {
        "slaves": SLAVES, "reads": 100, "octets": 1_500_000, "errors": ["no"],
        "quiet": noted, "busy": noted | busy,
    }  # fmt: skip
    return {figure.name: figure for figure in figures(answer)}


def test_cycles_skipped_by_master_are_counted_apart() -> None:
    found = shown(skipped=5, skipped_by_work=2)
    assert found["cycles skipped by mailbox work"].value == 2
    assert found["cycles skipped by mailbox work"].decision is Decision.MISSED
    others = "cycles skipped while others had the processor, with and without mailbox traffic"
    assert found[others].measured == "3 and 0"


def test_times_are_in_microseconds() -> None:
    assert shown()["lateness without"].measured == "p50 20 µs, p99 50 µs, max 200 µs"


def test_failed_request_is_reported() -> None:
    found = shown()["requests that failed"]
    assert (found.decision, found.measured) == (Decision.MISSED, "1  (no)")


def test_a_missing_slave_is_no_measurement() -> None:
    with pytest.raises(RuntimeError, match="3 slaves, there are 16"):
        figures({"slaves": 3, "busy": {}, "quiet": {}})
