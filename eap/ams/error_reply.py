"""Answers of a router itself: why a request went no further."""

from __future__ import annotations

from typing import NamedTuple

from eap.ads.answer import AmsAnswer, response_to
from eap.ams.action import Action, Outcome, Trace
from eap.ams.endpoint import Way
from eap.ams.record import Record, describe
from eap.ams.routes import Route
from eap.ams.transport_table import Outlet
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags

_NO_RETURN = StateFlags.NO_RETURN.value  # plain numbers: enums and operators of flags are slow
_NOTIFICATION = AmsCommand.NOTIFICATION.value


class Refusal(NamedTuple):
    """Why a request goes no further."""

    error: AdsError
    text: str
    route: Route | None = None
    """Whose hop it stopped at, unless here."""
    outcome: Outcome = Outcome.FAILED
    body: bytes = b""
    """Of the answer, where that has the error and not the AMS header."""


def wants_answer(header: AmsHeader) -> bool:
    """Say whether the sender of a request waits for an answer."""
    return not (header.state_flags & _NO_RETURN or header.command == _NOTIFICATION)


class Refuser:
    """Answers with errors, and remembers each."""

    def __init__(self, outlet: Outlet, record: Record) -> None:
        self._outlet = outlet
        self._record = record

    def refuse(
        self, header: AmsHeader, way: Way | None, why: Refusal, at_ns: int, took_ns: int = 0
    ) -> list[Action]:
        """Answer the request with *header*, as it came by *way*; None if nobody waits."""
        text = f"{describe(header, way)}: {why.text}"
        hop = None
        if why.route is not None:
            hop = why.route.hop
            self._record.routes.of(why.route.key, at_ns).fail(why.text)
        self._record.enter(Trace(at_ns, why.outcome, way, hop, header, why.error, took_ns, text))
        if way is None or not wants_answer(header):
            return []
        packet = response_to(header, AmsAnswer(why.body, 0 if why.body else why.error))
        traffic = self._record.connections.of(way, at_ns)
        traffic.fail(why.text)
        traffic.answer(len(packet), took_ns)
        return [self._outlet.reply(way, packet)]

    def drop(
        self, way: Way, header: AmsHeader | None, outcome: Outcome, text: str, at_ns: int
    ) -> list[Action]:
        """Say nothing to anybody, and remember it."""
        subject = str(way) if header is None else describe(header, way)
        text = f"{subject}: {text}"
        self._record.enter(Trace(at_ns, outcome, way, None, header, 0, 0, text))
        return []
