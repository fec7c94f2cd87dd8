"""A question to another station, and what came of it: how long it took, or what is wrong."""

from __future__ import annotations

import asyncio
from time import monotonic_ns

from eap.ams.advice import Advice, advise
from eap.ams.directory import AmsAddress, Directory
from eap.ams.report import RouteReport, RouteState
from eap.codec.ads import AdsState, AdsStates
from eap.codec.ams import SYSTEM_PORT, AmsCommand
from eap.control.protocol import ErrorCode
from eap.control.routes import TestResult
from eap.errors import CodecError, ControlError
from eap.ids import NetId
from eap.services.routing.station_router import StationRouter
from eap.services.routing.tracing import find_fault

BLAME_S = 3.0
"""Limit for finding the router at which the way ends."""
_NO_FURTHER = frozenset((RouteState.DOWN, RouteState.CLIENT))
"""States of a route whose own next hop is at fault."""
_TRACE_HINT = "'eapctl trace' shows the routers before it"
_RESULT_SIZE = 4
"""Octets of an ADS answer before its data."""


def find_target(router: StationRouter, directory: Directory, text: str) -> AmsAddress:
    """Return whom *text* names: a route, a NetID with or without a port, or a name of the plant.

    Raises:
        ControlError: nobody.
    """
    for route in router.table:
        if text == route.name and route.octets:
            return AmsAddress(route.net_id, SYSTEM_PORT)
    try:
        if text.count(".") == 5 and ":" not in text and "/" not in text:
            return AmsAddress(NetId.parse(text), SYSTEM_PORT)
        return directory.find(text)
    except ValueError as exc:
        reason = f"{exc}; nor is there a route of that name"
        raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME) from None


async def probe_target(router: StationRouter, target: AmsAddress, timeout_s: float) -> TestResult:
    """Ask *target* for its ADS state by way of *router*, and say what came of it."""
    found = router.table.find(target.net_id)
    is_own = target.net_id in router.net_ids
    route = None if found is None or is_own else found[0]
    began_ns = monotonic_ns()
    answer = await router.ask(*target, AmsCommand.READ_STATE, timeout_s=timeout_s)
    took_us = (monotonic_ns() - began_ns) // 1000
    report = None if route is None else router.report(route)
    advice = advise(answer.error_code, target.net_id, report, router.net_id, is_own=is_own)
    if not advice.is_reached and report is not None and _leads_further(report):
        advice = await _blame(router, target, advice)
    state = _state(answer.data) if not answer.error_code else ""
    return TestResult(
        target=str(target),
        name="" if route is None else route.name,
        ok=advice.is_reached,
        rtt_us=took_us if advice.is_reached else None,
        state=state,
        error=answer.error_code,
        text=f"{advice.text}: {state}" if state else advice.text,
        hint=advice.hint,
    )


def _leads_further(report: RouteReport) -> bool:
    """Say whether a router behind the next hop of a route may be at fault."""
    return report.next_name != report.route.name and report.state not in _NO_FURTHER


async def _blame(router: StationRouter, target: AmsAddress, advice: Advice) -> Advice:
    """Return *advice* about the router at which the way to *target* ends, if one is found."""
    try:
        async with asyncio.timeout(BLAME_S):
            why = await find_fault(router, *target)
    except TimeoutError:
        return advice
    return Advice(is_reached=False, text=why, hint=_TRACE_HINT) if why else advice


def _state(data: bytes) -> str:
    """Return the ADS state in the answer to ReadState; empty if it tells none."""
    try:
        state = AdsStates.decode(data, _RESULT_SIZE).ads_state
    except CodecError:
        return ""
    return AdsState(state).name if state in AdsState._value2member_map_ else f"state {state}"
