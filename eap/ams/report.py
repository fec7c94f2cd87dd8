"""Routes and connections as people want to see them: state, time, figures, what was wrong last."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple

from eap.ads.endpoint import Endpoint
from eap.ams.hop_prober import HopProber
from eap.ams.routes import Route
from eap.ams.spec import AccessService
from eap.ams.traffic import Traffic


class RouteState(StrEnum):
    """Whether a request would go on."""

    UP = "up"
    DOWN = "down"
    UNKNOWN = "unknown"
    """Nothing speaks against it, and nothing was answered yet."""
    CLIENT = "client"
    """A client asked for it by "add route", and does not listen: it has its own connections."""


class Obstacle(NamedTuple):
    """Reason why nothing can go by a route now, and the *state* that this makes of it."""

    state: RouteState
    why: str

    def __str__(self) -> str:
        if self.state is RouteState.CLIENT:
            return f"is a client, {self.why}"
        return f"is {self.state}: {self.why}"


class RouteReport(NamedTuple):
    """One route.

    *why* says what is wrong with one that is down.  *round_trip_ns* is that of its next hop, and
    None while that is not known.  *next_name* is the name of the router at that hop.
    """

    route: Route
    state: RouteState
    why: str
    round_trip_ns: int | None
    traffic: Traffic
    next_name: str


class ConnectionReport(NamedTuple):
    """Who asks."""

    endpoint: Endpoint
    traffic: Traffic


class Location(NamedTuple):
    """Where a request would go.

    *route* is None if it is for this station, or if there is none; *why* says why it would go
    nowhere.  *may* is what access rules let the asker do, None if that depends on the object.
    """

    is_here: bool
    route: RouteReport | None
    why: str
    may: dict[AccessService, bool | None]
    interrupted: int = 0
    """Subscriptions to ports of the NetID to which nothing comes."""
    interrupted_at_ns: int | None = None


def report_route(
    route: Route, obstacle: Obstacle | None, traffic: Traffic | None, hop_prober: HopProber | None,
    *,
    next_name: str,
) -> RouteReport:  # fmt: skip
    """Return what is known of a route.

    Args:
        route: The route.
        obstacle: Reason why nothing can go there; None if something can.
        traffic: By the route so far; None for none.
        hop_prober: Of its router, if that has one.
        next_name: Name of the router at the next hop.
    """
    known = traffic or Traffic()
    round_trip_ns = None if hop_prober is None else hop_prober.round_trip_ns(route.hop)
    if obstacle is not None:
        return RouteReport(route, obstacle.state, obstacle.why, None, known, next_name)
    if round_trip_ns is None and known.answers:
        round_trip_ns = known.round_trip_ns
    is_up = known.is_answered or (hop_prober is not None and hop_prober.is_heard(route.hop))
    state = RouteState.UP if is_up else RouteState.UNKNOWN
    return RouteReport(route, state, "", round_trip_ns, known, next_name)
