"""Requests that wait for their answers, their invoke IDs, and packets that run in a circle.

AoE has no hop count.  The first router gives each forwarded request an invoke ID of its own and the
routers behind it keep that ID, so each router recognizes a request that it has forwarded already.
Such an ID differs from those of clients, which count from 1, by its upper ten bits: they follow
from the lower bits and are never all 0 (own format; other peers treat an invoke ID as opaque).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Container, Iterator

from eap.ads.endpoint import Endpoint
from eap.ams.access_filter import AuthorizedRequest
from eap.ams.routes import Route
from eap.codec.ams import AmsHeader

_SERIAL_BITS = 22
_SERIALS = 1 << _SERIAL_BITS
_FACTOR = 2654435761
"""Knuth's multiplier: neighbours get upper bits that have nothing in common."""


class InvokeIds:
    """Gives ids one after the other; one comes again after four millions.

    Args:
        first: Where to begin; another number at each start keeps the answers to what an earlier
            process asked from being taken for those of this one.
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
    """Say whether a router gave this id."""
    return invoke_id >> _SERIAL_BITS == _mark(invoke_id & _SERIALS - 1)


def _mark(serial: int) -> int:
    return (serial * _FACTOR >> 12 & 0x3FF) or 1


MAX_PASSED = 1024
"""Packets that are remembered; one that runs in a circle comes again long before so many others."""


class LoopDetector:
    """The latest packets, by invoke id and addresses."""

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
    """A request that was passed on.

    Attributes:
        invoke_id: That it has now; unique here.
        header: As it came.
        endpoint: Where it came from and its answer goes; None when nobody waits any more.
        route: How it went on; None to a service of this station.
        onward: Source and target of the packet that went on, 16 bytes.
        at_ns: When it came.
        deadline_ns: When its time is up.
        handles: How many notifications it asks for.
        request_body: What it asks for, if a subscription is restored by it here later: its body.
        step: That of a restoration which the request is; None for a client's.
        authorized: What access rules say of it, where its answer matters to them.
    """

    __slots__ = (
        "at_ns",
        "authorized",
        "deadline_ns",
        "endpoint",
        "handles",
        "header",
        "invoke_id",
        "onward",
        "request_body",
        "route",
        "step",
    )  # fmt: skip

    def __init__(
        self, invoke_id: int, header: AmsHeader, endpoint: Endpoint | None, route: Route | None,
        onward: bytes, at_ns: int, deadline_ns: int,
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
        self.authorized: AuthorizedRequest | None = None


class InFlight:
    """All that waits.

    Each of its requests is found by invoke id, and by who asked what, in the same time however
    many there are.
    """

    def __init__(self) -> None:
        self._by_id: dict[int, Pending] = {}
        self._by_endpoint: dict[Endpoint, dict[int, Pending]] = {}
        self._by_transport: dict[str, int] = {}
        self._by_time: dict[int, OrderedDict[int, Pending]] = {}
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
        """Return by which ways there came requests that wait."""
        return list(self._by_endpoint)

    def count(self, endpoint: Endpoint) -> int:
        """Return how many came by *endpoint*."""
        return len(self._by_endpoint.get(endpoint, ()))

    def count_of_transport(self, transport: str) -> int:
        """Return how many came by any connection of *transport*."""
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
            self._asked[endpoint, pending.onward, pending.header.invoke_id] = key
        elif pending.step is None:
            self._abandoned[key] = None
        # The times allowed are few, so that each has its requests in the order of their deadlines.
        allowed = pending.deadline_ns - pending.at_ns
        self._by_time.setdefault(allowed, OrderedDict())[key] = pending

    def has_request(self, endpoint: Endpoint, onward: bytes, invoke_id: int) -> bool:
        """Say whether a request with these addresses and this id of its client waits."""
        return (endpoint, onward, invoke_id) in self._asked

    def pop(self, invoke_id: int) -> Pending | None:
        """Forget and return the request with this id."""
        pending = self._by_id.pop(invoke_id, None)
        if pending is None:
            return None
        self._detach(pending)
        self._abandoned.pop(invoke_id, None)
        allowed = pending.deadline_ns - pending.at_ns
        waiting = self._by_time[allowed]
        del waiting[invoke_id]
        if not waiting:
            del self._by_time[allowed]
        return pending

    def abandon(self, endpoint: Endpoint) -> list[Pending]:
        """Return the requests that came by *endpoint*; nobody waits for their answers any more.

        They stay until their time is up: a packet that runs in a circle is still known.
        """
        left = list(self._by_endpoint.get(endpoint, {}).values())
        for pending in left:
            self._detach(pending)
            pending.endpoint = None
            self._abandoned[pending.invoke_id] = None
        return left

    def drop_abandoned(self) -> bool:
        """Forget the oldest request that nobody waits for; return whether there was one."""
        if not self._abandoned:
            return False
        self.pop(next(iter(self._abandoned)))
        return True

    def on(self, transport: str, address: str | None) -> list[Pending]:
        """Return what went on by *transport*, to *address* or to any."""
        return [
            each
            for each in self
            if each.route is not None
            and each.route.hop.transport == transport
            and address in {None, each.route.hop.connection}
        ]

    def next_timeout(self) -> int | None:
        """Return when the time of the first one is up."""
        heads = (next(iter(each.values())).deadline_ns for each in self._by_time.values())
        return min(heads, default=None)

    def due(self, now_ns: int) -> list[Pending]:
        """Return those whose time is up, the first one first."""
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
        key = endpoint, pending.onward, pending.header.invoke_id
        if self._asked.get(key) == pending.invoke_id:
            del self._asked[key]
