"""What a gateway did for each slave and protocol: for status, and for whoever looks for a fault."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason

_MAX_ROWS = 4096
"""Slaves that do not exist have no rows of their own above this."""


class Row:
    """One slave, or the master, in one protocol.

    Attributes:
        requests: All of them.
        answered: By the slave.
        replies: Messages of the slave.
        errors: That the gateway answered itself, by reason.
        last_error: The latest of these.
        total_ns: Time from request to answer, of all that the slave answered.
        slowest_ns: The longest of them.
    """

    __slots__ = (
        "answered",
        "errors",
        "last_error",
        "replies",
        "requests",
        "slowest_ns",
        "total_ns",
    )

    def __init__(self) -> None:
        self.requests = self.answered = self.replies = self.total_ns = self.slowest_ns = 0
        self.errors: dict[Reason, int] = {}
        self.last_error: Reason | None = None

    def note(self, reasons: Sequence[Reason | None], took_ns: int) -> None:
        """Count one request with its answers."""
        self.requests += 1
        before = self.replies
        for reason in reasons:
            if reason is None:
                self.replies += 1
            else:
                self.errors[reason] = self.errors.get(reason, 0) + 1
                self.last_error = reason
        if self.replies > before:
            self.answered += 1
            self.total_ns += took_ns
            if took_ns > self.slowest_ns:  # noqa: PLR1730  max() takes longer
                self.slowest_ns = took_ns


class Tally:
    """All rows of a gateway, by station address (0 is the master) and protocol."""

    def __init__(self) -> None:
        self._rows: dict[tuple[int, MailboxType], Row] = {}

    def note(
        self, station: int, kind: MailboxType, reasons: Sequence[Reason | None], took_ns: int
    ) -> None:
        """Count one request; *reasons* has None for each message that a slave answered with."""
        row = self._rows.get((station, kind))
        if row is None:
            if len(self._rows) >= _MAX_ROWS:
                return
            row = self._rows[station, kind] = Row()
        row.note(reasons, took_ns)

    def report(self) -> list[dict[str, Any]]:
        """Return all rows as plain values."""
        return [
            {
                "address": station,
                "protocol": kind.name,
                "requests": row.requests,
                "replies": row.replies,
                "errors": {reason.name.lower(): count for reason, count in row.errors.items()},
                "last_error": row.last_error.text if row.last_error else "",
                "mean_us": row.total_ns / 1000 / row.answered if row.answered else None,
                "slowest_us": row.slowest_ns / 1000,
            }
            for (station, kind), row in sorted(self._rows.items())
        ]
