"""Samples of a time, collected without making anything, and what they say."""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import Any

from tools.bench.figures import percentile


class Latencies:
    """Nanoseconds, as many as fit; the first few are left out: they find cold caches."""

    CAPACITY = 200_000
    SKIPPED = 50

    def __init__(self) -> None:
        self._values = array("q", bytes(8 * self.CAPACITY))
        self._count = 0

    def enter(self, value_ns: int) -> None:
        """Add one sample."""
        if self._count < self.CAPACITY:
            self._values[self._count] = value_ns
            self._count += 1

    def values(self) -> list[int]:
        """Return all samples but the first few, in the order of their arrival."""
        return self._values[self.SKIPPED : self._count].tolist()

    def summary(self) -> dict[str, Any]:
        """Return the number of samples and their distribution."""
        return summary(self.values())


def summary(values: Sequence[int]) -> dict[str, Any]:
    """Return the number of *values* and their distribution, in their unit."""
    return {
        "count": len(values),
        "p50": percentile(values, 0.5),
        "p99": percentile(values, 0.99),
        "p99.9": percentile(values, 0.999),
        "max": max(values),
    }
