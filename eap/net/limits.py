"""Limits of peers: connections of all listeners of a process, and rates of what peers cause.

A core without I/O.  A driver registers each listener, asks for admission of each connection that it
accepted, and closes what the policy names.  Requests without a connection, log lines and audit
lines have a rate for each source and for all of them together.

Rule 1: a listener has a fixed number of places.  Some are reserved for programs of this host, and
one other host has at most its share.
Rule 2: when no place is left, a connection that is not in use loses its place: of the newcomer's
own host, or of a host that holds more than the newcomer's host.  First of the host that holds most,
there first one that was never used, then the one that has been silent longest.
Rule 3: if rule 2 finds none, one in use loses its place, but only to a host that holds fewer
connections even afterwards; and one of a program of this host never does, unless it was just
accepted.  In use is a connection with requests under way or a subscription, used within the last
10 s, or accepted within 3 s.
If rule 3 finds none, the oldest of those that were just accepted from the newcomer's own host
loses its place: a burst of connections does not lock out the host that it comes from.  For a
newcomer of this host the last resort is one in use of this host, the least active that has been
silent longest: no program locks the others of its host out by connections that it uses.
Rule 4: a peer that leaves a frame unfinished, or takes no answers, is overdue after 10 s.
"""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Collection, Iterable
from enum import IntEnum, StrEnum
from ipaddress import IPv4Address
from typing import NamedTuple, Protocol

OWN_HOST = ""
"""The host of connections from programs of this machine."""
SILENT_NS = 10_000_000_000
"""A connection that was used within this time is in use."""
FRESH_NS = 3_000_000_000
"""So is one that was accepted within this time: its first request may be on its way."""
OVERDUE_NS = 10_000_000_000
"""Time that a peer has to finish a frame, or to take answers."""


class Activity(IntEnum):
    """Use of a connection."""

    UNUSED = 0
    """No complete frame has arrived on it."""
    IDLE = 1
    """Nothing is under way."""
    BUSY = 2
    """Requests wait for their answers."""
    SUBSCRIBED = 3


class CloseReason(StrEnum):
    """Reason why a driver closes a connection of the table."""

    EVICTED = "evicted: another connection needs its place"
    OVERDUE = "too slow: the peer left a frame unfinished, or took no answers"
    ENDED = "the appliance ends"


class Connection(Protocol):
    """View of a connection by the policy and by its driver."""

    @property
    def host(self) -> str:
        """Address of the peer, or another key for counting shares; OWN_HOST for this host."""

    @property
    def activity(self) -> Activity:
        """Current use."""

    @property
    def used_at_ns(self) -> int:
        """Time of the last complete frame, or of its acceptance."""

    @property
    def late_since_ns(self) -> int | None:
        """Time since which a frame is unfinished or answers are not taken, None if neither."""

    def close(self, why: CloseReason) -> None:
        """Close it at once, in any state; called by the driver, never by the policy."""


class ListenerLimits(NamedTuple):
    """Places of one listener."""

    total: int = 128
    reserved: int = 32
    """Of these, kept free for programs of this host."""
    per_host: int = 32
    """Of these, for one other host."""


class ListenerStats(NamedTuple):
    """Figures of one listener since its process started."""

    name: str
    open: int
    limit: int
    refused: int
    evicted: int
    """Connections closed to make room for others."""
    overdue: int
    """Connections closed because a frame stayed unfinished or answers were not taken."""
    crowded_at_ns: int | None = None
    """Time of the last connection that was refused or evicted."""


class AcceptDecision(NamedTuple):
    """Outcome for a connection that was accepted."""

    refusal: str = ""
    """Reason why it has to be closed, empty for an admitted one."""
    victim: Connection | None = None
    """Connection whose place it takes, which has to be closed; the table has forgotten it."""


class Listener:
    """One listener with its connections; made by :meth:`ConnectionTable.add_listener`."""

    def __init__(self, name: str, limits: ListenerLimits) -> None:
        self.name = name
        self.limits = limits
        self.refused = 0
        self.evicted = 0
        self.overdue = 0
        self.crowded_at_ns: int | None = None
        self.connections: dict[Connection, None] = {}
        self.by_host: Counter[str] = Counter()

    @property
    def stats(self) -> ListenerStats:
        """Return the current figures."""
        return ListenerStats(
            self.name,
            len(self.connections),
            self.limits.total,
            self.refused,
            self.evicted,
            self.overdue,
            self.crowded_at_ns,
        )

    def find_shortage(self, host: str) -> tuple[str, Collection[Connection]]:
        """Return why a connection of *host* finds no free place, and the connections in its way.

        The reason is empty if there is a place.
        """
        total, reserved, per_host = self.limits
        if host != OWN_HOST:
            if self.by_host[host] >= per_host:
                mine = [each for each in self.connections if each.host == host]
                return f"{host} has {len(mine)} connections, its share", mine
            # Many hosts together must not take the places that are kept for this one, even if each
            # is within its share.
            foreign = len(self.connections) - self.by_host[OWN_HOST]
            if reserved and foreign >= total - reserved:
                others = [each for each in self.connections if each.host != OWN_HOST]
                return f"other hosts have {foreign} connections, their share", others
        if len(self.connections) >= total:
            return f"all {total} places are taken", self.connections
        return "", ()


class ConnectionTable:
    """All connections that one process accepted, by listener."""

    def __init__(self) -> None:
        self.listeners: list[Listener] = []

    def add_listener(self, name: str, limits: ListenerLimits) -> Listener:
        """Return a new listener."""
        listener = Listener(name, limits)
        self.listeners.append(listener)
        return listener

    def remove_listener(self, listener: Listener) -> None:
        """Remove a listener whose connections have ended."""
        self.listeners.remove(listener)

    def admit(
        self, listener: Listener, connection: Connection, now_ns: int, *, spare_descriptors: int
    ) -> AcceptDecision:
        """Admit *connection* to *listener*, or return the reason that it gets no place.

        Args:
            listener: Where it was accepted.
            connection: Keeps its place until :meth:`remove` or its eviction.
            now_ns: The time on the monotonic clock.
            spare_descriptors: Descriptors that the process may still open beside its reserve.
        """
        reason, in_the_way = listener.find_shortage(connection.host)
        if not reason and spare_descriptors <= 0:
            reason, in_the_way = "no file descriptors are left beside the reserve", self._all()
        victim = None
        if reason:
            victim = _find_victim(in_the_way, connection.host, now_ns)
            if victim is None:
                listener.refused += 1
                listener.crowded_at_ns = now_ns
                return AcceptDecision(reason)
            self._evict(victim, now_ns)
        listener.connections[connection] = None
        listener.by_host[connection.host] += 1
        return AcceptDecision(victim=victim)

    def shed(self, now_ns: int) -> Connection | None:
        """Forget and return the connection that rule 2 or 3 names, None if there is none.

        For a process that has no descriptor left even to accept a connection.
        """
        victim = _find_victim(self._all(), OWN_HOST, now_ns)
        if victim is not None:
            self._evict(victim, now_ns)
        return victim

    def remove(self, listener: Listener, connection: Connection) -> None:
        """Free the place of a connection that has ended; an evicted one has none."""
        if connection in listener.connections:
            del listener.connections[connection]
            listener.by_host[connection.host] -= 1
            if not listener.by_host[connection.host]:
                del listener.by_host[connection.host]

    def remove_overdue(self, now_ns: int, timeout_ns: int = OVERDUE_NS) -> list[Connection]:
        """Forget and return the connections that have to be closed by rule 4."""
        found = []
        for listener in self.listeners:
            for each in list(listener.connections):
                late_ns = each.late_since_ns
                if late_ns is not None and now_ns - late_ns >= timeout_ns:
                    listener.overdue += 1
                    self.remove(listener, each)
                    found.append(each)
        return found

    def _all(self) -> list[Connection]:
        return [each for listener in self.listeners for each in listener.connections]

    def _evict(self, connection: Connection, now_ns: int) -> None:
        listener = next(each for each in self.listeners if connection in each.connections)
        listener.evicted += 1
        listener.crowded_at_ns = now_ns
        self.remove(listener, connection)


def _find_victim(
    candidates: Iterable[Connection], newcomer_host: str, now_ns: int
) -> Connection | None:
    """Return the connection that loses its place to one of *newcomer_host*, None if none may."""
    pool = list(candidates)
    held = Counter(each.host for each in pool)
    mine = held[newcomer_host]
    victim, best = None, None
    for each in pool:
        count = held[each.host]
        is_fresh = each.activity is Activity.UNUSED and now_ns - each.used_at_ns < FRESH_NS
        if is_fresh or _is_in_use(each, now_ns):
            # More than one above: with a difference of one the two hosts would only change places,
            # and evict each other in turn.
            if (is_fresh or each.host != OWN_HOST) and count > mine + 1:
                order = 1
            elif is_fresh and each.host == newcomer_host:
                order = 2
            elif each.host == newcomer_host == OWN_HOST:
                order = 3
            else:
                continue
        elif each.host == newcomer_host or count > mine:
            order = 0
        else:
            continue
        # The lowest rank loses: by rule, then of the host that holds most, least active, oldest.
        rank = order, -count, each.activity, each.used_at_ns
        if best is None or rank < best:
            victim, best = each, rank
    return victim


def _is_in_use(connection: Connection, now_ns: int) -> bool:
    activity = connection.activity
    if activity is Activity.IDLE:
        return now_ns - connection.used_at_ns < SILENT_NS
    return activity is not Activity.UNUSED


def host_of(peer: str, own: str) -> str:
    """Return the host of a peer with address *peer* that reached *own*, an address of ours."""
    return OWN_HOST if peer == own or IPv4Address(peer).is_loopback else peer


class RateLimiter:
    """Token bucket: *burst* at once, refilled with *per_s* a second."""

    def __init__(self, burst: int, per_s: float, now_s: float) -> None:
        self._burst = burst
        self._per_s = per_s
        self._left = float(burst)
        self._at_s = now_s

    def take(self, now_s: float) -> bool:
        """Take one token; return whether there was one."""
        passed_s = max(0.0, now_s - self._at_s)
        self._at_s = now_s
        self._left = min(self._burst, self._left + passed_s * self._per_s)
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Rate(NamedTuple):
    """Rate limit: *burst* at once, and *per_s* a second in the long run."""

    burst: int
    per_s: float


class SourceRates(NamedTuple):
    """Rates of a :class:`SourceRateLimiter`."""

    source: Rate
    """Limit of each source."""
    known: Rate
    """Limit of all sources together that are known."""
    new: Rate
    """Limit of all new sources together: datagrams can come from any number of addresses."""
    local: Rate
    """Limit of this host, which other sources do not use up."""


class SourceRateLimiter:
    """Rate limits by source address, and for all sources together.

    A source that uses up its own rate, or the common rate of known sources, leaves the rates of
    new sources and of this host as they are.

    Args:
        rates: The limits.
        max_sources: Number of known sources; the one silent for longest is forgotten.
        now_s: Current time, in seconds.
    """

    def __init__(self, rates: SourceRates, max_sources: int, now_s: float) -> None:
        self._rate = rates.source
        self._max_sources = max_sources
        self._known = RateLimiter(*rates.known, now_s)
        self._new = RateLimiter(*rates.new, now_s)
        self._local = RateLimiter(*rates.local, now_s)
        self._sources: OrderedDict[str, RateLimiter] = OrderedDict()

    def take_local(self, now_s: float) -> bool:
        """Take a token of this host; return whether there was one."""
        return self._local.take(now_s)

    def take(self, source: str, now_s: float) -> bool:
        """Take a token for *source*; return whether its own limit and the common one allow it."""
        own = self._sources.get(source)
        if own is not None:
            # In order of use, so that the first entry is the one silent for longest.
            self._sources.move_to_end(source)
            return own.take(now_s) and self._known.take(now_s)
        # Before an entry is made: a flood from invented addresses must not evict known sources.
        if not self._new.take(now_s):
            return False
        if len(self._sources) >= self._max_sources:
            self._sources.popitem(last=False)
        own = self._sources[source] = RateLimiter(*self._rate, now_s)
        return own.take(now_s)
