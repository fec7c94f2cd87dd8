"""What happened in the mailbox of one slave, in numbers."""

from __future__ import annotations

import msgspec

from devicebus.errors import MailboxTimeoutError
from eap.errors import EapError


class MailboxStats(msgspec.Struct, frozen=True, kw_only=True):
    """Counters since the slave is known; times in nanoseconds."""

    sent: int
    received: int
    timeouts: int
    errors: int
    """Requests that ended in any other error."""
    last_error: str
    repeats: int
    """Times that the slave was asked to repeat, because a reply was lost."""
    duplicates: int
    """Messages dropped because they repeat the one before."""
    gaps: int
    """Times that the slave's counter left numbers out."""
    late: int
    """Messages that answered nothing: their requests had timed out."""
    unsolicited: int
    malformed: int
    latency_ns: int
    """Of the last request, from writing it to its reply."""
    mean_latency_ns: int
    max_latency_ns: int


class Tally:
    """Counts; the counters of the wire live where they arise."""

    __slots__ = (
        "answered",
        "errors",
        "last_error",
        "last_ns",
        "late",
        "malformed",
        "max_ns",
        "received",
        "sent",
        "timeouts",
        "total_ns",
        "unsolicited",
    )  # fmt: skip

    def __init__(self) -> None:
        self.sent = self.received = self.timeouts = self.errors = 0
        self.late = self.unsolicited = self.malformed = 0
        self.answered = self.last_ns = self.max_ns = self.total_ns = 0
        self.last_error = ""

    def answer(self, latency_ns: int) -> None:
        """A request was answered."""
        self.answered += 1
        self.last_ns = latency_ns
        self.total_ns += latency_ns
        self.max_ns = max(self.max_ns, latency_ns)

    def fail(self, error: EapError) -> None:
        """A request ended in an error."""
        if isinstance(error, MailboxTimeoutError):
            self.timeouts += 1
        else:
            self.errors += 1
        self.last_error = str(error)

    def stats(self, *, repeats: int, duplicates: int, gaps: int) -> MailboxStats:
        """Return a snapshot, with what was counted elsewhere."""
        return MailboxStats(
            sent=self.sent,
            received=self.received,
            timeouts=self.timeouts,
            errors=self.errors,
            last_error=self.last_error,
            repeats=repeats,
            duplicates=duplicates,
            gaps=gaps,
            late=self.late,
            unsolicited=self.unsolicited,
            malformed=self.malformed,
            latency_ns=self.last_ns,
            mean_latency_ns=self.total_ns // self.answered if self.answered else 0,
            max_latency_ns=self.max_ns,
        )
