"""Records of the control protocol about a router: routes, connections, requests.

Only figures that routers keep anyway are read here; 10,000 routes are sent in pages.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from time import monotonic_ns, time
from typing import Any

from eap.ams.record import Outcome, Trace, reason_of
from eap.ams.report import ConnectionReport, RouteReport, RouteState
from eap.ams.routes import Origin, Route
from eap.ams.subscription_restorer import Interruption
from eap.codec.ams import ADDRESSES, AmsCommand
from eap.control.routes import (
    ConnectionRow,
    InterruptionRow,
    OriginName,
    RequestRow,
    RouteRow,
    RouterRow,
    RoutesListParameters,
    interruption_text,
)
from eap.ids import NetId
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes

MAX_LOOPS = 5
"""Limit of the reported loops; each is shown with its latest packet."""
MAX_WARNINGS = 100
MAX_NAMED = 3
"""Stations that a finding names."""
_S = 1_000_000_000
_ORIGINS: dict[Origin, OriginName] = {
    Origin.STATIC: "static",
    Origin.ADDED: "added",
    Origin.LEARNED: "learned",
}


class RouterView:
    """Router of one station, as lists of the control protocol show it."""

    def __init__(self, router: StationRouter, routes: StationRoutes) -> None:
        self.router = router
        self.routes = routes
        self._warnings: list[str] = []
        self._version = -1

    def row(self, wanted: RoutesListParameters) -> RouterRow:
        """Return the part of its state that is *wanted*."""
        now_ns = monotonic_ns()
        found = list(self.router.table)
        if text := wanted.match.lower():
            found = [route for route in found if text in self._filter_text(route)]
        page = found[wanted.first : wanted.first + wanted.count]
        latest = list(self.router.record.latest)
        return RouterRow(
            station=self.router.name,
            net_id=str(self.router.net_id),
            routes=[self.route_row(route, now_ns) for route in page],
            total=len(found),
            connections=[connection_row(each, now_ns) for each in self.router.connections()],
            requests=[request_row(each, now_ns) for each in _last(latest, wanted.requests)],
            interruptions=[interruption_row(each, now_ns) for each in self.router.interruptions()],
            warnings=[*self.warnings(), *_loops(latest)],
        )

    def route_row(self, route: Route, now_ns: int) -> RouteRow:
        """Return one of the routes."""
        is_derived = self.routes.is_derived(route)
        return route_row(self.router.report(route), now_ns, is_derived=is_derived)

    def warnings(self) -> list[str]:
        """Return the warnings about the routes."""
        # Cached: there may be 10,000 routes to compare.
        if self._version != self.router.table.version:
            self._version = self.router.table.version
            self._warnings = self.router.table.warnings(self.router.net_ids)[:MAX_WARNINGS]
        return self._warnings

    def _filter_text(self, route: Route) -> str:
        """Return all texts that a filter matches."""
        report = self.router.report(route)
        origin = "derived" if self.routes.is_derived(route) else _ORIGINS[route.origin]
        words = (route.name, str(route.net_id), *route.hop, origin, report.state, report.why)
        return " ".join(words).lower()


def interruption_row(found: Interruption, now_ns: int) -> InterruptionRow:
    """Return the record of the interrupted subscriptions of one client."""
    target, port, source, source_port = ADDRESSES.unpack(found.addresses)
    return InterruptionRow(
        client=str(found.endpoint),
        source=f"{NetId(source)}:{source_port}",
        target=f"{NetId(target)}:{port}",
        count=found.number,
        since_s=(now_ns - found.since_ns) // _S,
        why=found.why,
    )


def interruption_findings(routers: Iterable[StationRouter], now_s: float) -> list[dict[str, Any]]:
    """Return the interrupted subscriptions as findings of ``status``."""
    now_ns = monotonic_ns()
    found = []
    for router in routers:
        for each in router.interruptions():
            row = interruption_row(each, now_ns)
            found.append(
                {
                    "severity": "warning",
                    "where": router.name,
                    "what": interruption_text(row),
                    "advice": "they are restored when the path is up again: see 'eapctl trace'",
                    "since": now_s - (now_ns - each.since_ns) / _S,
                }
            )
    return found


def route_findings(routers: Iterable[StationRouter]) -> list[dict[str, Any]]:
    """Return the configured next hops that are down as findings of ``status``.

    A hop that several stations cannot reach for the same reason is one finding.
    """
    by_cause: dict[tuple[str, str], list[tuple[str, Route]]] = {}
    for router in routers:
        # No reports here: there may be 10,000 routes, each with a hop of its own.
        hops = {
            each.hop: each
            for each in router.table
            if each.origin is not Origin.LEARNED and not each.is_client
        }
        for route in hops.values():
            obstacle = router.find_obstacle(route)
            if obstacle is not None and obstacle.state is RouteState.DOWN:
                where = f"{router.table.next_name(route)} ({route.hop.connection})"
                by_cause.setdefault((where, obstacle.why), []).append((router.name, route))
    return [
        {
            "severity": "warning",
            "where": _listed([name for name, _ in found]),
            "what": f"route to {hop} is down: {why}",
            "advice": f"'eapctl routes test {_words(*found[0])}' tests it",
            "since": None,
        }
        for (hop, why), found in by_cause.items()
    ]


def _words(station: str, route: Route) -> str:
    """Return the arguments of a test of *route*; a default route has no target of its own."""
    return shlex.join([station, route.name] if route.octets else [station])


def _listed(names: list[str]) -> str:
    rest = len(names) - MAX_NAMED
    return ", ".join(names[:MAX_NAMED]) + (f" and {rest} more" if rest > 0 else "")


def route_row(report: RouteReport, now_ns: int, *, is_derived: bool) -> RouteRow:
    """Return the record of a route."""
    route, traffic = report.route, report.traffic
    trip_ns, end_ns = report.round_trip_ns, route.expires_at_ns
    return RouteRow(
        name=route.name,
        net_id=str(route.net_id),
        octets=route.octets,
        transport=route.hop.transport,
        address=route.hop.connection,
        origin="derived" if is_derived else _ORIGINS[route.origin],
        state=report.state.value,
        why=report.why,
        next_name=report.next_name,
        rtt_us=None if trip_ns is None else trip_ns // 1000,
        expires_s=None if end_ns is None else max(0, (end_ns - now_ns) // _S),
        real="" if route.real is None else str(route.real),
        unidirectional=route.is_unidirectional,
        timeout_ms=route.timeout_ns // 1_000_000,
        probed=route.is_probed,
        requests=traffic.requests,
        answers=traffic.answers,
        errors=traffic.errors,
        octets_out=traffic.request_bytes,
        octets_in=traffic.answer_bytes,
        last_error=traffic.last_error,
        last_error_s=_age_s(traffic.last_error_ns, now_ns),
    )


def connection_row(report: ConnectionReport, now_ns: int) -> ConnectionRow:
    """Return the record of a connection."""
    endpoint, traffic = report
    return ConnectionRow(
        transport=endpoint.transport,
        address=endpoint.connection,
        since_s=(now_ns - traffic.since_ns) // _S,
        net_ids=[str(each) for each in traffic.sources],
        took_us=traffic.round_trip_ns // 1000 if traffic.answers else None,
        requests=traffic.requests,
        answers=traffic.answers,
        errors=traffic.errors,
        octets_out=traffic.answer_bytes,
        octets_in=traffic.request_bytes,
        last_error=traffic.last_error,
        last_error_s=_age_s(traffic.last_error_ns, now_ns),
    )


def _age_s(at_ns: int | None, now_ns: int) -> int | None:
    return None if at_ns is None else (now_ns - at_ns) // _S


def request_row(trace: Trace, now_ns: int) -> RequestRow:
    """Return the record of a packet."""
    header, hop = trace.header, trace.hop
    known = {} if header is None else {
        "service": AmsCommand.name_of(header.command),
        "target": f"{header.target}:{header.target_port}",
        "source": f"{header.source}:{header.source_port}",
    }  # fmt: skip
    return RequestRow(
        # Traces have the monotonic clock, which has no meaning outside this host.
        at=round(time() - (now_ns - trace.at_ns) / _S, 3),
        outcome=trace.outcome,
        came_by="" if trace.endpoint is None else str(trace.endpoint),
        transport="" if hop is None else hop.transport,
        address="" if hop is None else hop.connection,
        error=trace.error_code,
        took_us=trace.took_ns // 1000,
        text=reason_of(trace),
        **known,
    )


def _loops(latest: list[Trace]) -> list[str]:
    """Return the loops that were detected lately, the newest first."""
    texts = (f"loop: {each.text}" for each in reversed(latest) if each.outcome is Outcome.LOOP)
    return list(dict.fromkeys(texts))[:MAX_LOOPS]


def _last(latest: list[Trace], count: int) -> list[Trace]:
    return latest[-count:] if count else []
