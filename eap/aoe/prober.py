"""Which next hops are alive: asked in the background, so that nobody waits for a dead one.

A hop is asked for the ADS state of its router; whatever it answers, an error too, it is alive, and
so it is while it answers requests that pass.  What misses two questions in a row is down until it
answers again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from eap.aoe.routes import RouteTable
from eap.aoe.way import Way
from eap.codec.ams import SYSTEM_PORT, AmsCommand, AmsHeader
from eap.ids import NetId

PROBE_PORT = 1
"""AMS port of this router that answers to probes go to."""
MISSES = 2
"""Questions without an answer that make a hop a dead one."""
_BUSY = 5
"""A hop that answers requests is asked only every so many turns: how long its router takes."""
_SPACING_NS = 10_000_000
"""Between two probes at least, on the average: many hops are asked less often."""


class Probe(NamedTuple):
    """A question that is due."""

    hop: Way
    packet: bytes
    is_found_dead: bool
    """Whether the questions before it make the hop a dead one, which it was not yet."""


class _Hop:
    """What is known of one hop."""

    __slots__ = ("asked_at_ns", "heard_at_ns", "is_down", "misses", "number", "round_trip_ns",
                 "target")  # fmt: skip

    def __init__(self, number: int, target: NetId) -> None:
        self.number = number
        self.target = target
        self.asked_at_ns: int | None = None
        self.heard_at_ns = -1
        self.misses = 0
        self.is_down = False
        self.round_trip_ns: int | None = None

    def is_due(self, now_ns: int, interval_ns: int) -> bool:
        """Say whether to ask it, when its turn has come."""
        if self.is_down or self.heard_at_ns < 0 or self.asked_at_ns is None:
            return True
        is_busy = now_ns - self.heard_at_ns < interval_ns
        return now_ns - self.asked_at_ns >= interval_ns * (_BUSY if is_busy else 1)


class Prober:
    """Asks the hops of a table of routes.

    Args:
        net_id: Of the router that asks.
        table: The routes; those with *is_probed* count.
        interval_ns: Between two questions to a hop.
    """

    def __init__(self, net_id: NetId, table: RouteTable, interval_ns: int = 1_000_000_000) -> None:
        self._net_id = net_id
        self._table = table
        self._interval_ns = interval_ns
        self._hops: dict[Way, _Hop] = {}
        self._by_number: dict[int, Way] = {}
        self._paused: set[Way] = set()
        self._closed: set[str] = set()
        self._turns: list[tuple[int, int]] = []
        self._number = 0
        self._version = -1

    def pause(self, door: str, address: str | None) -> None:
        """Ask no more: the door itself knows that there is no way."""
        if address is None:
            self._closed.add(door)
        else:
            self._paused.add(Way(door, address))

    def resume(self, door: str, address: str | None) -> None:
        """Ask again, and take the hop for alive until it misses questions."""
        if address is None:
            self._closed.discard(door)
        else:
            self._paused.discard(Way(door, address))
        for way, hop in self._hops.items():
            if way.door == door and address in {None, way.connection}:
                hop.asked_at_ns, hop.misses, hop.is_down = None, 0, False

    def hear(self, hop: Way, now_ns: int) -> None:
        """Note that a hop answered a request."""
        known = self._hops.get(hop)
        if known is not None:
            known.heard_at_ns = now_ns
            known.misses = 0

    def is_answer(self, header: AmsHeader) -> bool:
        """Say whether a response is for the prober."""
        return header.target_port == PROBE_PORT and header.target == self._net_id

    def take_answer(
        self, header: AmsHeader, way: Way, now_ns: int, is_from: Callable[[Way, Way], bool]
    ) -> None:
        """Note an answer: its hop is alive.

        Args:
            header: Of the answer.
            way: That it came by.
            now_ns: The time on the monotonic clock.
            is_from: Says of a hop and a way whether it may come from there.
        """
        hop = self._by_number.get(header.invoke_id)
        if hop is None or not is_from(hop, way):
            return
        self.hear(hop, now_ns)
        known = self._hops[hop]
        known.is_down = False
        if known.asked_at_ns is not None:
            known.round_trip_ns = now_ns - known.asked_at_ns

    def is_dead(self, hop: Way) -> bool:
        """Say whether a hop does not answer."""
        known = self._hops.get(hop)
        return known is not None and known.is_down

    def is_heard(self, hop: Way) -> bool:
        """Say whether a hop is asked, and has ever answered anything."""
        known = self._hops.get(hop)
        return known is not None and known.heard_at_ns >= 0

    def round_trip_ns(self, hop: Way) -> int | None:
        """Return how long a hop took to answer last; None if it is not asked or does not."""
        known = self._hops.get(hop)
        return None if known is None or known.is_down else known.round_trip_ns

    def next_timeout(self) -> int | None:
        """Return when :meth:`probes_due` has something; at once if the routes changed."""
        if self._version != self._table.version:
            return 0
        return self._turns[0][0] if self._turns else None

    def probes_due(self, now_ns: int) -> Iterator[Probe]:
        """Yield the questions to ask now."""
        if self._version != self._table.version:
            self._follow_table(now_ns)
        interval_ns = max(self._interval_ns, len(self._hops) * _SPACING_NS)
        while self._turns and self._turns[0][0] <= now_ns:
            _, number = heappop(self._turns)
            way = self._by_number[number]
            heappush(self._turns, (now_ns + interval_ns, number))
            hop = self._hops[way]
            if way in self._paused or way.door in self._closed:
                hop.asked_at_ns = None
            elif hop.is_due(now_ns, interval_ns):
                yield self._ask(way, hop, now_ns)

    def _ask(self, way: Way, hop: _Hop, now_ns: int) -> Probe:
        if hop.asked_at_ns is not None and hop.heard_at_ns < hop.asked_at_ns:
            hop.misses += 1
        hop.asked_at_ns = now_ns
        is_found_dead = hop.misses >= MISSES and not hop.is_down
        hop.is_down = hop.is_down or is_found_dead
        header = AmsHeader(
            hop.target, SYSTEM_PORT, self._net_id, PROBE_PORT, AmsCommand.READ_STATE,
            invoke_id=hop.number,
        )  # fmt: skip
        return Probe(way, header.encode(), is_found_dead)

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
                    self._turns.append((now_ns, hop.number))
                self._hops[route.hop] = hop
        self._by_number = {hop.number: way for way, hop in self._hops.items()}
        self._turns = [each for each in self._turns if each[1] in self._by_number]
        heapify(self._turns)
