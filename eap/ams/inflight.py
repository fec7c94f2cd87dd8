"""Requests that wait for their answers: by invoke id, by connection and by deadline."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator

from eap.ads.endpoint import Endpoint
from eap.ams.authorized_request import AuthorizedRequest
from eap.ams.routes import Route
from eap.codec.ams import AmsHeader


class Pending:
    """A request that was passed on.

    Attributes:
        invoke_id: That it has now; unique here.
        header: As it came.
        came_by: Where it came from and its answer goes; None when nobody waits any more.
        route: How it went on; None to a service of this station.
        onward: Source and target of the packet that went on, 16 octets.
        at_ns: When it came.
        deadline_ns: When its time is up.
        handles: How many notifications it asks for.
        asked_for: What it asks for, if a subscription is restored by it here later: its body.
        step: That of a restoration which the request is; None for a client's.
        authorized: What access rules say of it, where its answer matters to them.
    """

    __slots__ = (
        "asked_for",
        "at_ns",
        "authorized",
        "came_by",
        "deadline_ns",
        "handles",
        "header",
        "invoke_id",
        "onward",
        "route",
        "step",
    )  # fmt: skip

    def __init__(
        self, invoke_id: int, header: AmsHeader, came_by: Endpoint | None, route: Route | None,
        onward: bytes, at_ns: int, deadline_ns: int,
    ) -> None:  # fmt: skip
        self.invoke_id = invoke_id
        self.header = header
        self.came_by = came_by
        self.route = route
        self.onward = onward
        self.at_ns = at_ns
        self.deadline_ns = deadline_ns
        self.handles = 0
        self.asked_for = b""
        self.step: object | None = None
        self.authorized: AuthorizedRequest | None = None


class InFlight:
    """All that waits.

    Each of its requests is found by invoke id, and by who asked what, in the same time however
    many there are.
    """

    def __init__(self) -> None:
        self._by_id: dict[int, Pending] = {}
        self._by_way: dict[Endpoint, dict[int, Pending]] = {}
        self._by_door: dict[str, int] = {}
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
        return list(self._by_way)

    def count(self, endpoint: Endpoint) -> int:
        """Return how many came by *endpoint*."""
        return len(self._by_way.get(endpoint, ()))

    def count_of_door(self, transport: str) -> int:
        """Return how many came by any connection of *transport*."""
        return self._by_door.get(transport, 0)

    def add(self, pending: Pending) -> None:
        """Remember a request."""
        endpoint = pending.came_by
        key = pending.invoke_id
        self._by_id[key] = pending
        if endpoint is not None:
            self._by_way.setdefault(endpoint, {})[key] = pending
            self._by_door[endpoint.transport] = self._by_door.get(endpoint.transport, 0) + 1
            self._asked[endpoint, pending.onward, pending.header.invoke_id] = key
        elif pending.step is None:
            self._abandoned[key] = None
        # The times allowed are few, so that each has its requests in the order of their deadlines.
        allowed = pending.deadline_ns - pending.at_ns
        self._by_time.setdefault(allowed, OrderedDict())[key] = pending

    def is_asked(self, endpoint: Endpoint, onward: bytes, invoke_id: int) -> bool:
        """Say whether a request with these addresses and this id of its client waits."""
        return (endpoint, onward, invoke_id) in self._asked

    def pop(self, invoke_id: int) -> Pending | None:
        """Forget and return the request with this id."""
        pending = self._by_id.pop(invoke_id, None)
        if pending is None:
            return None
        self._leave(pending)
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
        left = list(self._by_way.get(endpoint, {}).values())
        for pending in left:
            self._leave(pending)
            pending.came_by = None
            self._abandoned[pending.invoke_id] = None
        return left

    def make_room(self) -> bool:
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

    def _leave(self, pending: Pending) -> None:
        endpoint = pending.came_by
        if endpoint is None:
            return
        of_way = self._by_way[endpoint]
        del of_way[pending.invoke_id]
        if not of_way:
            del self._by_way[endpoint]
        self._by_door[endpoint.transport] -= 1
        asked = endpoint, pending.onward, pending.header.invoke_id
        if self._asked.get(asked) == pending.invoke_id:
            del self._asked[asked]
