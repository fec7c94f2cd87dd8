"""Clients of a gateway: requests that wait, limits of their number and rate, memory of transfers.

A client without an answer repeats its request with the same bytes.  As long as its first request
waits, the second is no other one, and both are answered once; afterwards the same bytes are a new
request, because real clients poll with a constant counter.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from eap.ids import Endpoint

_S = 1_000_000_000


class ClientLimits(NamedTuple):
    """Limits for the clients of a gateway."""

    in_flight: int = 32
    """Requests of one client that wait."""
    rate: int = 0
    """Requests of one client in a second, after a burst of as many; 0 for any number."""
    clients: int = 256
    """Of one gateway; the one that has been silent longest is forgotten for another."""
    in_flight_in_all: int = 512
    """Requests of all clients that wait."""


class MemoryBudget:
    """Bytes that active transfers may hold, limited by host: a host has any number of ports.

    Args:
        in_all: Bytes of all clients.
        of_host: Bytes of one host.

    Attributes:
        held: Bytes that are held now.
    """

    def __init__(self, in_all: int = 64 << 20, of_host: int = 16 << 20) -> None:
        self.held = 0
        self._in_all = in_all
        self._of_host = of_host
        self._hosts: dict[str, int] = {}

    def grant(self, host: str, more: int) -> bool:
        """Change the bytes held by a host by *more*; return False if that exceeds a limit."""
        own = self._hosts.get(host, 0) + more
        # Releasing memory never fails, also above a limit.
        if more > 0 and (own > self._of_host or self.held + more > self._in_all):
            return False
        self.held += more
        if own:
            self._hosts[host] = own
        else:
            self._hosts.pop(host, None)
        return True


class MemoryShare:
    """Part of a budget that one session holds."""

    def __init__(self, budget: MemoryBudget, host: str) -> None:
        self._budget = budget
        self._host = host
        self._held = 0

    def hold(self, size: int) -> bool:
        """Hold *size* bytes instead of those before; return False, and hold those, if too many."""
        if not self._budget.grant(self._host, size - self._held):
            return False
        self._held = size
        return True


class RequestAdmission(Enum):
    """Decision on taking a request."""

    TAKEN = "taken"
    REPEATED = "repeated"
    """The same one waits already: its answer is on the way."""
    CROWDED = "crowded"
    """Too much waits."""
    TOO_FAST = "too fast"
    """Too many came in too short a time."""


class Counts:
    """Counters of one client.

    Attributes:
        requests: That were taken.
        repeated: That waited already, or got their last answer once more.
        errors: Answered by the gateway itself, with an error.
    """

    __slots__ = ("errors", "repeated", "requests")

    def __init__(self) -> None:
        self.requests = self.repeated = self.errors = 0


class _TrackedClient:
    __slots__ = ("counts", "credit", "last_ns", "waiting")

    def __init__(self, credit: float, now_ns: int) -> None:
        self.counts = Counts()
        self.waiting: set[bytes] = set()
        self.credit = credit
        self.last_ns = now_ns


class RequestTracker:
    """All clients of a gateway.

    Args:
        limits: How much it takes on.
    """

    def __init__(self, limits: ClientLimits | None = None) -> None:
        self._limits = limits or ClientLimits()
        self._clients: dict[Endpoint, _TrackedClient] = {}
        self._in_flight = 0

    def set_limits(self, limits: ClientLimits) -> None:
        """Apply other limits to the next requests; what was taken stays."""
        self._limits = limits
        for client in self._clients.values():
            client.credit = limits.rate  # as one that comes new has it

    def admit(self, endpoint: Endpoint, frame: bytes, now_ns: int) -> RequestAdmission:
        """Decide on a request; one that is taken waits until :meth:`answered`.

        Args:
            endpoint: Connection, or address, of the client.
            frame: All bytes of the request.
            now_ns: The time on the monotonic clock.
        """
        client = self._client(endpoint, now_ns)
        if client is None:
            return RequestAdmission.CROWDED
        # A repeat is recognised before any limit: it costs nothing, and its answer is on the way.
        if frame in client.waiting:
            client.counts.repeated += 1
            return RequestAdmission.REPEATED
        limits = self._limits
        is_full = len(client.waiting) >= limits.in_flight
        if is_full or self._in_flight >= limits.in_flight_in_all:
            return RequestAdmission.CROWDED
        if not self._spend_credit(client, now_ns):
            return RequestAdmission.TOO_FAST
        client.waiting.add(frame)
        client.counts.requests += 1
        self._in_flight += 1
        return RequestAdmission.TAKEN

    def answered(self, endpoint: Endpoint, frame: bytes) -> None:
        """Note that a request waits no more, however it ended."""
        client = self._clients.get(endpoint)
        if client is not None and frame in client.waiting:
            client.waiting.discard(frame)
            self._in_flight -= 1

    def waiting(self, endpoint: Endpoint) -> int:
        """Return how many requests of a client wait."""
        client = self._clients.get(endpoint)
        return len(client.waiting) if client else 0

    def counts_of(self, endpoint: Endpoint) -> Counts | None:
        """Return the counters of a known client."""
        client = self._clients.get(endpoint)
        return client.counts if client else None

    def forget(self, endpoint: Endpoint) -> None:
        """Forget a client whose connection is closed."""
        client = self._clients.pop(endpoint, None)
        if client is not None:
            self._in_flight -= len(client.waiting)

    def table(self) -> dict[Endpoint, Counts]:
        """Return all known clients, the most recent one at the end."""
        return {endpoint: client.counts for endpoint, client in self._clients.items()}

    def _client(self, endpoint: Endpoint, now_ns: int) -> _TrackedClient | None:
        client = self._clients.pop(endpoint, None)
        if client is None:
            if len(self._clients) >= self._limits.clients and not self._forget_idle():
                return None
            client = _TrackedClient(self._limits.rate, now_ns)
        self._clients[endpoint] = client  # at the end: the one in front has been silent longest
        return client

    def _forget_idle(self) -> bool:
        for endpoint, client in self._clients.items():
            if not client.waiting:
                del self._clients[endpoint]
                return True
        return False

    def _spend_credit(self, client: _TrackedClient, now_ns: int) -> bool:
        rate = self._limits.rate
        if not rate:
            return True
        # Token bucket: the burst is as large as the rate of one second.
        earned = client.credit + (now_ns - client.last_ns) * rate / _S
        client.credit, client.last_ns = min(rate, earned), now_ns
        if client.credit < 1:
            return False
        client.credit -= 1
        return True


class Ticket:
    """A request that was taken, until it is answered.

    It is given back before the answer goes out: the client may then send the same bytes anew.

    Args:
        tracker: That took it.
        endpoint: Connection, or address, of the client.
        frame: All bytes of the request.
    """

    __slots__ = ("_endpoint", "_frame", "_tracker")

    def __init__(self, tracker: RequestTracker, endpoint: Endpoint, frame: bytes) -> None:
        self._tracker: RequestTracker | None = tracker
        self._endpoint = endpoint
        self._frame = frame

    def release(self) -> None:
        """The request waits no more; harmless the second time."""
        # Called again when the task of the request ends, however that was.
        tracker, self._tracker = self._tracker, None
        if tracker is not None:
            tracker.answered(self._endpoint, self._frame)
