"""Decision on the start of a child process: whether it goes on, is slow, or is stuck.

A process that reports one step after the other is waited for without limit.  One that reports
nothing new is stuck after a limit, which doubles with each start that got stuck: where 20 s are too
short, because the machine is slow or full, 40 s or 80 s are not.  A start that succeeds brings the
first limit back.
"""

from __future__ import annotations

from enum import Enum

FIRST_LIMIT_NS = 20_000_000_000
"""Without progress, in the first start and behind one that succeeded."""
LONGEST_LIMIT_NS = 640_000_000_000
FIRST_NOTE_NS = 10_000_000_000
"""From the beginning of a start to the first note that it takes long; the next come ever later."""


class StartEvent(Enum):
    """Outcome of the time that passed."""

    SLOW = "slow"
    """The start takes long, and goes on."""
    STUCK = "stuck"
    """There was no progress for the limit."""


class StartWatch:
    """Starts of one child process.

    Attributes:
        step: The last that it reported; empty when it runs, or is not being started.
        limit_ns: How long it may be without progress.
        has_run: Whether any start succeeded.
        is_stuck: Whether the latest start was given up.
    """

    def __init__(self) -> None:
        self.step = ""
        self.limit_ns = FIRST_LIMIT_NS
        self.has_run = False
        self.is_stuck = False
        self._began_ns: int | None = None
        self._progress_ns = 0
        self._note_ns = 0
        self._waits_for = ""

    def begin(self, now_ns: int) -> None:
        """Take note that the process was started."""
        self._began_ns = self._progress_ns = now_ns
        self._note_ns = now_ns + FIRST_NOTE_NS
        self._waits_for = ""
        self.step = "starting Python"
        self.is_stuck = False

    def advance(self, step: str, now_ns: int, *, waits_for: str = "") -> None:
        """Take note of a step; while it waits for another process, there is no limit."""
        if step != self.step:
            self._progress_ns = now_ns
        self.step = step
        self._waits_for = waits_for

    def release(self, other: str, now_ns: int) -> None:
        """Take note that the process *other* runs: who waited for it goes on."""
        if self._waits_for == other:
            self._waits_for = ""
            self._progress_ns = now_ns

    def succeed(self) -> None:
        """Take note that the process runs."""
        self.end()
        self.has_run = True
        self.limit_ns = FIRST_LIMIT_NS

    def end(self) -> None:
        """Take note that the process ended."""
        self.step = self._waits_for = ""
        self._began_ns = None

    def took_ns(self, now_ns: int) -> int:
        """Return how long the start has taken so far; 0 if there is none."""
        return 0 if self._began_ns is None else now_ns - self._began_ns

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has something to do."""
        if self._began_ns is None or self.is_stuck:
            return None
        return self._note_ns if self._waits_for else min(self._note_ns, self._deadline_ns)

    def handle_timeout(self, now_ns: int) -> StartEvent | None:
        """Return what has become of the start; early calls are harmless."""
        due_ns = self.next_timeout()
        if due_ns is None or now_ns < due_ns:
            return None
        if not self._waits_for and now_ns >= self._deadline_ns:
            self.is_stuck = True
            self.limit_ns = min(2 * self.limit_ns, LONGEST_LIMIT_NS)
            return StartEvent.STUCK
        self._note_ns = now_ns + self.took_ns(now_ns)
        return StartEvent.SLOW

    @property
    def _deadline_ns(self) -> int:
        return self._progress_ns + self.limit_ns
