"""Probes of the next hops in the background, so that no request waits for a dead hop.

A probe reads the ADS state of the hop's router.  Any answer, an error too, shows that the hop is
alive, and so does the answer to a forwarded request.  A hop that misses two probes in a row is down
until it answers again.

A hop with subscriptions is also probed for the restart index of its system service: a changed index
shows that the router was restarted and has lost what it forwarded, although the hop may never have
been silent for long.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from eap.ams.routes import RouteTable
from eap.codec.ads import AdsRange, AdsSystemState, IndexGroup
from eap.codec.ams import SYSTEM_PORT, AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId

PROBE_PORT = 1
"""AMS port of this router for answers to probes."""
MISSES = 2
"""Probes without an answer after which a hop is dead."""
# A router that was cut off for as long subscribes again when it is back.
GONE_NS = 60_000_000_000
"""Time after which a dead hop counts as gone: its notifications are ended."""
_BUSY = 5
"""A hop that answers requests is probed only in every fifth interval, for its round trip."""
# With many hops each is probed less often.
_SPACING_NS = 10_000_000
"""Smallest mean gap between two probes."""


_STATE = AdsRange(IndexGroup.SYSTEM_STATE, 0, AdsSystemState.SIZE).encode()
_HEAD = 8
"""Bytes of result and length before what is read."""


class Probe(NamedTuple):
    """Probe that is due."""

    hop: Endpoint
    packet: bytes
    is_found_dead: bool
    """True if the missed probes before it make the hop dead, which it was not yet."""
    is_gone: bool = False
    """True in one report, when the hop has been dead for GONE_NS."""


class _Hop:
    """State of one hop."""

    __slots__ = (
        "answered_at_ns",
        "gone_at_ns",
        "has_restart_index",
        "is_down",
        "misses",
        "number",
        "probed_at_ns",
        "restart_index",
        "round_trip_ns",
        "target",
    )  # fmt: skip

    def __init__(self, number: int, target: NetId) -> None:
        self.number = number
        self.target = target
        self.probed_at_ns: int | None = None
        self.answered_at_ns = -1
        self.misses = 0
        self.is_down = False
        self.gone_at_ns: int | None = None
        self.round_trip_ns: int | None = None
        self.has_restart_index = True
        self.restart_index: int | None = None

    def is_due(self, now_ns: int, interval_ns: int) -> bool:
        """Return whether to probe it in this interval."""
        if self.is_down or self.answered_at_ns < 0 or self.probed_at_ns is None:
            return True
        is_busy = now_ns - self.answered_at_ns < interval_ns
        return now_ns - self.probed_at_ns >= interval_ns * (_BUSY if is_busy else 1)


class HopProber:
    """Probes the hops of a route table.

    Attributes:
        watched: Hops by which subscriptions come.

    Args:
        net_id: Of the router that probes.
        table: The routes; those with *is_probed* count.
        interval_ns: Between two probes of a hop.
    """

    def __init__(self, net_id: NetId, table: RouteTable, interval_ns: int = 1_000_000_000) -> None:
        self._net_id = net_id
        self._table = table
        self._interval_ns = interval_ns
        self._hops: dict[Endpoint, _Hop] = {}
        self._by_number: dict[int, Endpoint] = {}
        self._paused: set[Endpoint] = set()
        self._closed: set[str] = set()
        self._schedule: list[tuple[int, int]] = []
        self._number = 0
        self._version = -1
        self.watched: Container[Endpoint] = ()

    def pause(self, transport: str, address: str | None) -> None:
        """Stop probing: the transport itself knows that the hop is unreachable."""
        if address is None:
            self._closed.add(transport)
        else:
            self._paused.add(Endpoint(transport, address))

    def resume(self, transport: str, address: str | None) -> None:
        """Probe again, and count the hop as alive until it misses probes."""
        if address is None:
            self._closed.discard(transport)
        else:
            self._paused.discard(Endpoint(transport, address))
        for endpoint, hop in self._hops.items():
            if endpoint.transport == transport and address in {None, endpoint.connection}:
                hop.probed_at_ns, hop.misses, hop.is_down = None, 0, False
                hop.restart_index, hop.has_restart_index = None, True

    def note_answer(self, hop: Endpoint, now_ns: int) -> None:
        """Note that a hop answered a request."""
        known = self._hops.get(hop)
        if known is not None:
            known.answered_at_ns = now_ns
            known.misses = 0

    def is_answer(self, header: AmsHeader) -> bool:
        """Return whether a response is for the prober."""
        return header.target_port == PROBE_PORT and header.target == self._net_id

    def receive_answer(
        self, header: AmsHeader, body: bytes, endpoint: Endpoint, now_ns: int,
        is_from: Callable[[Endpoint, Endpoint], bool],
    ) -> Endpoint | None:  # fmt: skip
        """Note an answer: its hop is alive.

        Args:
            header: Of the answer.
            body: What follows the header.
            endpoint: That it arrived by.
            now_ns: The time on the monotonic clock.
            is_from: Returns whether a packet from an endpoint may come from a hop.

        Returns:
            The hop, if its router was restarted since the previous answer.
        """
        hop = self._by_number.get(header.invoke_id)
        if hop is None or not is_from(hop, endpoint):
            return None
        # Errors count as well: a router that refuses the read is alive.
        self.note_answer(hop, now_ns)
        known = self._hops[hop]
        known.is_down = False
        if header.command == AmsCommand.READ:
            return hop if _has_restarted(known, header, body) else None
        if known.probed_at_ns is not None:
            known.round_trip_ns = now_ns - known.probed_at_ns
        return None

    def is_dead(self, hop: Endpoint) -> bool:
        """Return whether a hop does not answer."""
        known = self._hops.get(hop)
        return known is not None and known.is_down

    def has_answered(self, hop: Endpoint) -> bool:
        """Return whether a hop is probed, and has ever answered."""
        known = self._hops.get(hop)
        return known is not None and known.answered_at_ns >= 0

    def round_trip_ns(self, hop: Endpoint) -> int | None:
        """Return the last round trip of a hop; None if it is not probed or does not answer."""
        known = self._hops.get(hop)
        return None if known is None or known.is_down else known.round_trip_ns

    def next_timeout(self) -> int | None:
        """Return when :meth:`probes_due` has something; at once if the routes changed."""
        if self._version != self._table.version:
            return 0
        return self._schedule[0][0] if self._schedule else None

    def probes_due(self, now_ns: int) -> Iterator[Probe]:
        """Yield the probes that are due."""
        if self._version != self._table.version:
            self._follow_table(now_ns)
        interval_ns = max(self._interval_ns, len(self._hops) * _SPACING_NS)
        while self._schedule and self._schedule[0][0] <= now_ns:
            _, number = heappop(self._schedule)
            endpoint = self._by_number[number]
            heappush(self._schedule, (now_ns + interval_ns, number))
            hop = self._hops[endpoint]
            # Without an open probe the first one after the pause counts no miss.
            if endpoint in self._paused or endpoint.transport in self._closed:
                hop.probed_at_ns = None
            elif endpoint in self.watched or hop.is_due(now_ns, interval_ns):
                yield self._probe(endpoint, hop, now_ns)
                # A router that restarts between two probes misses none, but has lost its
                # subscriptions.
                if endpoint in self.watched and hop.has_restart_index and not hop.is_down:
                    yield Probe(endpoint, self._header(hop, AmsCommand.READ) + _STATE, False)

    def _probe(self, endpoint: Endpoint, hop: _Hop, now_ns: int) -> Probe:
        if hop.probed_at_ns is not None and hop.answered_at_ns < hop.probed_at_ns:
            hop.misses += 1
        hop.probed_at_ns = now_ns
        is_found_dead = hop.misses >= MISSES and not hop.is_down
        hop.is_down = hop.is_down or is_found_dead
        if is_found_dead:
            # Its subscriptions are restored anyhow, and another router may answer next.
            hop.restart_index, hop.has_restart_index = None, True
            hop.gone_at_ns = now_ns + GONE_NS
        is_gone = hop.is_down and hop.gone_at_ns is not None and now_ns >= hop.gone_at_ns
        if is_gone:
            hop.gone_at_ns = None
        return Probe(endpoint, self._header(hop, AmsCommand.READ_STATE), is_found_dead, is_gone)

    def _header(self, hop: _Hop, command: AmsCommand) -> bytes:
        return AmsHeader(
            hop.target, SYSTEM_PORT, self._net_id, PROBE_PORT, command,
            length=len(_STATE) if command == AmsCommand.READ else 0, invoke_id=hop.number,
        ).encode()  # fmt: skip

    def _follow_table(self, now_ns: int) -> None:
        self._version = self._table.version
        before, self._hops = self._hops, {}
        for route in self._table:
            target = route.next_router
            if route.is_probed and target is not None and route.hop not in self._hops:
                hop = before.get(route.hop)
                if hop is None or hop.target != target:
                    self._number += 1
                    hop = _Hop(self._number, target)
                    self._schedule.append((now_ns, hop.number))
                self._hops[route.hop] = hop
        self._by_number = {hop.number: endpoint for endpoint, hop in self._hops.items()}
        self._schedule = [each for each in self._schedule if each[1] in self._by_number]
        heapify(self._schedule)


def _has_restarted(hop: _Hop, header: AmsHeader, body: bytes) -> bool:
    """Note a restart index; return whether it has changed."""
    if header.error_code or any(body[:4]) or len(body) < _HEAD + AdsSystemState.SIZE:
        hop.has_restart_index = False
        return False
    before, now = hop.restart_index, AdsSystemState.decode(body, _HEAD).restart_index
    hop.restart_index = now
    return before not in {None, now}
