"""How answers leave a gateway, and what is counted and logged of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TypeAlias

import msgspec

from devicebus.mailbox.counter import next_counter
from eap.aoe.way import Way
from eap.appliance.services.gateway.refusal_log import RefusalLog
from eap.appliance.services.gateway.slave_session import Reply
from eap.appliance.services.gateway.tally import Tally
from eap.codec.mailbox import MailboxHeader, MailboxType, encode_frame, encode_plain_frame
from eap.gateway import dialect
from eap.gateway.ledger import Ledger, Ticket
from eap.gateway.refusal import Reason, refuse

Send: TypeAlias = Callable[[bytes], None]
"""Sends a frame back to who sent a request, now or later."""


class Request(msgspec.Struct, frozen=True):
    """A message of a client; *send* takes whole frames."""

    header: MailboxHeader
    body: bytes
    way: Way
    send: Send
    ticket: Ticket | None = None
    """None if it was not taken."""

    def give_back(self) -> None:
        """Note that it waits no more."""
        if self.ticket is not None:
            self.ticket.give_back()


class Answering:
    """Answers the requests of one gateway.

    Args:
        ledger: Counts errors of clients.
        name: Of the bus port, for log lines.
        is_silent: Whether errors of the gateway itself are kept back.

    Attributes:
        tally: What was answered, by slave and protocol.
    """

    def __init__(self, ledger: Ledger, name: str, *, is_silent: bool) -> None:
        self.tally = Tally()
        self._ledger = ledger
        self._log = RefusalLog(name)
        self._is_silent = is_silent
        self._counter = 0

    def answer(
        self, request: Request, station: int, address: int, replies: Sequence[Reply], took_ns: int
    ) -> None:
        """Answer a request from *address*; it is counted for *station*."""
        reasons = [each.reason for each in replies]
        kind = request.header.type
        self.tally.note(station, kind, reasons, took_ns)
        self._note_refusals(request, kind, reasons)
        if replies and replies[0].is_again:
            self._note_repeated(request.way)
        if address == request.header.address:  # not one of many
            request.give_back()
        for reply in replies:
            if reply.reason is not None and self._is_silent:
                continue
            self.send(request.send, address, reply.type, reply.body, reply.counter)

    def answer_dialect(
        self,
        request: Request,
        kind: MailboxType,
        body: bytes,
        reason: Reason | None,
        took_ns: int,
    ) -> None:
        """Answer a request of the high-nibble dialect; *reason* is why *body* is an error."""
        address = request.header.address
        self.tally.note(address, kind, [reason], took_ns)
        self._note_refusals(request, kind, [reason])
        request.give_back()
        if not (self._is_silent and reason is not None):
            request.send(encode_frame(dialect.encode_header(kind, address), body))

    def refuse(self, request: Request, reason: Reason) -> None:
        """Answer with an error."""
        address, kind = request.header.address, request.header.type
        self.answer(request, address, address, refusals(kind, request.body, reason), 0)

    def send(
        self, send: Send, address: int, kind: MailboxType, body: bytes, counter: int = 0
    ) -> None:
        """Send a message from *address*, with the slave's *counter* or, if that is 0, our own."""
        if not counter:
            counter = self._counter = next_counter(self._counter)
        send(encode_plain_frame(kind, address, counter, body))

    def _note_repeated(self, way: Way) -> None:
        counts = self._ledger.counts_of(way)
        if counts is not None:
            counts.repeated += 1

    def _note_refusals(
        self, request: Request, kind: MailboxType, reasons: Iterable[Reason | None]
    ) -> None:
        """Count what the gateway answers itself, and log it."""
        for reason in reasons:
            if reason is not None:
                break
        else:
            return
        counts = self._ledger.counts_of(request.way)
        if counts is not None:
            counts.errors += 1
        self._log.write(request.way, request.header.address, kind, reason)


def refusals(kind: MailboxType, body: bytes, reason: Reason) -> list[Reply]:
    """Return the error that answers a request."""
    return [Reply(*refuse(kind, body, reason), reason=reason)]
