"""Figures of a bus in a running plant."""

from __future__ import annotations

from typing import Any

from tools.bench.figures import Decision
from tools.bench.plantbus import figures

SEEN: dict[str, Any] = {
    "cpu": 0.2, "overruns": 3, "lateness_us": {"p50": 20, "p99": 50, "max": 900},
    "max_trip_us": 700, "cycles": 5000, "wkc_errors": 0, "lost": 0,
}  # fmt: skip


def test_requests_are_beside_a_run_without_them() -> None:
    busy = SEEN | {"overruns": 1, "wkc_errors": 2, "reads": 400, "octets": 1_500_000}
    found = {figure.name: figure for figure in figures(SEEN, busy)}
    assert found["cycles with a wrong working counter"].decision is Decision.MISSED
    assert found["cycles left out, with and without requests"].measured == "1 and 3"
    assert found["requests meanwhile"].measured == "1.5 MB written, 400 objects read"
