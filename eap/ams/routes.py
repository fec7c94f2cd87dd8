"""Routes: transport and address of the next hop to a NetID.

The route with the longest match is taken: all six bytes, five, four, then a default route.  Of two
that match alike the one of the plant file comes first, then those that were added; among equals the
older one.  A learned route is taken only where none of these matches, however well it does itself,
but before a default route: a peer that announces a NetID must not divert packets.
"""

from __future__ import annotations

from bisect import insort
from collections.abc import Collection, Iterator
from enum import IntEnum
from typing import NamedTuple, TypeAlias, TypeVar

import msgspec

from eap.ids import Endpoint, NetId, prefix_text

MAX_LEARNED = 10_000
"""Limit of learned routes; further ones are ignored."""
MAX_FOUND = 1024
"""Limit of the targets whose routes are kept until the next change of the table."""
_LEVELS = (6, 5, 4, 0)
_Key = TypeVar("_Key")
_Item = TypeVar("_Item")


class Origin(IntEnum):
    """Origin of a route; a smaller number goes before a larger one."""

    STATIC = 0
    """The plant file."""
    ADDED = 1
    """An operator or a peer, at run time."""
    LEARNED = 2
    """An info by MQTT, or the answer to a scan; such a route expires."""


RouteKey: TypeAlias = tuple[NetId, Endpoint]
"""NetID and hop of a route."""


class Route(msgspec.Struct, frozen=True):
    """One route.

    Attributes:
        net_id: Of the station, as it is addressed from here.
        name: Of the station or peer.
        hop: Transport and address that packets go to.
        origin: Where it is from.
        octets: How many bytes of a NetID have to be those of *net_id*: 6, 5 or 4; 0 makes it a
            default route.
        is_unidirectional: Whether requests from there are refused.
        expires_at_ns: When it is forgotten; None for never.
        real: The NetID that the station itself has, where *net_id* is a virtual one.
        timeout_ns: How long an answer may take; 0 for as long as usual.
        is_probed: Whether the next hop is probed; a router that answers only peers with a route
            would seem dead.
        router: NetID of the router at the hop; None if that is not known, and the station itself
            is probed instead.
        is_client: Whether its own end requested it by "add route": it may be a client, which has
            connections of its own and does not listen.

    Raises:
        ValueError: a number of bytes that cannot be, or a virtual NetID of a default route.
    """

    net_id: NetId
    name: str
    hop: Endpoint
    origin: Origin = Origin.STATIC
    octets: int = 4
    is_unidirectional: bool = False
    expires_at_ns: int | None = None
    real: NetId | None = None
    timeout_ns: int = 0
    is_probed: bool = True
    router: NetId | None = None
    is_client: bool = False

    def __post_init__(self) -> None:
        if self.octets not in _LEVELS:
            raise ValueError(f"{self.name}: {self.octets} bytes to match, expected 6, 5, 4 or 0")
        if self.real is not None and not self.octets:
            raise ValueError(f"{self.name}: a default route has no virtual NetID")

    @property
    def next_router(self) -> NetId | None:
        """NetID of the router that is probed at the hop; None if unknown."""
        if self.router is not None or not self.octets:
            return self.router
        return self.to_real(self.net_id)

    @property
    def key(self) -> RouteKey:
        """Key of the route in a table."""
        return self.net_id, self.hop

    def to_real(self, target: NetId) -> NetId:
        """Return the NetID that *target* has over there."""
        if self.real is None:
            return target
        return _exchange(target, self.net_id, self.real, self.octets) or target

    def to_virtual(self, source: NetId) -> NetId | None:
        """Return the NetID that *source* over there has here, if this route gives it one."""
        if self.real is None:
            return None
        return _exchange(source, self.real, self.net_id, self.octets)

    def __str__(self) -> str:
        return f"{self.name} ({self.net_id}, {self.hop})"


def _exchange(net_id: NetId, old: NetId, new: NetId, octets: int) -> NetId | None:
    # The longest match first: a NetID of its own goes before that of its station.
    for level in (6, 5, 4):
        if level >= octets and net_id[:level] == old[:level]:
            return NetId(new[:level] + net_id[level:])
    return None


_Rank: TypeAlias = tuple[int, int]
"""Origin, and number in the order of their arrival: the smaller goes first."""


class _Ranked(NamedTuple):
    rank: _Rank
    route: Route


class RouteTable:
    """Table of all routes; a lookup takes the same time however many there are.

    Attributes:
        version: Another one whenever there are other routes.
    """

    def __init__(self, routes: Collection[Route] = ()) -> None:
        self.version = 0
        self._routes: dict[RouteKey, _Ranked] = {}
        self._by_prefix: dict[bytes, list[_Ranked]] = {}
        self._translated: dict[Endpoint, list[Route]] = {}
        self._learned = 0
        self._number = 0
        self._next_expiry: int | None = None
        self._found: dict[NetId, tuple[Route, int] | None] = {}
        for route in routes:
            self.add(route)

    def __len__(self) -> int:
        return len(self._routes)

    def __iter__(self) -> Iterator[Route]:
        return (route for _, route in self._routes.values())

    def add(self, route: Route) -> bool:
        """Take *route* in place of the one with its NetID and hop; return whether it was taken.

        A learned one takes the place of learned ones only.
        """
        key = route.key
        before = self._routes.get(key)
        rank = route.origin.value, self._number
        if before is not None:
            if before.route.origin < route.origin:
                return False
            self.remove(*key)
            # A replaced route keeps its rank among the routes of its origin.
            rank = route.origin.value, before.rank[1]
        elif route.origin is Origin.LEARNED and self._learned >= MAX_LEARNED:
            return False
        self._number += 1
        self.version += 1
        self._found.clear()
        ranked = _Ranked(rank, route)
        self._routes[key] = ranked
        for prefix in _prefixes(route):
            insort(self._by_prefix.setdefault(prefix, []), ranked, key=_rank)
        if route.real is not None:
            self._translated.setdefault(route.hop, []).append(route)
        self._learned += route.origin is Origin.LEARNED
        if route.expires_at_ns is not None:
            known = route.expires_at_ns if self._next_expiry is None else self._next_expiry
            self._next_expiry = min(route.expires_at_ns, known)
        return True

    def remove(self, net_id: NetId, hop: Endpoint) -> bool:
        """Forget a route; return whether there was one."""
        ranked = self._routes.pop((net_id, hop), None)
        if ranked is None:
            return False
        route = ranked.route
        self.version += 1
        self._found.clear()
        for prefix in _prefixes(route):
            _discard(self._by_prefix, prefix, ranked)
        if route.real is not None:
            _discard(self._translated, route.hop, route)
        self._learned -= route.origin is Origin.LEARNED
        return True

    def find(self, target: NetId) -> tuple[Route, int] | None:
        """Return the route to *target*, and how many bytes of its NetID match."""
        try:
            return self._found[target]
        except KeyError:
            pass
        # NetIDs can be invented: what is kept must not grow with them.
        if len(self._found) >= MAX_FOUND:
            self._found.clear()
        found = self._found[target] = self._look_up(target)
        return found

    def _look_up(self, target: NetId) -> tuple[Route, int] | None:
        by_prefix = self._by_prefix
        learned = None
        for level in _LEVELS:
            # A learned route goes before a default route, and behind all others.
            if not level and learned is not None:
                return learned
            ranked = by_prefix.get(target[:level])
            if ranked:
                route = ranked[0].route
                if route.origin is not Origin.LEARNED:
                    return route, level
                learned = learned or (route, level)
        return learned

    def next_name(self, route: Route) -> str:
        """Return the name of the router at the next hop of *route*.

        That of the route itself, unless another router is at the hop: then that of a route to it
        by the same hop, else its NetID.
        """
        router = route.next_router
        if router is None or router.station == route.to_real(route.net_id).station:
            return route.name
        found = self.find(router)
        if found is None or not found[1] or found[0].hop != route.hop:
            return str(router)
        return found[0].name

    def describe_hop(self, route: Route) -> str:
        """Return the next hop of *route* in words: the router there, address and transport."""
        return f"{self.next_name(route)} ({route.hop})"

    def describe_beyond(self, route: Route) -> str:
        """Return in words which routers a failed request by *route* may have failed at."""
        hop = self.describe_hop(route)
        return hop if self.next_name(route) == route.name else f"{hop} or from behind it"

    def to_virtual(self, source: NetId, hop: Endpoint) -> NetId:
        """Return the NetID by which *source*, met at *hop*, is known here."""
        for route in self._translated.get(hop, ()):
            virtual = route.to_virtual(source)
            if virtual is not None:
                return virtual
        return source

    def next_timeout(self) -> int | None:
        """Return when :meth:`expire` may find something."""
        return self._next_expiry

    def expire(self, now_ns: int) -> list[Route]:
        """Remove and return the routes that have expired."""
        if self._next_expiry is None or now_ns < self._next_expiry:
            return []
        times = [(each.expires_at_ns, each) for each in self if each.expires_at_ns is not None]
        over = [route for at_ns, route in times if at_ns <= now_ns]
        self._next_expiry = min((at_ns for at_ns, _ in times if at_ns > now_ns), default=None)
        for route in over:
            self.remove(*route.key)
        return over

    def warnings(self, own: Collection[NetId] = ()) -> list[str]:
        """Return warnings about routes that are shadowed by others.

        Args:
            own: NetIDs of this station, which no route leads to.
        """
        found = [f"route {each} is never taken: the NetID is one of this station"
                 for each in self if each.net_id in own]  # fmt: skip
        for prefix, ranked in self._by_prefix.items():
            first = ranked[0].route
            for _, route in ranked[1:]:
                if route.hop != first.hop:
                    found.append(f"route {route} is not taken for {_text(prefix)}:"
                                 f" {first} is before it")  # fmt: skip
        return found


def _prefixes(route: Route) -> list[bytes]:
    if not route.octets:
        return [b""]
    return [bytes(route.net_id[:level]) for level in (6, 5, 4) if level >= route.octets]


def _text(prefix: bytes) -> str:
    if not prefix:
        return "NetIDs without a route"
    octets = prefix_text(prefix)
    return octets if len(prefix) == 6 else f"NetIDs {octets} without a route of their own"


def _rank(ranked: _Ranked) -> _Rank:
    return ranked.rank


def _discard(lists: dict[_Key, list[_Item]], key: _Key, item: _Item) -> None:
    lists[key].remove(item)
    if not lists[key]:
        del lists[key]
