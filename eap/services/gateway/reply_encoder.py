"""Answers of a gateway as frames, with their statistics and the log lines of errors."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, TypeAlias

import msgspec

from devicebus.mailbox.conversation import next_counter
from eap.ams.access import host_of
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_frame, encode_plain_frame
from eap.gateway import dialect
from eap.gateway.error_table import Cause
from eap.gateway.request_tracker import RequestTracker, Ticket
from eap.gateway.requests import address_text
from eap.ids import Endpoint
from eap.services.gateway.sessions import GatewayReply, error_replies
from eap.services.limited_log import caused_by

Send: TypeAlias = Callable[[bytes], None]
"""Sends a frame back to the client of a request, now or later."""
_ADDRESSES = 1 << 16
_MAX_ROWS = 4096
"""Slaves that do not exist have no rows of their own above this."""
_LOGGED = frozenset(
    (
        Cause.DENIED,
        Cause.NOT_RECORDED,
        Cause.CROWDED,
        Cause.TOO_FAST,
        Cause.TIMEOUT,
        Cause.BUS_DOWN,
        Cause.UNREACHABLE,
    )
)
"""Reasons that an operator may want to act on; the others are between client and slave."""
_REFUSALS = frozenset((Cause.DENIED, Cause.NOT_RECORDED, Cause.CROWDED, Cause.TOO_FAST))
"""Those by which the gateway itself decides; otherwise the request was tried, and failed."""

logger = logging.getLogger(__name__)


class _StatisticsRow:
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
        self.errors: dict[Cause, int] = {}
        self.last_error: Cause | None = None

    def count(self, reasons: Sequence[Cause | None], took_ns: int) -> None:
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


class GatewayStatistics:
    """All rows of a gateway, by station address (0 is the master) and protocol."""

    def __init__(self) -> None:
        self._rows: dict[tuple[int, MailboxType], _StatisticsRow] = {}

    def count(
        self, station: int, kind: MailboxType, reasons: Sequence[Cause | None], took_ns: int
    ) -> None:
        """Count one request; *reasons* has None for each message that a slave answered with."""
        row = self._rows.get((station, kind))
        if row is None:
            # Addresses are free to invent; the table is not.
            if len(self._rows) >= _MAX_ROWS:
                return
            row = self._rows[station, kind] = _StatisticsRow()
        row.count(reasons, took_ns)

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


class ErrorLog:
    """The lines of one gateway.

    Args:
        name: Of the bus port.
        names: Of remote slaves, by virtual address.
        answer_s: Limit for an answer.
    """

    def __init__(
        self, name: str, names: Mapping[int, str] | None = None, answer_s: float = 0.0
    ) -> None:
        self._name = name
        self._names = names or {}
        self.answer_ms = round(answer_s * 1000)

    def write(
        self,
        endpoint: Endpoint,
        address: int,
        kind: MailboxType,
        reason: Cause,
        *,
        is_overdue: bool = False,
    ) -> None:
        """Log that a request was refused or failed; *is_overdue* as GatewayReply has it."""
        if reason not in _LOGGED:
            return
        host = host_of(endpoint)
        cause = self._name, endpoint.transport, host, address, kind, reason
        name = self._names.get(address, "")
        is_own_limit = is_overdue and reason is Cause.TIMEOUT
        limit = f" (answer_ms {self.answer_ms})" if is_own_limit else ""
        logger.warning(
            "gateway %s: %s of %s (%s) to address %s%s %s: %s%s",
            self._name, kind.name, endpoint.connection, endpoint.transport, address_text(address),
            f" ({name})" if name else "", "refused" if reason in _REFUSALS else "failed",
            reason.text, limit,
            extra=caused_by(cause, f"{self._name} {endpoint.transport} {host}"),
        )  # fmt: skip


class GatewayRequest(msgspec.Struct, frozen=True):
    """A message of a client; *send* takes whole frames."""

    header: MailboxHeader
    body: bytes
    endpoint: Endpoint
    send: Send
    ticket: Ticket | None = None
    """None if it was not taken."""

    def release(self) -> None:
        """Note that it waits no more."""
        if self.ticket is not None:
            self.ticket.release()


class ReplyEncoder:
    """Answers the requests of one gateway.

    Args:
        tracker: Counts errors of clients.
        log: Lines of refusals.
        is_silent: Whether errors of the gateway itself are kept back.

    Attributes:
        statistics: Requests and answers by slave and protocol.
    """

    def __init__(self, tracker: RequestTracker, log: ErrorLog, *, is_silent: bool) -> None:
        self.statistics = GatewayStatistics()
        self._tracker = tracker
        self._log = log
        self._is_silent = is_silent
        self._counters = bytearray(_ADDRESSES)

    def change(self, log: ErrorLog, *, is_silent: bool) -> None:
        """Go on with other settings; the arguments are those of the class."""
        self._log = log
        self._is_silent = is_silent

    def answer(
        self,
        request: GatewayRequest,
        station: int,
        address: int,
        replies: Sequence[GatewayReply],
        took_ns: int,
    ) -> None:
        """Answer a request from *address*; it is counted for *station*."""
        # Released before the answer goes out: the client may send the same bytes anew at once.
        if address == request.header.address:  # not one of many
            request.release()
        for reply in replies:
            if reply.reason is not None and self._is_silent:
                continue
            self.send(request.send, address, reply.type, reply.body)
        # Counted behind the answer, while it is on its way.
        reasons = [each.reason for each in replies]
        kind = request.header.type
        self.statistics.count(station, kind, reasons, took_ns)
        is_overdue = any(each.is_overdue for each in replies)
        self._count_errors(request, kind, reasons, is_overdue=is_overdue)
        if replies and replies[0].is_repeat:
            self._count_repeat(request.endpoint)

    def answer_dialect(
        self,
        request: GatewayRequest,
        kind: MailboxType,
        body: bytes,
        reason: Cause | None,
        took_ns: int,
    ) -> None:
        """Answer a request of the high-nibble dialect; *reason* is why *body* is an error."""
        address = request.header.address
        self.statistics.count(address, kind, [reason], took_ns)
        is_overdue = took_ns >= self._log.answer_ms * 1_000_000
        self._count_errors(request, kind, [reason], is_overdue=is_overdue)
        request.release()
        if not (self._is_silent and reason is not None):
            request.send(encode_frame(dialect.encode_header(kind, address), body))

    def reply_error(self, request: GatewayRequest, reason: Cause) -> None:
        """Answer with an error."""
        address, kind = request.header.address, request.header.type
        self.answer(request, address, address, error_replies(kind, request.body, reason), 0)

    def send(self, send: Send, address: int, kind: MailboxType, body: bytes) -> None:
        """Send a message from *address*, counted as those of one slave are."""
        # Answers of the slave and of the gateway mix, so the slave's own counter cannot be passed
        # on.
        counter = self._counters[address] = next_counter(self._counters[address])
        send(encode_plain_frame(kind, address, counter, body))

    def _count_repeat(self, endpoint: Endpoint) -> None:
        counts = self._tracker.counts_of(endpoint)
        if counts is not None:
            counts.repeated += 1

    def _count_errors(
        self,
        request: GatewayRequest,
        kind: MailboxType,
        reasons: Iterable[Cause | None],
        *,
        is_overdue: bool,
    ) -> None:
        """Count and log errors of the gateway itself."""
        for reason in reasons:
            if reason is not None:
                break
        else:
            return
        counts = self._tracker.counts_of(request.endpoint)
        if counts is not None:
            counts.errors += 1
        address = request.header.address
        self._log.write(request.endpoint, address, kind, reason, is_overdue=is_overdue)
