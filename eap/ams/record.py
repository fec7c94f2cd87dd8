"""What a router remembers of what it did: counts, traffic by way, and the latest traces."""

from __future__ import annotations

from collections import deque

import msgspec

from eap.ads.endpoint import Endpoint
from eap.ams.action import Outcome, Trace
from eap.ams.hop_prober import PROBE_PORT
from eap.ams.routes import RouteKey
from eap.ams.traffic import TrafficTable
from eap.codec.ams import SYSTEM_PORT, AmsCommand, AmsHeader

_ANSWERED = Outcome.ANSWERED  # looked up once: members of enums are slow
MAX_EVENTS = 1024
"""Traces that wait for somebody who reads them; the oldest makes room."""
MAX_LATEST = 256
"""Traces that are kept for people who ask later."""


class Record:
    """The memory of a router.

    Attributes:
        latest: The latest traces, the oldest first; without answers to probes.
        counts: Packets by what became of them.
        connections: What was asked from each, which have not been closed.
        routes: What went by each.
    """

    def __init__(self) -> None:
        self.latest: deque[Trace] = deque(maxlen=MAX_LATEST)
        self.counts = dict.fromkeys(Outcome, 0)
        self.connections: TrafficTable[Endpoint] = TrafficTable()
        self.routes: TrafficTable[RouteKey] = TrafficTable()
        self._events: deque[Trace] = deque(maxlen=MAX_EVENTS)

    @property
    def has_events(self) -> bool:
        """Whether :meth:`next_event` has one."""
        return bool(self._events)

    def next_event(self) -> Trace | None:
        """Take the oldest trace of what was not simply answered."""
        return self._events.popleft() if self._events else None

    def enter(self, trace: Trace) -> None:
        """Remember what became of a packet."""
        self.counts[trace.outcome] += 1
        if _is_life(trace):
            return
        self.latest.append(trace)
        if trace.outcome is _ANSWERED and not trace.error_code and not trace.text:
            return
        self._events.append(trace)


class Stats(msgspec.Struct, frozen=True):
    """What a router does and did.

    Attributes:
        in_flight: Requests that wait for their answers.
        subscriptions: Notifications that pass.
        fragment_octets: Kept of packets that are not complete.
        routes: That there are.
        counts: Packets by what became of them.
    """

    in_flight: int
    subscriptions: int
    fragment_octets: int
    routes: int
    counts: dict[Outcome, int]


def _is_life(trace: Trace) -> bool:
    """Say whether a router was told that this one lives, as it is every second."""
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
    return trace.text.removeprefix(f"{describe(trace.header, trace.came_by)}: ")


def describe(header: AmsHeader, endpoint: Endpoint | None = None) -> str:
    """Return a request in words: service, target and source."""
    where = f" ({endpoint})" if endpoint is not None else ""
    return (
        f"{AmsCommand.name_of(header.command)} of {header.target}:{header.target_port}"
        f" for {header.source}:{header.source_port}{where}"
    )
