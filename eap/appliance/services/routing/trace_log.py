"""Log lines for what a router did not simply answer: each kind with its level, and not too many."""

from __future__ import annotations

import logging

from eap.aoe.action import Outcome, Trace

LINES_PER_S = 5
"""On the average; what is more is only counted."""
BURST = 20
"""Lines at once."""
_LEVELS = {
    Outcome.ANSWERED: logging.INFO,
    Outcome.FAILED: logging.WARNING,
    Outcome.DENIED: logging.WARNING,
    Outcome.LOOP: logging.WARNING,
    Outcome.LATE: logging.DEBUG,
    Outcome.DROPPED: logging.DEBUG,
}

logger = logging.getLogger(__name__)


class TraceLog:
    """The lines of one *station*."""

    def __init__(self, station: str) -> None:
        self._station = station
        self._left = float(BURST)
        self._at_ns = 0
        self._missed = 0

    def write(self, trace: Trace) -> None:
        """Say what became of a packet, unless too much was said just now."""
        level = _LEVELS[trace.outcome]
        if not logger.isEnabledFor(level):
            return
        passed_s = max(0, trace.at_ns - self._at_ns) / 1e9
        self._at_ns = trace.at_ns
        self._left = min(BURST, self._left + passed_s * LINES_PER_S)
        if self._left < 1:
            self._missed += 1
            return
        self._left -= 1
        if self._missed:
            logger.warning("%s: %d more packets met errors", self._station, self._missed)
            self._missed = 0
        logger.log(level, "%s: %s (0x%x)", self._station, trace.text, trace.error_code)
