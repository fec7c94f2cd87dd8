"""The path to an AMS address, hop by hop: each router reports where it forwards requests.

A query for a router further on is forwarded by those before it, so no routes to the routers between
are needed (own format, see :class:`~eap.ams.report.HopQuestion`).  A router of another make
answers it with an error; the hops behind that one stay unknown.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Container
from time import monotonic_ns
from typing import NamedTuple

from msgspec.structs import replace

from eap.ads.request import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    ReadState,
    ReadWrite,
    decode_outcome,
    encode_outcome,
    encode_query,
    parse_request,
)
from eap.ams.directory import AmsAddress, Directory
from eap.ams.record import Outcome, reason_of
from eap.ams.report import (
    MAX_FURTHER,
    MAX_REPORT,
    Advice,
    HopQuestion,
    HopReport,
    RouteReport,
    RouteState,
    advise,
    decode_report,
    encode_report,
    report_of,
)
from eap.ams.spec import TransportKind
from eap.codec.ads import AdsError, AdsState, AdsStates, IndexGroup
from eap.codec.ams import DEVICE_PORT, SYSTEM_PORT, AmsAnswer, AmsCommand, AmsHeader
from eap.control.protocol import ErrorCode
from eap.control.routes import TestResult
from eap.errors import CodecError, ControlError
from eap.ids import Endpoint, NetId
from eap.services.routing.service import LocalRequest, Service
from eap.services.routing.station_router import StationRouter

HERE = Endpoint(TransportKind.LOCAL, "trace")
# Routers before the target time out earlier.
TARGET_TIMEOUT_S = 5.0
"""For the target itself."""
SUSPECT_TIMEOUT_S = 2.0
"""For a target behind a router that did not answer."""
_HOP_TIMEOUT_S = 1.0
# The router nearest to the start waits longest.
_TIMEOUT_PER_HOP_S = 0.25
"""For each router that forwards a query."""
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
"""Errors that a router before the target reports."""
_NO_ANSWER = frozenset((AdsError.TARGET_MACHINE, AdsError.HOST_UNREACHABLE, AdsError.TIMEOUT))
"""Errors that another router reports in place of the queried one."""
_LAST_FAILURE_NS = 10_000_000_000
"""Age of a failure that may be that of the request of a trace."""
_REPLIED = frozenset((Outcome.ANSWERED, Outcome.FAILED, Outcome.DENIED))
# ReadState is answered from the memory of its master.
NO_SLAVE = "its master answers: the slave does not answer"
"""Result for a slave without an AL state."""


class Hop(NamedTuple):
    """One router on the path.

    *took_ns* is the time until its report came; *is_opaque* marks a router that sends no reports.
    """

    report: HopReport
    took_ns: int
    is_opaque: bool = False


class TraceResult(NamedTuple):
    """Path to a target, and the answer of the target.

    *answer* is that to ReadState, None if no request was sent because the path ends before the
    target.  *why* begins with the hop and is the reason of a missing answer, of the target or of
    the slave behind it; empty with an answer.
    """

    hops: tuple[Hop, ...]
    answer: OperationOutcome | None
    took_ns: int
    why: str

    @property
    def states(self) -> AdsStates | None:
        """States of the target; None without an answer."""
        if self.answer is None or self.answer.result:
            return None
        try:
            return AdsStates.decode(self.answer.data)
        except CodecError:
            return None


async def run_operation(
    station: StationRouter,
    target: NetId,
    port: int,
    operation: Operation,
    timeout_s: float,
) -> OperationOutcome:
    """Send one ADS operation, and return its outcome."""
    command, body = encode_query(operation)
    answer = await station.request(target, port, command, body, timeout_s=timeout_s)
    return decode_outcome(command, answer.error_code, answer.data)


async def answer_hop_query(
    station: StationRouter, query: HopQuestion, endpoint: Endpoint, source: NetId
) -> HopReport:
    """Return the report of a router about an address, or that of a router further on.

    Args:
        station: Router that answers.
        query: The query.
        endpoint: Endpoint that the query came from.
        source: NetID of the sender.
    """
    header = AmsHeader(query.target, query.port, source, 0, 0)
    location = station.locate(header, endpoint)
    report = report_of(station.name, station.net_id, query.target, location, monotonic_ns())
    if report.is_here:
        report = replace(report, last_failure=_last_failure(station, header))
        if query.wants_faults:
            faults = await station.find_faults(query.target, query.port)
            report = replace(report, faults=faults)
    if not query.further or report.is_here or report.why or not report.next_net_id:
        return report
    # Bounded, because each router on a loop would forward the query once more.
    further = min(query.further, MAX_FURTHER) - 1
    onward = HopQuestion(NetId.parse(report.target), query.port, further, query.wants_faults)
    operation = ReadWrite(IndexGroup.ROUTE_QUERY, 0, MAX_REPORT, onward.encode())
    next_router = NetId.parse(report.next_net_id)
    timeout_s = _HOP_TIMEOUT_S + _TIMEOUT_PER_HOP_S * further
    outcome = await run_operation(station, next_router, SYSTEM_PORT, operation, timeout_s)
    # The router further on does not answer: its predecessor's report says how far the path goes.
    if outcome.result:
        return replace(report, error=outcome.result)
    try:
        return decode_report(outcome.data)
    except CodecError:
        return replace(report, error=AdsError.SERVICE)


def _last_failure(station: StationRouter, header: AmsHeader) -> str:
    """Return the reason of the latest failed request with the addresses of *header*, or ""."""
    oldest_ns = monotonic_ns() - _LAST_FAILURE_NS
    addresses = header.target, header.target_port, header.source
    for each in reversed(station.record.latest):
        # The newest come first: the others are older still.
        if each.at_ns < oldest_ns:
            break
        found = each.header
        if found is None or not each.text or each.outcome not in _REPLIED:
            continue
        if (found.target, found.target_port, found.source) == addresses:
            return reason_of(each)
    return ""


async def trace(
    station: StationRouter, target: NetId, port: int, *, clock: Callable[[], int] = monotonic_ns
) -> TraceResult:
    """Follow the path from *station* to *target*, and read the state of the target."""
    hops, why = await _follow(station, target, port, clock)
    last = hops[-1]
    if why and not last.is_opaque:
        return TraceResult(tuple(hops), None, 0, why)
    # A router of another make does not support the query (own format), and forwards requests.
    timeout_s = SUSPECT_TIMEOUT_S if why else TARGET_TIMEOUT_S
    began_ns = clock()
    answer = await run_operation(station, target, port, ReadState(), timeout_s)
    took_ns = clock() - began_ns
    where = last.report.station + ("" if last.report.is_here else " or behind it")
    is_reached = answer.result not in _ON_THE_WAY
    # Every other error comes from the target, so the path to it is complete.
    if why and not is_reached:
        return TraceResult(tuple(hops), None, 0, why)
    found = TraceResult(tuple(hops), answer, took_ns, "")
    is_slave = port not in {DEVICE_PORT, SYSTEM_PORT}
    reason = ""
    faults: tuple[str, ...] = ()
    if last.report.is_here and (is_slave or not is_reached):
        # Queried again: only now it knows the reason of an error; its time counts no more.
        query = HopQuestion(target, port, len(hops) - 1, wants_faults=int(is_slave))
        again = await answer_hop_query(station, query, HERE, station.net_id)
        reason, faults = again.last_failure, again.faults
        report = replace(last.report, faults=faults)
        found = found._replace(hops=(*hops[:-1], last._replace(report=report)))
    if is_slave_missing(port, found.states):
        return found._replace(why="; ".join((f"{where}: {NO_SLAVE}", *faults)))
    if is_reached:
        return found
    code = f" (0x{answer.result:x})" if reason and "0x" not in reason else ""
    return found._replace(why=f"{where}: {reason or AdsError.words_of(answer.result)}{code}")


def is_slave_missing(port: int, states: AdsStates | None) -> bool:
    """Return whether an answer to ReadState is that of a master whose slave has no AL state."""
    is_slave = port not in {DEVICE_PORT, SYSTEM_PORT}
    return is_slave and states == AdsStates(AdsState.INVALID, 0)


async def find_fault(station: StationRouter, target: NetId, port: int) -> str:
    """Return the router at which the path to *target* ends, and the reason; empty if it has no end.

    This is for a request without an answer: the router that reported the error may not know which
    of those behind it is the cause.
    """
    _, why = await _follow(station, target, port, monotonic_ns)
    return why


async def _follow(
    station: StationRouter, target: NetId, port: int, clock: Callable[[], int]
) -> tuple[list[Hop], str]:
    """Return the routers on the path, and the reason why it ends at the last one."""
    hops: list[Hop] = []
    why = ""
    while not why and (not hops or _has_next(hops[-1])):
        began_ns = clock()
        query = HopQuestion(target, port, len(hops))
        report = await answer_hop_query(station, query, HERE, station.net_id)
        took_ns = clock() - began_ns
        if report.error:
            why = _explain(report)
            opaque = HopReport(station=_next_name(report), net_id=report.next_net_id)
            hops.append(Hop(opaque, took_ns, is_opaque=True))
        elif report.why and hops and report.net_id == hops[-1].report.net_id:
            # It forwarded the previous query, and has lost its next hop since.
            why = f"{report.station}: {report.why}"
            hops[-1] = Hop(report, took_ns)
        elif any(report.net_id == each.report.net_id for each in hops):
            why = f"{report.station}: the routes run in a circle; it is on the path already"
        else:
            why = f"{report.station}: {report.why}" if report.why else ""
            hops.append(Hop(report, took_ns))
        if len(hops) > MAX_FURTHER:
            why = why or f"the path has more than {MAX_FURTHER} routers"
    return hops, why


def _has_next(hop: Hop) -> bool:
    """Return whether there is a router behind *hop* to query."""
    return not (hop.is_opaque or hop.report.is_here) and bool(hop.report.next_net_id)


def _explain(report: HopReport) -> str:
    """Return why the router behind *report* sent none; empty if it just lacks support."""
    if report.error in _NO_ANSWER:
        where = f"{report.address} by {report.transport}"
        text = AdsError.words_of(report.error)
        return f"{_next_name(report)}: it does not answer {report.station} at {where}: {text}"
    if report.error == AdsError.ACCESS_DENIED:
        return f"{_next_name(report)}: its access rules deny queries of {report.station}"
    return ""


def _next_name(report: HopReport) -> str:
    """Return the name of the next router; an older router reports only that of its route."""
    return report.next_name or report.route


class RouteQuery:
    """Answers to hop queries, in front of the system service of *station*.

    Args:
        station: Router that is traced.
        rest: Service for all other requests.
    """

    def __init__(self, station: StationRouter, rest: Service) -> None:
        self._station = station
        self._rest = rest

    @property
    def ports(self) -> Container[int]:
        """Ports of the system service."""
        return self._rest.ports

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a hop query, or let the system service answer."""
        operation = _hop_query(request)
        if operation is None:
            return self._rest.answer(request)
        return self._report(request, operation)

    def client_gone(self, endpoint: Endpoint) -> None:
        """End what belongs to a closed connection (Service)."""
        self._rest.client_gone(endpoint)

    async def _report(self, request: LocalRequest, operation: ReadWrite) -> AmsAnswer:
        try:
            query = HopQuestion.decode(operation.data)
        except CodecError:
            outcome = OperationOutcome(AdsError.SIZE)
        else:
            source = request.header.source
            report = await answer_hop_query(self._station, query, request.endpoint, source)
            data = encode_report(report)
            fits = len(data) <= operation.length
            outcome = OperationOutcome(data=data) if fits else OperationOutcome(AdsError.SIZE)
        return AmsAnswer(encode_outcome(AmsCommand.READ_WRITE, outcome))


def _hop_query(request: LocalRequest) -> ReadWrite | None:
    """Return the operation of a hop query, None for any other request."""
    if request.header.command != AmsCommand.READ_WRITE:
        return None
    try:
        operation, *others = parse_request(request.header.command, request.body).operations
    except (AdsRefusedError, ValueError):
        return None
    # In a sum command the query is not supported; the system service rejects it.
    if others or not isinstance(operation, ReadWrite):
        return None
    return operation if operation.group == IndexGroup.ROUTE_QUERY else None


FAULT_SEARCH_S = 3.0
"""Time limit for finding the router at which the path ends."""
_NO_FURTHER = frozenset((RouteState.DOWN, RouteState.CLIENT))
"""States of a route in which its own next hop is the cause."""
_TRACE_HINT = "'eapctl trace' shows the routers before it"
_RESULT_SIZE = 4
"""Bytes of an ADS answer before its data."""


def find_target(router: StationRouter, directory: Directory, text: str) -> AmsAddress:
    """Return the address of a route's name, a NetID with or without port, or a name of the plant.

    Raises:
        ControlError: *text* is none of these.
    """
    for route in router.table:
        if text == route.name and route.octets:
            return AmsAddress(route.net_id, SYSTEM_PORT)
    try:
        # A NetID first: it needs no entry in the directory of the plant.
        if text.count(".") == 5 and ":" not in text and "/" not in text:
            return AmsAddress(NetId.parse(text), SYSTEM_PORT)
        return directory.find(text)
    except ValueError as exc:
        reason = f"{exc}; nor is there a route of that name"
        raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME) from None


async def probe_target(router: StationRouter, target: AmsAddress, timeout_s: float) -> TestResult:
    """Read the ADS state of *target* through *router*; return the result in words."""
    found = router.table.find(target.net_id)
    is_own = target.net_id in router.net_ids
    route = None if found is None or is_own else found[0]
    began_ns = monotonic_ns()
    answer = await router.request(*target, AmsCommand.READ_STATE, timeout_s=timeout_s)
    took_us = (monotonic_ns() - began_ns) // 1000
    report = None if route is None else router.report(route)
    advice = advise(answer.error_code, target.net_id, report, router.net_id, is_own=is_own)
    if not advice.is_reached and report is not None and _leads_further(report):
        advice = await _with_fault(router, target, advice)
    states = None if answer.error_code else _states(answer.data)
    state = "" if states is None else _state_name(states)
    text = f"{advice.text}: {state}" if state else advice.text
    is_missing = is_slave_missing(target.port, states)
    return TestResult(
        target=str(target),
        name="" if route is None else route.name,
        ok=advice.is_reached and not is_missing,
        rtt_us=took_us if advice.is_reached else None,
        state=state,
        error=answer.error_code,
        text=NO_SLAVE if is_missing else text,
        hint=advice.hint,
    )


def _leads_further(report: RouteReport) -> bool:
    """Return whether a router behind the next hop of a route may be the cause."""
    return report.next_name != report.route.name and report.state not in _NO_FURTHER


async def _with_fault(router: StationRouter, target: AmsAddress, advice: Advice) -> Advice:
    """Return *advice* about the router at which the path to *target* ends, if there is one."""
    try:
        async with asyncio.timeout(FAULT_SEARCH_S):
            why = await find_fault(router, *target)
    except TimeoutError:
        return advice
    return Advice(is_reached=False, text=why, hint=_TRACE_HINT) if why else advice


def _states(data: bytes) -> AdsStates | None:
    """Return the states in the answer to ReadState; None if it has none."""
    try:
        return AdsStates.decode(data, _RESULT_SIZE)
    except CodecError:
        return None


def _state_name(states: AdsStates) -> str:
    state = states.ads_state
    return AdsState(state).name if state in AdsState._value2member_map_ else f"state {state}"
