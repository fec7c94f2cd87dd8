"""Comparing two masters: medians of a round, and of those the median ratio."""

from __future__ import annotations

from tools.bench.acyclic import figures
from tools.bench.figures import Decision


def round_of(read_us: int, file_ms: int, scan_ms: int) -> dict[str, list[int]]:
    return {
        "read": [read_us * 1_000 * n for n in (1, 1, 100)],
        "file": [file_ms * 1_000_000],
        "scan": [scan_ms * 1_000_000, scan_ms * 1_000_000],
    }


def test_ratio_is_that_of_the_same_round() -> None:
    ours = [round_of(150, 300, 50), round_of(300, 300, 50), round_of(150, 300, 50)]
    soem = [round_of(100, 100, 50), round_of(200, 100, 50), round_of(10, 100, 50)]
    read, file, scan = figures(ours, soem)
    assert (read.value, file.value, scan.value) == (1.5, 3.0, 1.0)
    assert (read.decision, file.decision) == (Decision.OK, Decision.MISSED)
    assert read.measured == "1.50 (150 to 100 µs)"
