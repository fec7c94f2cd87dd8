"""How often something may be done or said: at once, and for long."""

from __future__ import annotations


class Allowance:
    """Room for *burst* at once, which comes back at *per_s* a second.

    Attributes:
        skipped: How often there was none, as its owner counts it.
    """

    def __init__(self, burst: int, per_s: float, now_s: float) -> None:
        self.skipped = 0
        self._burst = burst
        self._per_s = per_s
        self._left = float(burst)
        self._at_s = now_s

    def take(self, now_s: float) -> bool:
        """Say whether there is room for one more, and take it."""
        passed_s = max(0.0, now_s - self._at_s)
        self._at_s = now_s
        self._left = min(self._burst, self._left + passed_s * self._per_s)
        if self._left < 1:
            return False
        self._left -= 1
        return True
