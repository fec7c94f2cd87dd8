"""Routers of a network that told of themselves by MQTT, and the routes that are learned from it.

A broker keeps what each of them told, and tells it again to who asks; what is not told again for a
while is forgotten.  A learned route is never taken where the plant file, or somebody, has another.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import NamedTuple

import msgspec

from eap.ads.endpoint import Endpoint
from eap.ams.mqtt.info import Info
from eap.ams.routes import Origin, Route, RouteTable
from eap.ids import STATION_OCTETS, NetId

MAX_PEERS = 2000
"""Routers that are remembered; who comes later is not."""
EXPIRY_NS = 300_000_000_000
"""How long what a router told counts."""
REFRESH_NS = 120_000_000_000
"""Between two times that all are asked for."""


class Change(Enum):
    """What is new of a router."""

    UP = auto()
    DOWN = auto()
    NOTHING = auto()
    IGNORED = auto()
    """There is no room to remember it."""


class _Peer(NamedTuple):
    is_online: bool
    told_at_ns: int
    route: Route | None


class Peers:
    """The other routers.

    Args:
        net_id: Of this station's router.
        transport: By which they are reached.
        table: Routes of this station.
        learns: Whether routes are added to them.
    """

    def __init__(
        self, net_id: NetId, transport: str, table: RouteTable, *, learns: bool = True
    ) -> None:
        self._net_id = net_id
        self._transport = transport
        self._table = table
        self._learns = learns
        self._peers: dict[NetId, _Peer] = {}
        self._online: dict[bytes, list[NetId]] = {}
        """By the octets that the NetIDs of a station have in common, the first one first."""

    def __len__(self) -> int:
        return len(self._peers)

    def tell(self, net_id: NetId, info: Info, now_ns: int) -> Change:
        """Note what *net_id* told; learn a route to it, if routes are learned."""
        before = self._peers.get(net_id)
        if before is None and len(self._peers) >= MAX_PEERS:
            return Change.IGNORED
        route = None if before is None else before.route
        if info.is_online and not info.is_unidirectional:
            route = self._learn(net_id, info.name, route, now_ns)
        self._peers[net_id] = _Peer(info.is_online, now_ns, route)
        if info.is_online == (before is not None and before.is_online):
            # Who was never there may all the same have a route in the plant file.
            return Change.DOWN if before is None else Change.NOTHING
        self._list(net_id, is_online=info.is_online)
        return Change.UP if info.is_online else Change.DOWN

    def awaited(self) -> list[str]:
        """Return the hops that some route needs, nothing asks for life, and have not told yet."""
        there = {str(each) for each, peer in self._peers.items() if peer.is_online}
        needed = {
            each.hop.connection
            for each in self._table
            if each.hop.transport == self._transport and not each.is_probed
            if each.origin is not Origin.LEARNED
        }
        return sorted(needed - there)

    def forget(self, since_ns: int, now_ns: int) -> tuple[list[NetId], list[NetId]]:
        """Forget who told nothing since then; return who of them was there, and who was not."""
        silent = [each for each, peer in self._peers.items() if peer.told_at_ns < since_ns]
        were_there, were_not = [], []
        for net_id in silent:
            peer = self._peers.pop(net_id)
            if peer.route is not None:
                # Not removed: in its place there may be one that is not learned by now.
                self._table.add(msgspec.structs.replace(peer.route, expires_at_ns=now_ns))
            if peer.is_online:
                self._list(net_id, is_online=False)
                were_there.append(net_id)
            else:
                were_not.append(net_id)
        return were_there, were_not

    def address_of(self, source: NetId) -> str:
        """Return the NetID of the router that *source* is behind; its own if none is known."""
        if source in self._peers:
            return str(source)
        near = self._online.get(source.station, ())
        fifth = source[STATION_OCTETS]
        return str(max(near, key=lambda each: each[STATION_OCTETS] == fifth, default=source))

    def _learn(self, net_id: NetId, name: str, known: Route | None, now_ns: int) -> Route | None:
        """Return the route, new or with more time; None if there cannot be one."""
        if not self._learns:
            return None
        expires_at_ns, name = now_ns + EXPIRY_NS, name or str(net_id)
        if known is not None and known.name == name:
            left_ns = (known.expires_at_ns or 0) - now_ns
            if left_ns > EXPIRY_NS - REFRESH_NS // 2:
                return known  # routes that change too often make work
        route = Route(
            net_id,
            name,
            Endpoint(self._transport, str(net_id)),
            Origin.LEARNED,
            # Another router on this computer; this station's own NetIDs stay its own.
            octets=6 if net_id.station == self._net_id.station else STATION_OCTETS,
            expires_at_ns=expires_at_ns,
            is_probed=False,  # the broker tells who is gone
        )
        return route if self._table.add(route) else None

    def _list(self, net_id: NetId, *, is_online: bool) -> None:
        near = self._online.setdefault(net_id.station, [])
        if is_online:
            near.append(net_id)
        else:
            near.remove(net_id)
        if not near:
            del self._online[net_id.station]
