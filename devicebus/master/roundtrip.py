"""Time-out of a frame that follows the measured round trip (RFC 6298).

RFC 6298 ignores the round trip of whatever was sent twice (Karn's rule), since it cannot tell
which of the two was answered.  Here each sending has an index of its own in its frame, so every
round trip is measured, that of a late frame too: it is what a slow bus is known by.
"""

from __future__ import annotations

FLOOR_NS = 2_000_000
"""Shortest time-out: a wire of 200 slaves takes less than 1 ms, the rest is for this machine."""
CEILING_NS = 1_000_000_000
"""Longest time-out unless the plant file says otherwise."""
BACKOFF_LIMIT_NS = 100_000_000
"""Time-out before anything is measured, and the end of backing off: a slow bus is known by its late
frames, and a silent one is to be noticed soon."""


class RoundTrip:
    """Estimate of the round trip, and the time-out that follows from it.

    Args:
        ceiling_ns: Longest time-out.

    Attributes:
        timeout_ns: How long a frame may be under way that is sent for the first time.
        smoothed_ns: Mean of the latest round trips, 0 before the first.
    """

    __slots__ = (
        "_backoff_limit_ns",
        "_ceiling_ns",
        "_floor_ns",
        "_variation_ns",
        "smoothed_ns",
        "timeout_ns",
    )

    def __init__(self, ceiling_ns: int = CEILING_NS) -> None:
        self._floor_ns = min(FLOOR_NS, ceiling_ns)
        self._ceiling_ns = ceiling_ns
        self._backoff_limit_ns = min(BACKOFF_LIMIT_NS, ceiling_ns)
        self._variation_ns = 0
        self.smoothed_ns = 0
        self.timeout_ns = self._backoff_limit_ns

    def timeout_of(self, number: int, last: int) -> int:
        """Return how long sending *number* of *last* is waited for.

        Each time twice as long, up to BACKOFF_LIMIT_NS; the last one as long as that at least.
        """
        if number == last > 1:
            return max(self.timeout_ns, self._backoff_limit_ns)
        return max(self.timeout_ns, min(self.timeout_ns << number - 1, self._backoff_limit_ns))

    def measure(self, round_trip_ns: int) -> None:
        """Take a round trip into account."""
        smoothed_ns, variation_ns = self.smoothed_ns, self._variation_ns
        if not smoothed_ns:
            smoothed_ns, variation_ns = round_trip_ns, round_trip_ns >> 1
        else:
            difference_ns = round_trip_ns - smoothed_ns
            variation_ns += (abs(difference_ns) - variation_ns) >> 2
            smoothed_ns += difference_ns >> 3
        smoothed_ns = max(smoothed_ns, 1)
        timeout_ns = smoothed_ns + 4 * variation_ns
        # Called for each frame: comparisons cost half of what max() and min() do.
        if timeout_ns < self._floor_ns:
            timeout_ns = self._floor_ns
        elif timeout_ns > self._ceiling_ns:
            timeout_ns = self._ceiling_ns
        self.smoothed_ns, self._variation_ns = smoothed_ns, variation_ns
        self.timeout_ns = timeout_ns
