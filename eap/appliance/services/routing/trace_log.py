"""Log lines for what a router did not simply answer: each kind with its level, and not too many."""

from __future__ import annotations

import logging
from collections import OrderedDict

from eap.aoe.access import host_of
from eap.aoe.action import Outcome, Trace
from eap.appliance.services.allowance import Allowance

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


class TraceLog:
    """The lines of one *station*.

    Each client that is refused something has an allowance of its own: one that goes on trying
    hides no other.
    """

    def __init__(self, station: str) -> None:
        self._station = station
        self._allowances: OrderedDict[tuple[str, str], Allowance] = OrderedDict()

    def write(self, trace: Trace) -> None:
        """Say what became of a packet, unless too much was said just now."""
        level = _LEVELS[trace.outcome]
        if not logger.isEnabledFor(level):
            return
        allowance = self._allowance(trace)
        if not allowance.take(trace.at_ns / 1e9):
            allowance.skipped += 1
            return
        if allowance.skipped:
            text = "%s: %d more packets met errors"
            logger.warning(text, self._station, allowance.skipped)
            allowance.skipped = 0
        # Results inside an answer are in the text.
        code = f" (0x{trace.error_code:x})" if trace.error_code else ""
        logger.log(level, "%s: %s%s", self._station, trace.text, code)

    def _allowance(self, trace: Trace) -> Allowance:
        whose = "", ""
        if trace.outcome is Outcome.DENIED and trace.came_by is not None:
            whose = trace.came_by.door, host_of(trace.came_by)
        allowance = self._allowances.pop(whose, None)
        allowance = allowance or Allowance(BURST, LINES_PER_S, trace.at_ns / 1e9)
        if len(self._allowances) >= MAX_CLIENTS:
            self._allowances.popitem(last=False)
        self._allowances[whose] = allowance
        return allowance
