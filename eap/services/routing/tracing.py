"""The way to an AMS address, hop by hop: each router is asked where it passes requests on to.

A question for a router further on is handed on by those before it, so nobody needs routes to the
routers between.  What is not one of ours answers with an error, and what is behind it is not seen.
"""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic_ns
from typing import NamedTuple, Protocol

from msgspec.structs import replace

from eap.ads.answer import AmsAnswer
from eap.ads.endpoint import Endpoint
from eap.ads.operation import Operation, OperationOutcome, ReadState, ReadWrite
from eap.ads.query import decode_outcome, encode_query
from eap.ams.hop_report import (
    MAX_FURTHER,
    MAX_REPORT,
    HopQuestion,
    HopReport,
    decode_report,
    report_of,
)
from eap.ams.report import Location
from eap.ams.spec import TransportKind
from eap.codec.ads import AdsError, AdsStates, IndexGroup
from eap.codec.ams import SYSTEM_PORT, AmsHeader
from eap.errors import CodecError
from eap.ids import NetId

HERE = Endpoint(TransportKind.LOCAL, "trace")
TARGET_PATIENCE_S = 5.0
"""For the target itself: a router gives up before."""
SUSPECT_PATIENCE_S = 2.0
"""For a target behind a router that said nothing."""
_PATIENCE_S = 1.0
_MORE_S = 0.25
"""For each router that hands a question on: who is nearer waits longer."""
_ON_THE_WAY = frozenset(
    (
        AdsError.TARGET_MACHINE,
        AdsError.TARGET_PORT,
        AdsError.HOST_UNREACHABLE,
        AdsError.MAILBOX_FULL,
        AdsError.TIMEOUT,
        AdsError.ACCESS_DENIED,
    )
)
"""What is not said by the target."""
_NO_ANSWER = frozenset((AdsError.TARGET_MACHINE, AdsError.HOST_UNREACHABLE, AdsError.TIMEOUT))
"""What is not said by the router that was asked."""


class TracedStation(Protocol):
    """A router, as tracing and scanning need it."""

    @property
    def name(self) -> str:
        """Of its station."""

    @property
    def net_id(self) -> NetId:
        """Its own."""

    def locate(self, header: AmsHeader, endpoint: Endpoint) -> Location:
        """Say where a request would go that came by *endpoint*."""

    async def ask(
        self, target: NetId, target_port: int, command: int, body: bytes = b"", *, timeout_s: float
    ) -> AmsAnswer:
        """Ask whoever has *target*, near or far."""


class Hop(NamedTuple):
    """One router on the way.

    *took_ns* is how long it took to hear of it, *is_opaque* says that it tells nothing.
    """

    report: HopReport
    took_ns: int
    is_opaque: bool = False


class Traced(NamedTuple):
    """A way.

    *answer* is what the target says to ReadState, None if nobody asked it, for the way ends before.
    *why* says why there is no answer, and begins with the hop that it is about; empty if there is.
    """

    hops: tuple[Hop, ...]
    answer: OperationOutcome | None
    took_ns: int
    why: str

    @property
    def states(self) -> AdsStates | None:
        """The states of the target."""
        if self.answer is None or self.answer.result:
            return None
        try:
            return AdsStates.decode(self.answer.data)
        except CodecError:
            return None


async def ask_one(
    station: TracedStation,
    target: NetId,
    port: int,
    operation: Operation,
    timeout_s: float,
) -> OperationOutcome:
    """Return how one operation came out."""
    command, body = encode_query(operation)
    answer = await station.ask(target, port, command, body, timeout_s=timeout_s)
    return decode_outcome(command, answer.error_code, answer.data)


async def answer_question(
    station: TracedStation, question: HopQuestion, endpoint: Endpoint, source: NetId
) -> HopReport:
    """Return what a router says of an address, or what the routers behind it do.

    Args:
        station: Whose router it is.
        question: What somebody wants to know.
        endpoint: That the question came by.
        source: NetID of who asks.
    """
    header = AmsHeader(question.target, question.port, source, 0, 0)
    location = station.locate(header, endpoint)
    report = report_of(station.name, station.net_id, question.target, location, monotonic_ns())
    if not question.further or report.is_here or report.why or not report.next_net_id:
        return report
    further = min(question.further, MAX_FURTHER) - 1
    onward = HopQuestion(NetId.parse(report.target), question.port, further)
    asked = ReadWrite(IndexGroup.WHEREABOUTS, 0, MAX_REPORT, onward.encode())
    next_router = NetId.parse(report.next_net_id)
    patience_s = _PATIENCE_S + _MORE_S * further
    outcome = await ask_one(station, next_router, SYSTEM_PORT, asked, patience_s)
    if outcome.result:
        return replace(report, error=outcome.result)
    try:
        return decode_report(outcome.data)
    except CodecError:
        return replace(report, error=AdsError.SERVICE)


async def trace(
    station: TracedStation, target: NetId, port: int, *, clock: Callable[[], int] = monotonic_ns
) -> Traced:
    """Follow the way from *station* to *target*, and ask that for its state."""
    hops, why = await _follow(station, target, port, clock)
    last = hops[-1]
    if why and not last.is_opaque:
        return Traced(tuple(hops), None, 0, why)
    # Who does not answer a question that is ours alone may pass requests on all the same.
    patience_s = SUSPECT_PATIENCE_S if why else TARGET_PATIENCE_S
    began_ns = clock()
    answer = await ask_one(station, target, port, ReadState(), patience_s)
    took_ns = clock() - began_ns
    if answer.result not in _ON_THE_WAY:
        return Traced(tuple(hops), answer, took_ns, "")
    if why:
        return Traced(tuple(hops), None, 0, why)
    where = last.report.station + ("" if last.report.is_here else " or behind it")
    why = f"{where}: {AdsError.words_of(answer.result)}"
    return Traced(tuple(hops), answer, took_ns, why)


async def find_fault(station: TracedStation, target: NetId, port: int) -> str:
    """Return at which router the way to *target* ends, and why; empty if it ends at none.

    For a request that was not answered: the router that refused it may not know which one of those
    behind it is the cause.
    """
    _, why = await _follow(station, target, port, monotonic_ns)
    return why


async def _follow(
    station: TracedStation, target: NetId, port: int, clock: Callable[[], int]
) -> tuple[list[Hop], str]:
    """Return the routers on the way, and why it goes no further than the last one."""
    hops: list[Hop] = []
    why = ""
    while not why and (not hops or _goes_on(hops[-1])):
        began_ns = clock()
        question = HopQuestion(target, port, len(hops))
        report = await answer_question(station, question, HERE, station.net_id)
        took_ns = clock() - began_ns
        if report.error:
            why = _explain(report)
            opaque = HopReport(station=_next_name(report), net_id=report.next_net_id)
            hops.append(Hop(opaque, took_ns, is_opaque=True))
        elif report.why and hops and report.net_id == hops[-1].report.net_id:
            # It handed the question before this one on, and has lost its next hop since.
            why = f"{report.station}: {report.why}"
            hops[-1] = Hop(report, took_ns)
        elif any(report.net_id == each.report.net_id for each in hops):
            why = f"{report.station}: the routes run in a circle, it was on the way already"
        else:
            why = f"{report.station}: {report.why}" if report.why else ""
            hops.append(Hop(report, took_ns))
        if len(hops) > MAX_FURTHER:
            why = why or f"more than {MAX_FURTHER} routers, and no end of the way"
    return hops, why


def _goes_on(hop: Hop) -> bool:
    """Say whether there is somebody to ask behind *hop*."""
    return not (hop.is_opaque or hop.report.is_here) and bool(hop.report.next_net_id)


def _explain(report: HopReport) -> str:
    """Return why the router behind *report* says nothing; empty if it only does not know how."""
    if report.error in _NO_ANSWER:
        where = f"{report.address} by {report.transport}"
        text = AdsError.words_of(report.error)
        return f"{_next_name(report)}: it does not answer {report.station} at {where}: {text}"
    if report.error == AdsError.ACCESS_DENIED:
        return f"{_next_name(report)}: its access rules let {report.station} ask nothing"
    return ""


def _next_name(report: HopReport) -> str:
    """Return the name of the next router; an older router tells that of its route only."""
    return report.next_name or report.route
