"""Requests that wait for their answers: admission, invoke IDs, and packets that run in a circle.

AoE has no hop count.  A packet is not sent back by the transport that it arrived by.  The first
router gives each forwarded request an invoke ID of its own and the routers behind it keep that ID,
so each router recognizes a request that it has forwarded already.  Such an ID differs from those of
clients, which count from 1, by its upper ten bits: they follow from the lower bits and are never
all 0 (own format; other peers treat an invoke ID as opaque).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Container, Iterator, Mapping
from typing import NamedTuple

from eap.ams.access import AuthorizedRequest
from eap.ams.error_reply import RoutingError
from eap.ams.hop_prober import HopProber
from eap.ams.record import Outcome
from eap.ams.report import Obstacle, RouteState
from eap.ams.routes import Route, RouteTable
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.ids import STATION_OCTETS, Endpoint, NetId

_SERIAL_BITS = 22
_SERIALS = 1 << _SERIAL_BITS
# Neighbouring serials get upper bits that have nothing in common.
_FACTOR = 2654435761
"""Knuth's multiplier."""


class InvokeIds:
    """Allocates IDs one after the other; one repeats after four million.

    Args:
        first: First serial; another number at each start keeps late answers to an earlier process
            from matching requests of this one.
    """

    def __init__(self, first: int) -> None:
        self._serial = first % _SERIALS

    def allocate(self, used: Container[int]) -> int:
        """Return the next id that is not among *used*."""
        while True:
            self._serial = serial = (self._serial + 1) % _SERIALS
            invoke_id = _mark(serial) << _SERIAL_BITS | serial
            if invoke_id not in used:
                return invoke_id


def is_marked(invoke_id: int) -> bool:
    """Return whether a router gave this ID."""
    return invoke_id >> _SERIAL_BITS == _mark(invoke_id & _SERIALS - 1)


def _mark(serial: int) -> int:
    # Never 0: the upper bits of a client's ID are 0 while it counts from 1.
    return (serial * _FACTOR >> 12 & 0x3FF) or 1


# A packet that runs in a circle returns long before so many others.
MAX_PASSED = 1024
"""Packets that are kept."""


class LoopDetector:
    """The latest packets without an answer that were forwarded, by invoke ID and addresses."""

    def __init__(self) -> None:
        self._latest: OrderedDict[tuple[int, bytes], None] = OrderedDict()

    def __contains__(self, packet: tuple[int, bytes]) -> bool:
        return packet in self._latest

    def add(self, invoke_id: int, addresses: bytes) -> None:
        """Remember a packet."""
        self._latest[invoke_id, addresses] = None
        if len(self._latest) > MAX_PASSED:
            self._latest.popitem(last=False)


class Pending:
    """A request that was forwarded or delivered.

    Attributes:
        invoke_id: That it has now; unique here.
        header: As it came.
        endpoint: Of its client, where the answer goes; None when the client is gone.
        route: That it was forwarded by; None for a service of this station.
        onward: Target and source of the forwarded packet, 16 bytes.
        at_ns: When it came.
        deadline_ns: When its time is up.
        handles: Number of notifications that it requests.
        request_body: Its body, if this router restores a subscription by it later.
        step: Step of a restoration, for a request of this router; None for a client's.
        may_repeat: Whether the same request may come twice: not by a stream.
        authorized: Decisions on its operations, where its answer has to be completed or audited.
    """

    __slots__ = (
        "at_ns",
        "authorized",
        "deadline_ns",
        "endpoint",
        "handles",
        "header",
        "invoke_id",
        "may_repeat",
        "onward",
        "request_body",
        "route",
        "step",
    )  # fmt: skip

    def __init__(
        self, invoke_id: int, header: AmsHeader, endpoint: Endpoint | None, route: Route | None,
        onward: bytes, at_ns: int, deadline_ns: int, *, may_repeat: bool = False,
    ) -> None:  # fmt: skip
        self.invoke_id = invoke_id
        self.header = header
        self.endpoint = endpoint
        self.route = route
        self.onward = onward
        self.at_ns = at_ns
        self.deadline_ns = deadline_ns
        self.handles = 0
        self.request_body = b""
        self.step: object | None = None
        self.may_repeat = may_repeat
        self.authorized: AuthorizedRequest | None = None


class InFlight:
    """Requests in flight.

    A request is found by invoke ID, and by client and request, in constant time.
    """

    def __init__(self) -> None:
        self._by_id: dict[int, Pending] = {}
        self._by_endpoint: dict[Endpoint, dict[int, Pending]] = {}
        self._by_transport: dict[str, int] = {}
        self._by_time: dict[int, dict[int, Pending]] = {}
        self._asked: dict[tuple[Endpoint, bytes, int], int] = {}
        self._abandoned: OrderedDict[int, None] = OrderedDict()

    def __len__(self) -> int:
        return len(self._by_id)

    def __contains__(self, invoke_id: object) -> bool:
        return invoke_id in self._by_id

    def __iter__(self) -> Iterator[Pending]:
        return iter(self._by_id.values())

    def get(self, invoke_id: int) -> Pending | None:
        """Return the request with this id."""
        return self._by_id.get(invoke_id)

    def endpoints(self) -> list[Endpoint]:
        """Return the endpoints with waiting requests."""
        return list(self._by_endpoint)

    def count(self, endpoint: Endpoint) -> int:
        """Return the number of requests of *endpoint*."""
        return len(self._by_endpoint.get(endpoint, ()))

    def count_of_transport(self, transport: str) -> int:
        """Return the number of requests of all endpoints of *transport*."""
        return self._by_transport.get(transport, 0)

    def add(self, pending: Pending) -> None:
        """Remember a request."""
        endpoint = pending.endpoint
        key = pending.invoke_id
        self._by_id[key] = pending
        if endpoint is not None:
            self._by_endpoint.setdefault(endpoint, {})[key] = pending
            self._by_transport[endpoint.transport] = (
                self._by_transport.get(endpoint.transport, 0) + 1
            )
            if pending.may_repeat:
                self._asked[endpoint, pending.onward, pending.header.invoke_id] = key
        elif pending.step is None:
            self._abandoned[key] = None
        # The times allowed are few, so that each has its requests in the order of their deadlines.
        allowed = pending.deadline_ns - pending.at_ns
        waiting = self._by_time.get(allowed)
        if waiting is None:
            waiting = self._by_time[allowed] = {}
        waiting[key] = pending

    def has_request(self, endpoint: Endpoint, onward: bytes, invoke_id: int) -> bool:
        """Return whether a request with these addresses and this ID of its client waits."""
        return (endpoint, onward, invoke_id) in self._asked

    def pop(self, invoke_id: int) -> Pending | None:
        """Forget and return the request with this id."""
        pending = self._by_id.pop(invoke_id, None)
        if pending is None:
            return None
        self._detach(pending)
        self._abandoned.pop(invoke_id, None)
        del self._by_time[pending.deadline_ns - pending.at_ns][invoke_id]
        return pending

    def abandon(self, endpoint: Endpoint) -> list[Pending]:
        """Return the requests of *endpoint*, whose answers no client waits for any more."""
        # The requests stay until their time is up: a packet that runs in a circle is still known.
        left = list(self._by_endpoint.get(endpoint, {}).values())
        for pending in left:
            self._detach(pending)
            pending.endpoint = None
            self._abandoned[pending.invoke_id] = None
        return left

    def drop_abandoned(self) -> bool:
        """Drop the oldest abandoned request; return whether there was one."""
        if not self._abandoned:
            return False
        self.pop(next(iter(self._abandoned)))
        return True

    def on(self, transport: str, address: str | None) -> list[Pending]:
        """Return the requests forwarded by *transport*, to *address* or to any."""
        return [
            each
            for each in self
            if each.route is not None
            and each.route.hop.transport == transport
            and address in {None, each.route.hop.connection}
        ]

    def next_timeout(self) -> int | None:
        """Return the earliest deadline."""
        heads = (next(iter(each.values())).deadline_ns for each in self._by_time.values() if each)
        return min(heads, default=None)

    def due(self, now_ns: int) -> list[Pending]:
        """Return the requests whose deadline has passed, the earliest first."""
        found = []
        for waiting in self._by_time.values():
            for pending in waiting.values():
                if pending.deadline_ns > now_ns:
                    break
                found.append(pending)
        return sorted(found, key=lambda each: each.deadline_ns)

    def _detach(self, pending: Pending) -> None:
        endpoint = pending.endpoint
        if endpoint is None:
            return
        of_endpoint = self._by_endpoint[endpoint]
        del of_endpoint[pending.invoke_id]
        if not of_endpoint:
            del self._by_endpoint[endpoint]
        self._by_transport[endpoint.transport] -= 1
        if pending.may_repeat:
            key = endpoint, pending.onward, pending.header.invoke_id
            if self._asked.get(key) == pending.invoke_id:
                del self._asked[key]


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

    def may_repeat(self, endpoint: Endpoint) -> bool:
        """Return whether a request of *endpoint* may come twice."""
        # On TCP nothing arrives twice; two equal requests there are two requests.
        return not self._transports[endpoint.transport].is_stream

    def is_duplicate(self, header: AmsHeader, onward: bytes, endpoint: Endpoint) -> bool:
        """Return whether the same request, repeated or doubled, waits already."""
        if not self.may_repeat(endpoint):
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
