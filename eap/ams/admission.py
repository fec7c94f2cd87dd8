"""Admission of requests: loops, hops that are down, and limits of requests in flight.

AoE has no hop count.  A packet is not sent back by the transport that it arrived by; a request that
this router has forwarded already, and whose answer it still waits for, has run in a circle.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from eap.ams.error_reply import RoutingError
from eap.ams.hop_prober import HopProber
from eap.ams.inflight import InFlight
from eap.ams.record import Outcome
from eap.ams.report import Obstacle, RouteState
from eap.ams.routes import Route, RouteTable
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.ids import STATION_OCTETS, Endpoint, NetId


class RouterLimits(NamedTuple):
    """Limits of requests that a router accepts."""

    in_flight: int = 4096
    """Requests that wait, of all connections."""
    per_connection: int = 512
    """Requests of one connection that wait."""
    per_transport: int = 2048
    """Requests of all connections of a transport: a flood by one leaves space for the others.

    One connection may have as many as others leave, so however many flood, some space remains.
    """
    timeout_ns: int = 4_500_000_000
    """Limit for an answer: the error comes back before the usual client time-out of 5 s."""


class Admission:
    """Decides on requests.

    Args:
        net_id: Of the router.
        table: The routes.
        transports: All transports by name.
        in_flight: What waits.
        limits: How much may wait.
        hop_prober: Knows which hops do not answer.
    """

    def __init__(
        self,
        net_id: NetId,
        table: RouteTable,
        transports: Mapping[str, Transport],
        in_flight: InFlight,
        limits: RouterLimits,
        hop_prober: HopProber | None = None,
    ) -> None:
        self._net_id = net_id
        self._table = table
        self._transports = transports
        self._in_flight = in_flight
        self._limits = limits
        self._hop_prober = hop_prober
        self._down: dict[Endpoint, str] = {}
        self._closed: dict[str, str] = {}
        self._opened: set[str] = set()
        """Transports by which some hop was reached; a client behind one listens, or did."""

    def hop_down(self, transport: str, address: str | None, text: str) -> None:
        """Refuse what would go to *address* by *transport*, or to any address; *text* says why."""
        if address is None:
            self._closed[transport] = text
        else:
            self._down[Endpoint(transport, address)] = text

    def hop_up(self, transport: str, address: str | None) -> None:
        """Undo :meth:`hop_down` with the same arguments."""
        if transport in self._transports:
            self._opened.add(transport)
        if address is None:
            self._closed.pop(transport, None)
        else:
            self._down.pop(Endpoint(transport, address), None)

    def transport_removed(self, name: str) -> None:
        """Forget everything about a transport."""
        self._opened.discard(name)
        self._closed.pop(name, None)
        for endpoint in [each for each in self._down if each.transport == name]:
            del self._down[endpoint]

    def is_down(self, hop: Endpoint) -> bool:
        """Return whether *hop* is known to be down."""
        if hop in self._down or hop.transport in self._closed:
            return True
        return self._hop_prober is not None and self._hop_prober.is_dead(hop)

    def why_down(self, hop: Endpoint) -> str:
        """Return in words why nothing can go to *hop* now; empty if it can."""
        if hop.transport not in self._transports:
            return f"this station has no transport {hop.transport}"
        if why := self._down.get(hop) or self._closed.get(hop.transport):
            return why
        is_dead = self._hop_prober is not None and self._hop_prober.is_dead(hop)
        return "it does not answer" if is_dead else ""

    def find_obstacle(self, route: Route) -> Obstacle | None:
        """Return why nothing can go by *route* now; None if something can."""
        why = self.why_down(route.hop)
        if not why:
            return None
        transport = route.hop.transport
        if route.is_client and transport in self._transports and transport not in self._opened:
            return Obstacle(RouteState.CLIENT, f"not listening: {why}")
        return Obstacle(RouteState.DOWN, why)

    def find_route(self, header: AmsHeader, endpoint: Endpoint) -> Route | RoutingError:
        """Return the route of a request for another station, or an error."""
        found = self._table.find(header.target)
        if found is None:
            return RoutingError(AdsError.TARGET_MACHINE, f"no route to {header.target}")
        route, octets = found
        # Matched by a default route only.
        if octets < STATION_OCTETS and header.target.station == self._net_id.station:
            # A router with a route for this station's NetIDs would send it back here.
            text = f"this station has no NetID {header.target}"
            return RoutingError(AdsError.TARGET_MACHINE, text)
        return self._find_obstacle(header, endpoint, route) or route

    def is_duplicate(self, header: AmsHeader, onward: bytes, endpoint: Endpoint) -> bool:
        """Return whether the same request, repeated or doubled, waits already."""
        # On TCP nothing arrives twice; two equal requests there are two requests.
        if self._transports[endpoint.transport].is_stream:
            return False
        return self._in_flight.has_request(endpoint, onward, header.invoke_id)

    def find_loop(self, header: AmsHeader, onward: bytes, route: Route) -> RoutingError | None:
        """Return an error if this router has forwarded the request already."""
        known = self._in_flight.get(header.invoke_id)
        if known is None or known.route is None:
            return None
        # Two routers may give the same ID: only the same request with the same addresses is a loop.
        if known.onward != onward or known.header.command != header.command:
            return None
        text = f"it was forwarded from here already: routes to {header.target} run in a circle"
        return RoutingError(AdsError.TARGET_MACHINE, text, route, Outcome.LOOP)

    def check_limits(self, endpoint: Endpoint) -> RoutingError | None:
        """Return an error if too many requests wait already."""
        waiting = self._in_flight.count(endpoint)
        of_transport = self._in_flight.count_of_transport(endpoint.transport)
        if waiting >= self._limits.per_connection:
            text = f"{self._limits.per_connection} requests of the connection wait already"
            return RoutingError(AdsError.MAILBOX_FULL, text)
        # A connection gets at most as much as all connections of its transport leave.
        if waiting >= self._limits.per_transport - of_transport:
            by = endpoint.transport
            text = f"{of_transport} requests by {by} wait already, {waiting} of this connection"
            return RoutingError(AdsError.MAILBOX_FULL, text)
        if len(self._in_flight) >= self._limits.in_flight and not self._in_flight.drop_abandoned():
            text = f"{self._limits.in_flight} requests wait already"
            return RoutingError(AdsError.MAILBOX_FULL, text)
        return None

    def _find_obstacle(
        self, header: AmsHeader, endpoint: Endpoint, route: Route
    ) -> RoutingError | None:
        back = self._table.find(header.source)
        # A default route matches every source: it says nothing about this one.
        if back is not None and back[1] >= STATION_OCTETS and back[0].is_unidirectional:
            text = f"route {back[0].name} is unidirectional: requests from there are refused"
            return RoutingError(AdsError.ACCESS_DENIED, text, back[0])
        hop = route.hop
        if hop.transport not in self._transports:
            text = f"route {route.name} is by {hop.transport}, which this station does not have"
            return RoutingError(AdsError.HOST_UNREACHABLE, text, route)
        if hop.transport == endpoint.transport and (
            hop == endpoint or not self._transports[hop.transport].is_hub
        ):
            text = f"route {route.name} leads back to where it came from"
            return RoutingError(AdsError.TARGET_MACHINE, text, route, Outcome.LOOP)
        if self.is_down(hop):
            text = f"{self._table.describe_hop(route)} {self.find_obstacle(route)}"
            return RoutingError(AdsError.HOST_UNREACHABLE, text, route)
        return None
