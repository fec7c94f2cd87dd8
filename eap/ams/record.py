"""Record of a router: traces of packets, counters, and traffic by endpoint and by route."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Hashable
from enum import StrEnum
from typing import Generic, TypeVar

import msgspec

from eap.ams.hop_prober import PROBE_PORT
from eap.ams.routes import RouteKey
from eap.codec.ams import SYSTEM_PORT, AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId


class Outcome(StrEnum):
    """Outcome of a packet."""

    ANSWERED = "answered"
    FAILED = "failed"
    """The router itself answered, with an error."""
    DENIED = "denied"
    """Access rules forbid it, or items of it."""
    LOOP = "loop"
    """It ran in a circle; if it was a request it was answered with an error."""
    LATE = "late"
    """An answer or a notification that no client waits for."""
    DROPPED = "dropped"
    """Nothing was answered: broken, doubled, or of the kind that has no answer."""
    INTERRUPTED = "interrupted"
    """Nothing comes for subscriptions any more; they are to be restored."""
    RESTORED = "restored"
    """Subscriptions that were interrupted are established again."""

    __hash__ = str.__hash__  # that of enums is slow


class Trace(msgspec.Struct, frozen=True, gc=False):
    """Outcome of one packet.

    Attributes:
        at_ns: Time of the outcome.
        outcome: As named.
        endpoint: Of its client; None if its connection is gone.
        hop: None if it went no further.
        header: Of the request, as it came; None if it could not be read.
        error_code: Of the AMS header of the answer.
        took_ns: From the request to the answer.
        text: For operators; it names the hop where there is one.
    """

    at_ns: int
    outcome: Outcome
    endpoint: Endpoint | None
    hop: Endpoint | None
    header: AmsHeader | None
    error_code: int
    took_ns: int
    text: str


MAX_ENDPOINTS = 4096
"""Keys that are counted at a time; the oldest is dropped for a new one."""
MAX_SOURCES = 8
"""NetIDs of clients that are kept for one endpoint."""

KeyT = TypeVar("KeyT", bound=Hashable)


class Traffic(msgspec.Struct):
    """Traffic of one endpoint or route, in one direction of requests.

    Attributes:
        since_ns: When it was used first.
        requests: Sent there, or received from there.
        answers: Received from there, or sent there.
        errors: Requests that did not get to their targets.
        request_bytes: Bytes of the requests.
        answer_bytes: Bytes of the answers.
        round_trip_ns: Of the latest answer.
        last_error: In words.
        last_error_ns: When it was.
        sources: First NetIDs that sent requests.
        is_answered: Whether the latest of the requests that are over was answered.
    """

    since_ns: int = 0
    requests: int = 0
    answers: int = 0
    errors: int = 0
    request_bytes: int = 0
    answer_bytes: int = 0
    round_trip_ns: int = 0
    last_error: str = ""
    sources: tuple[NetId, ...] = ()
    is_answered: bool = False
    last_error_ns: int | None = None

    def add_request(self, octets: int, source: NetId | None = None) -> None:
        """Count a request."""
        self.requests += 1
        self.request_bytes += octets
        if source is not None and source not in self.sources and len(self.sources) < MAX_SOURCES:
            self.sources += (source,)

    def add_answer(self, octets: int, took_ns: int) -> None:
        """Count an answer."""
        self.answers += 1
        self.answer_bytes += octets
        self.round_trip_ns = took_ns
        self.is_answered = True

    def add_error(self, text: str, now_ns: int) -> None:
        """Count a request that did not get to its target."""
        self.errors += 1
        self.last_error, self.last_error_ns = text, now_ns
        self.is_answered = False


class TrafficTable(Generic[KeyT]):
    """Traffic of all endpoints or routes, by key."""

    def __init__(self) -> None:
        self._endpoints: OrderedDict[KeyT, Traffic] = OrderedDict()

    def of(self, endpoint: KeyT, now_ns: int) -> Traffic:
        """Return the traffic of *endpoint*, which may be new."""
        traffic = self._endpoints.get(endpoint)
        if traffic is None:
            if len(self._endpoints) >= MAX_ENDPOINTS:
                self._endpoints.popitem(last=False)
            traffic = self._endpoints[endpoint] = Traffic(now_ns)
        return traffic

    def get(self, endpoint: KeyT) -> Traffic | None:
        """Return a copy of the traffic of *endpoint*, None if it was never used."""
        traffic = self._endpoints.get(endpoint)
        return None if traffic is None else msgspec.structs.replace(traffic)

    def forget(self, endpoint: KeyT) -> None:
        """Leave *endpoint* out from now on: it is closed."""
        self._endpoints.pop(endpoint, None)

    def snapshot(self) -> dict[KeyT, Traffic]:
        """Return a copy of all."""
        return {
            endpoint: msgspec.structs.replace(each) for endpoint, each in self._endpoints.items()
        }


_ANSWERED = Outcome.ANSWERED  # looked up once: members of enums are slow
MAX_EVENTS = 1024
"""Traces that wait to be logged; the oldest is dropped for a new one."""
MAX_LATEST = 256
"""Traces that are kept for later queries."""


class Record:
    """Traces, counters and traffic of a router.

    Requests, and those that were simply answered, are only noted at first: :meth:`settle` counts
    them while packets are on their way.  All that is read here has them.
    """

    def __init__(self) -> None:
        self._latest: deque[Trace] = deque(maxlen=MAX_LATEST)
        self._counts = dict.fromkeys(Outcome, 0)
        self._connections: TrafficTable[Endpoint] = TrafficTable()
        self._routes: TrafficTable[RouteKey] = TrafficTable()
        self._events: deque[Trace] = deque(maxlen=MAX_EVENTS)
        self._request: tuple[Endpoint, int, NetId, int] | None = None
        self._forwarded: tuple[RouteKey, int, int] | None = None
        self._answered: tuple[Trace, Endpoint, RouteKey | None, int] | None = None

    @property
    def latest(self) -> deque[Trace]:
        """The latest traces, the oldest first; without answers to probes."""
        self.settle()
        return self._latest

    @property
    def counts(self) -> dict[Outcome, int]:
        """Packets by outcome."""
        self.settle()
        return self._counts

    @property
    def connections(self) -> TrafficTable[Endpoint]:
        """Requests from each open connection."""
        self.settle()
        return self._connections

    @property
    def routes(self) -> TrafficTable[RouteKey]:
        """Traffic by each route."""
        self.settle()
        return self._routes

    def add_request(self, endpoint: Endpoint, octets: int, source: NetId, at_ns: int) -> None:
        """Add a request of a client with the NetID *source*."""
        self.settle()
        self._request = endpoint, octets, source, at_ns

    def add_forwarded(self, route: RouteKey, octets: int, at_ns: int) -> None:
        """Add a request that was forwarded."""
        if self._forwarded is not None:
            self.settle()
        self._forwarded = route, octets, at_ns

    def add_answered(
        self, trace: Trace, endpoint: Endpoint, route: RouteKey | None, octets: int
    ) -> None:
        """Add the trace of a request that was simply answered.

        Args:
            trace: Without error and text.
            endpoint: Of the client.
            route: That the request was forwarded by.
            octets: Size of the answer.
        """
        if self._answered is not None:
            self.settle()
        self._answered = trace, endpoint, route, octets

    def settle(self) -> None:
        """Count what was noted last."""
        if self._request is not None:
            endpoint, octets, source, at_ns = self._request
            self._request = None
            self._connections.of(endpoint, at_ns).add_request(octets, source)
        if self._forwarded is not None:
            route, octets, at_ns = self._forwarded
            self._forwarded = None
            self._routes.of(route, at_ns).add_request(octets)
        if self._answered is not None:
            trace, endpoint, by, octets = self._answered
            self._answered = None
            self._connections.of(endpoint, trace.at_ns).add_answer(octets, trace.took_ns)
            if by is not None:
                self._routes.of(by, trace.at_ns).add_answer(octets, trace.took_ns)
            self._counts[_ANSWERED] += 1
            if not _is_probe(trace):
                self._latest.append(trace)

    @property
    def has_events(self) -> bool:
        """True if :meth:`next_event` has one."""
        return bool(self._events)

    def next_event(self) -> Trace | None:
        """Take the oldest trace of what was not simply answered."""
        return self._events.popleft() if self._events else None

    def add(self, trace: Trace) -> None:
        """Add the trace of a packet."""
        self.settle()
        self._counts[trace.outcome] += 1
        if _is_probe(trace):
            return
        self._latest.append(trace)
        if trace.outcome is _ANSWERED and not trace.error_code and not trace.text:
            return
        self._events.append(trace)


class Stats(msgspec.Struct, frozen=True):
    """Statistics of a router.

    Attributes:
        in_flight: Requests that wait for their answers.
        subscriptions: Notifications that pass.
        fragment_octets: Kept of packets that are not complete.
        routes: That there are.
        counts: Packets by outcome.
    """

    in_flight: int
    subscriptions: int
    fragment_octets: int
    routes: int
    counts: dict[Outcome, int]


def _is_probe(trace: Trace) -> bool:
    """Return whether a trace is an answered probe of another router, one a second."""
    header = trace.header
    return (
        header is not None
        and header.source_port == PROBE_PORT
        and header.target_port == SYSTEM_PORT
        and trace.outcome is _ANSWERED
        and not trace.error_code
    )


def reason_of(trace: Trace) -> str:
    """Return the text of a trace without the request that it is about."""
    if trace.header is None:
        return trace.text
    return trace.text.removeprefix(f"{describe(trace.header, trace.endpoint)}: ")


def describe(header: AmsHeader, endpoint: Endpoint | None = None) -> str:
    """Return a request in words: service, target and source."""
    where = f" ({endpoint})" if endpoint is not None else ""
    return (
        f"{AmsCommand.name_of(header.command)} of {header.target}:{header.target_port}"
        f" for {header.source}:{header.source_port}{where}"
    )
