"""The counter of mailbox messages (ETG.1000.4): 1 to 7, and 1 again; 0 detects nothing.

Each side counts its own messages: a reply's counter says nothing about the request.
"""

from __future__ import annotations


def next_counter(counter: int) -> int:
    """Return the counter of the message behind the one with *counter*."""
    return counter % 7 + 1


class CounterWatch:
    """Judges the counters of one sender's messages.

    Attributes:
        repeated: Messages with the counter of the one before, which is what a repeat has.
        gaps: Times that at least one message seems to be missing.
    """

    __slots__ = ("_last", "gaps", "repeated")

    def __init__(self) -> None:
        self.repeated = 0
        self.gaps = 0
        self._last = 0

    def restart(self) -> None:
        """Take any counter next; the counts stay."""
        self._last = 0

    def is_new(self, counter: int) -> bool:
        """Count a message; say whether it is another one than the last."""
        last, self._last = self._last, counter
        if not counter or not last:
            return True
        if counter == last:
            self.repeated += 1
            return False
        if counter != next_counter(last):
            self.gaps += 1
        return True
