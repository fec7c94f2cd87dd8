"""How long to wait before something that failed is tried again."""

from __future__ import annotations

from random import uniform


class Backoff:
    """Waits that grow twofold up to a limit, each shortened by chance.

    Those that lost the same peer at the same moment do not come back at the same moment.

    Args:
        first_s: The longest that the first wait may be.
        longest_s: The limit.
    """

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_s = first_s
        self._longest_s = longest_s
        self._next_s = first_s

    def next_s(self) -> float:
        """Return the next wait in seconds."""
        wait_s = self._next_s
        self._next_s = min(2 * wait_s, self._longest_s)
        return uniform(wait_s / 2, wait_s)  # noqa: S311  to spread waits, no secret

    def reset(self) -> None:
        """Begin anew: it worked."""
        self._next_s = self._first_s
