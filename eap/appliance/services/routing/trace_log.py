"""Log lines for what a router did not simply answer, with the cause of each."""

from __future__ import annotations

import logging
from collections.abc import Hashable

from eap.aoe.access import host_of
from eap.aoe.action import Outcome, Trace
from eap.aoe.record import reason_of
from eap.appliance.services.log_limits import caused_by

_LEVELS = {
    Outcome.ANSWERED: logging.INFO,
    Outcome.FAILED: logging.WARNING,
    Outcome.DENIED: logging.WARNING,
    Outcome.LOOP: logging.WARNING,
    Outcome.LATE: logging.DEBUG,
    Outcome.DROPPED: logging.DEBUG,
    Outcome.INTERRUPTED: logging.WARNING,
    Outcome.RESTORED: logging.INFO,
}

logger = logging.getLogger(__name__)


class TraceLog:
    """The lines of one *station*."""

    def __init__(self, station: str) -> None:
        self._station = station

    def write(self, trace: Trace) -> None:
        """Log what became of a packet."""
        level = _LEVELS[trace.outcome]
        if not logger.isEnabledFor(level):
            return
        host = "" if trace.came_by is None else host_of(trace.came_by)
        door = "" if trace.came_by is None else trace.came_by.door
        # Results inside an answer are in the text.
        code = f" (0x{trace.error_code:x})" if trace.error_code else ""
        extra = caused_by((self._station, *_cause(trace, host)), f"{self._station} {door} {host}")
        logger.log(level, "%s: %s%s", self._station, trace.text, code, extra=extra)


def _cause(trace: Trace, host: str) -> tuple[Hashable, ...]:
    """Return what is equal for packets that met the same obstacle.

    A hop that is down is one cause, whatever is asked by it, and by whom.  Elsewhere clients and
    targets are told apart, and connections and AMS ports of clients are not.
    """
    reason = reason_of(trace)
    if trace.outcome is Outcome.FAILED and trace.hop is not None:
        return trace.outcome, trace.hop, trace.error_code, reason
    header = trace.header
    what = None if header is None else (header.target, header.target_port, header.command)
    return trace.outcome, what, host, trace.error_code, reason
