"""Restart of an FoE transfer that a fault of the bus has interrupted.

FoE has no means to continue in the middle of a file (ETG.1000.6), so a transfer starts again.  A
short silence of the bus needs no restart: the master repeats the message that was under way.
"""

from __future__ import annotations

from collections.abc import Callable

from devicebus.errors import (
    FrameLostError,
    MailboxClosedError,
    MailboxTimeoutError,
    WorkingCounterError,
)
from devicebus.mailbox.conversation import Progress
from eap.errors import EapError

RESTARTS = 3
"""Restarts of one transfer at most."""
RETURN_S = 30.0
"""Limit for the return of the slave after each fault."""
PAUSE_S = 0.5
"""Between two attempts to reach it."""

_OF_THE_BUS = (FrameLostError, MailboxClosedError, WorkingCounterError)


class Restarts:
    """Decision after each fault whether a transfer starts again, and the count of those that did.

    Args:
        progress: Of the transfer; set back when it starts again.
        can_rewind: Returns whether the data can be had from the beginning again.
        clock: Monotonic seconds.

    Attributes:
        count: How often the transfer began again.
        reason: The fault that interrupted it last.
    """

    def __init__(
        self, progress: Progress, can_rewind: Callable[[], bool], clock: Callable[[], float]
    ) -> None:
        self.count = 0
        self.reason = ""
        self._progress = progress
        self._can_rewind = can_rewind
        self._clock = clock
        self._since_s = 0.0

    def allows(self, error: EapError) -> bool:
        """Return whether the transfer is to start again after *error*, and count it if so.

        One that could not even begin, since the slave is not back yet, is tried until RETURN_S.
        """
        # A mailbox timeout before any data may come from the slave; after data the bus is the
        # likelier cause.
        is_under_way = self._progress.done > 0
        is_of_bus = isinstance(error, _OF_THE_BUS)
        if not is_of_bus and not (is_under_way and isinstance(error, MailboxTimeoutError)):
            return False
        if not self._can_rewind():
            return False
        if not is_under_way and self.count:
            return self._clock() < self._since_s + RETURN_S
        if not is_under_way or self.count >= RESTARTS:
            return False
        self.count += 1
        self.reason = str(error)
        self._since_s = self._clock()
        self._progress.done = 0
        return True
