"""Error replies of a router to requests that it cannot forward or deliver."""

from __future__ import annotations

from typing import NamedTuple

from eap.ams.record import Outcome, Record, Trace, describe
from eap.ams.routes import Route
from eap.ams.transport_table import Action, TransportTable
from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer, AmsHeader, response_to
from eap.ids import Endpoint


class RoutingError(NamedTuple):
    """Reason a request is not forwarded or delivered."""

    error: AdsError
    text: str
    route: Route | None = None
    """Route whose hop failed; None for this router."""
    outcome: Outcome = Outcome.FAILED
    body: bytes = b""
    """Body of the reply, where that carries the error and not the AMS header."""


class ErrorReplier:
    """Replies with errors, and records each."""

    def __init__(self, transports: TransportTable, record: Record) -> None:
        self._transports = transports
        self._record = record

    def reply_error(
        self,
        header: AmsHeader,
        endpoint: Endpoint | None,
        why: RoutingError,
        at_ns: int,
        took_ns: int = 0,
    ) -> list[Action]:
        """Reply to a request at *endpoint*, None if its client is gone; record it."""
        text = f"{describe(header, endpoint)}: {why.text}"
        hop = None
        if why.route is not None:
            hop = why.route.hop
            self._record.routes.of(why.route.key, at_ns).add_error(why.text, at_ns)
        self._record.add(Trace(at_ns, why.outcome, endpoint, hop, header, why.error, took_ns, text))
        if endpoint is None or not header.wants_answer:
            return []
        packet = response_to(header, AmsAnswer(why.body, 0 if why.body else why.error))
        traffic = self._record.connections.of(endpoint, at_ns)
        traffic.add_error(why.text, at_ns)
        traffic.add_answer(len(packet), took_ns)
        return [self._transports.reply(endpoint, packet)]

    def drop(
        self, endpoint: Endpoint, header: AmsHeader | None, outcome: Outcome, text: str, at_ns: int
    ) -> list[Action]:
        """Record a packet that is dropped without a reply."""
        subject = str(endpoint) if header is None else describe(header, endpoint)
        text = f"{subject}: {text}"
        self._record.add(Trace(at_ns, outcome, endpoint, None, header, 0, 0, text))
        return []
