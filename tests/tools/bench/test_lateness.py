"""Results of cyclictest, and windows of lateness."""

from __future__ import annotations

from tools.bench.figures import Decision
from tools.bench.lateness import Pair, figures_of, samples_of

OUTPUT = b"""Using 1 cpus.
# /dev/cpu_dma_latency set to 0us
Thread 0 Interval: 1500
       0:       0:   17666
       0:       1:   13980
T: 0 (24572) P:50 I:1000 C:     10 Min:  12678 Act:   13599 Avg:   13986 Max:   17666
"""


def test_samples_are_the_lines_of_the_thread() -> None:
    assert samples_of(OUTPUT) == [17666, 13980]


def test_p99_is_the_median_of_windows_so_one_stall_does_not_decide() -> None:
    calm = [10_000] * 10
    stalled = [10_000] * 9 + [5_000_000]
    pair = Pair(engine=calm + stalled + calm, cyclictest=calm * 3)
    p50, p99, tails = figures_of("x", [pair], 10)
    assert (p50.value, p99.value) == (1.0, 1.0)
    assert p99.decision is Decision.OK
    assert "max 5000.0 to 10.0 µs" in tails.measured
