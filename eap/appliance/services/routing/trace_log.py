"""Log lines for what a router did not simply answer: each kind with its level, and not too many."""

from __future__ import annotations

import logging
from collections import OrderedDict

from eap.aoe.action import Outcome, Trace

LINES_PER_S = 5
"""On the average; what is more is only counted."""
BURST = 20
"""Lines at once."""
MAX_CLIENTS = 256
"""Whose refusals are counted apart."""
_LEVELS = {
    Outcome.ANSWERED: logging.INFO,
    Outcome.FAILED: logging.WARNING,
    Outcome.DENIED: logging.WARNING,
    Outcome.LOOP: logging.WARNING,
    Outcome.LATE: logging.DEBUG,
    Outcome.DROPPED: logging.DEBUG,
}

logger = logging.getLogger(__name__)


class _Allowance:
    """How many lines somebody may still cause."""

    def __init__(self) -> None:
        self.missed = 0
        self._left = float(BURST)
        self._at_ns = 0

    def take(self, at_ns: int) -> bool:
        """Say whether there is one more."""
        passed_s = max(0, at_ns - self._at_ns) / 1e9
        self._at_ns = at_ns
        self._left = min(BURST, self._left + passed_s * LINES_PER_S)
        if self._left < 1:
            self.missed += 1
            return False
        self._left -= 1
        return True


class TraceLog:
    """The lines of one *station*.

    Each client that is refused something has an allowance of its own: one that goes on trying
    hides no other.
    """

    def __init__(self, station: str) -> None:
        self._station = station
        self._allowances: OrderedDict[tuple[str, str], _Allowance] = OrderedDict()

    def write(self, trace: Trace) -> None:
        """Say what became of a packet, unless too much was said just now."""
        level = _LEVELS[trace.outcome]
        if not logger.isEnabledFor(level):
            return
        allowance = self._allowance(trace)
        if not allowance.take(trace.at_ns):
            return
        if allowance.missed:
            text = "%s: %d more packets met errors"
            logger.warning(text, self._station, allowance.missed)
            allowance.missed = 0
        logger.log(level, "%s: %s (0x%x)", self._station, trace.text, trace.error_code)

    def _allowance(self, trace: Trace) -> _Allowance:
        whose = "", ""
        if trace.outcome is Outcome.DENIED and trace.came_by is not None:
            whose = trace.came_by.door, trace.came_by.connection.partition(":")[0]
        allowance = self._allowances.pop(whose, None) or _Allowance()
        if len(self._allowances) >= MAX_CLIENTS:
            self._allowances.popitem(last=False)
        self._allowances[whose] = allowance
        return allowance
