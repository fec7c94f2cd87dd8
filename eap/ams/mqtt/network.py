"""Network of AMS routers behind an MQTT broker, seen by one router (Beckhoff ADS-over-MQTT).

Each router subscribes to its own topics and to the info of all routers, then publishes its info.
The broker keeps a retained message for routers that connect later; where brokers keep none, a
router publishes its info again when it receives that of an unknown one.  The broker publishes the
last will of a router that is gone.  Info that is not repeated for a while is forgotten.  A learned
route is never taken where the plant file or the operator has another one.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from enum import Enum, StrEnum, auto
from typing import NamedTuple, TypeAlias

import msgspec

from eap.ams.mqtt.messages import (
    ClientPorts,
    Info,
    Payload,
    TopicKind,
    Topics,
    decode_info,
    decode_payload,
    encode_info,
    encode_payload,
    is_reply,
    is_request,
)
from eap.ams.routes import Origin, Route, RouteTable
from eap.ams.spec import MqttSpec
from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer, AmsHeader, StateFlags, response_to
from eap.errors import CodecError
from eap.ids import STATION_OCTETS, Endpoint, NetId

MAX_PEERS = 2000
"""Routers that are kept; further ones are ignored."""
EXPIRY_NS = 300_000_000_000
"""Lifetime of an info."""
REFRESH_NS = 120_000_000_000
"""Interval in which all retained infos are requested again."""


class Change(Enum):
    """Change of a router's state by an info."""

    UP = auto()
    DOWN = auto()
    NOTHING = auto()
    IGNORED = auto()
    """MAX_PEERS are known already."""


class _Peer(NamedTuple):
    is_online: bool
    updated_at_ns: int
    route: Route | None


class Peers:
    """The other routers of a network.

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
        """By the bytes that the NetIDs of a station have in common, the first one first."""

    def __len__(self) -> int:
        return len(self._peers)

    def update(self, net_id: NetId, info: Info, now_ns: int) -> Change:
        """Note the info of *net_id*; learn a route to it, if routes are learned."""
        before = self._peers.get(net_id)
        if before is None and len(self._peers) >= MAX_PEERS:
            return Change.IGNORED
        route = None if before is None else before.route
        if info.is_online and not info.is_unidirectional:
            route = self._learn(net_id, info.name, route, now_ns)
        self._peers[net_id] = _Peer(info.is_online, now_ns, route)
        if info.is_online == (before is not None and before.is_online):
            # A router that was never online may have a route in the plant file.
            return Change.DOWN if before is None else Change.NOTHING
        self._list(net_id, is_online=info.is_online)
        return Change.UP if info.is_online else Change.DOWN

    def missing(self) -> list[str]:
        """Return the hops of routes that are not probed and have sent no info yet."""
        online = {str(each) for each, peer in self._peers.items() if peer.is_online}
        needed = {
            each.hop.connection
            for each in self._table
            if each.hop.transport == self._transport and not each.is_probed
            if each.origin is not Origin.LEARNED
        }
        return sorted(needed - online)

    def forget(self, since_ns: int, now_ns: int) -> tuple[list[NetId], list[NetId]]:
        """Forget routers without an info since then; return those online, and the others."""
        silent = [each for each, peer in self._peers.items() if peer.updated_at_ns < since_ns]
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
        known_nearby = self._online.get(source.station, ())
        fifth = source[STATION_OCTETS]
        return str(
            max(known_nearby, key=lambda each: each[STATION_OCTETS] == fifth, default=source)
        )

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
            is_probed=False,  # the broker publishes last wills
        )
        return route if self._table.add(route) else None

    def _list(self, net_id: NetId, *, is_online: bool) -> None:
        known_nearby = self._online.setdefault(net_id.station, [])
        if is_online:
            known_nearby.append(net_id)
        else:
            known_nearby.remove(net_id)
        if not known_nearby:
            del self._online[net_id.station]


MAX_PACKET = 256 << 10
"""Bytes of the longest AMS packet that is taken."""
MAX_SENDERS = 4096
"""Senders whose packet form is kept; the one silent for longest is dropped."""
CONFIRM_NS = 30_000_000_000
"""Time after a connection in which routers have to publish their infos again."""
_SILENCE_NS = 3_600_000_000_000
"""After which a sender without an info is forgotten."""
_ANNOUNCE_GAP_NS = 1_000_000_000
_ANSWER_GAP_NS = 30_000_000_000
"""Since the last own info: the info of a known router in this time needs no answer."""


class Publish(NamedTuple):
    """A message for the broker."""

    topic: str
    payload: bytes
    qos: int
    is_retained: bool = False


class Subscribe(NamedTuple):
    """Topics to be subscribed to, with QoS 2; those of before again, for what is retained."""

    filters: Sequence[str]


class PacketReceived(NamedTuple):
    """A packet for the router."""

    packet: bytes
    connection: str
    """NetID whose topics take the answers."""


class HopDown(NamedTuple):
    """A router is gone: its pending requests fail."""

    address: str
    text: str


class HopUp(NamedTuple):
    """A router is there (again), or nothing is known of it any more."""

    address: str


class PeerClosed(NamedTuple):
    """A sender is forgotten: no answer can reach it."""

    connection: str


class Drop(StrEnum):
    """Reason a message is dropped."""

    TOPIC = auto()
    """Its topic means nothing here, or it has no business there: a request among answers, a packet
    that the broker had kept."""
    BROKEN = auto()
    """Neither a packet nor an info."""
    LENGTH = auto()
    """Longer than any packet may be; a request was answered so."""
    FULL = auto()
    """Info of a router beyond MAX_PEERS."""


class Dropped(NamedTuple):
    """A message was dropped."""

    reason: Drop


class Warn(NamedTuple):
    """Warning for the log, once for each kind."""

    text: str


Action: TypeAlias = (
    Publish | Subscribe | PacketReceived | HopDown | HopUp | PeerClosed | Dropped | Warn
)


class _Sender(NamedTuple):
    is_prefixed: bool
    received_at_ns: int


class MqttNetwork:
    """MQTT messages received and sent by the router of one station.

    Args:
        spec: The network and the broker.
        net_id: Of this station's router.
        name: Of the station.
        transport: Name of the transport by which the network is reached.
        table: Routes of the station.
        learns: Whether routes are added to them.
    """

    def __init__(
        self, spec: MqttSpec, net_id: NetId, name: str, *,
        transport: str, table: RouteTable, learns: bool = True,
    ) -> None:  # fmt: skip
        self._spec = spec
        self._net_id = net_id
        self._info = Info(name, is_online=True, is_unidirectional=spec.is_unidirectional)
        self._topics = Topics(spec.network, net_id)
        self._peers = Peers(net_id, transport, table, learns=learns)
        self._ports = ClientPorts(net_id)
        self._senders: OrderedDict[str, _Sender] = OrderedDict()
        self._connected_at_ns: int | None = None
        self._published_at_ns = 0
        self._publish_at_ns: int | None = None
        self._refresh_at_ns = 0
        self._warned: set[str] = set()

    def will(self) -> Publish:
        """Return the last will of the router."""
        payload = encode_info(self._info._replace(is_online=False))
        return Publish(self._topics.info, payload, 2, not self._spec.no_retain)

    def connected(self, now_ns: int) -> list[Action]:
        """Return the first actions on a new connection, in this order."""
        self._connected_at_ns = now_ns
        # Retained infos may be older than the connection: live routers publish theirs again.
        self._refresh_at_ns = now_ns + CONFIRM_NS
        return [
            *self._report_missing(),
            Subscribe(self._topics.filters),
            # After the subscription: where brokers retain nothing, other routers answer it at once.
            self._publish_info(now_ns),
        ]

    def disconnected(self) -> None:
        """Wait for the next connection."""
        self._connected_at_ns = self._publish_at_ns = None

    def receive_message(
        self, topic: str, payload: bytes, now_ns: int, *, is_retained: bool = False
    ) -> list[Action]:
        """Act on a message; nothing that a peer sends raises.

        Args:
            topic: Where it was published.
            payload: What it carries.
            now_ns: The time on the monotonic clock.
            is_retained: Whether the broker had kept it.
        """
        parsed = self._topics.parse(topic)
        if parsed is None:
            return self._drop(Drop.TOPIC, "unknown topic", topic[:80])
        net_id, kind = parsed
        try:
            if kind is TopicKind.INFO:
                return self._receive_info(net_id, payload, now_ns, is_retained=is_retained)
            if net_id != self._net_id:
                return self._drop(Drop.TOPIC, "unknown topic", topic[:80])
            if is_retained:  # it would be done again at each connection
                return self._drop(Drop.TOPIC, "retained packet", topic)
            return self._receive_packet(kind, decode_payload(payload), now_ns)
        except CodecError as exc:
            what = "info" if kind is TopicKind.INFO else "packet"
            return self._drop(Drop.BROKEN, f"broken {what}", f"{topic}: {exc}")

    def message_for(self, connection: str, packet: bytes) -> Publish:
        """Return the message that brings *packet* to the router with the NetID *connection*."""
        sender = self._senders.get(connection)
        # Open clients differ: some send packets bare, some with the AMS/TCP prefix. Each gets its
        # own.
        is_prefixed = self._spec.is_prefixed if sender is None else sender.is_prefixed
        kind = TopicKind.REQUESTS if is_request(packet) else TopicKind.ANSWERS
        payload = encode_payload(Payload(self._ports.to_network(packet), is_prefixed))
        return Publish(self._topics.of(connection, kind), payload, self._spec.qos)

    def next_timeout(self) -> int | None:
        """Return when :meth:`handle_timeout` has something to do."""
        if self._connected_at_ns is None:
            return None
        if self._publish_at_ns is None:
            return self._refresh_at_ns
        return min(self._publish_at_ns, self._refresh_at_ns)

    def handle_timeout(self, now_ns: int) -> list[Action]:
        """Publish this router's info, request the others, forget routers that are gone."""
        actions: list[Action] = []
        if self._connected_at_ns is None:
            return actions
        if now_ns >= self._refresh_at_ns:
            self._refresh_at_ns = now_ns + REFRESH_NS
            actions += self._forget(max(self._connected_at_ns, now_ns - EXPIRY_NS), now_ns)
            # A repeated subscription makes the broker send again what it retains.
            actions.append(Subscribe((self._topics.all_info,)))
            if self._spec.no_retain:
                self._publish_at_ns = now_ns
        if self._publish_at_ns is not None and now_ns >= self._publish_at_ns:
            actions.append(self._publish_info(now_ns))
        return actions

    def _receive_info(
        self, net_id: NetId, payload: bytes, now_ns: int, *, is_retained: bool
    ) -> list[Action]:
        info = decode_info(payload)
        if net_id == self._net_id:
            return self._receive_own_info(info, now_ns, is_retained=is_retained)
        address = str(net_id)
        change = self._peers.update(net_id, info, now_ns)
        if change is Change.IGNORED:
            return self._drop(Drop.FULL, "one router too many", address)
        if change is Change.DOWN:
            return [HopDown(address, "its info says that it is offline"), PeerClosed(address)]
        actions: list[Action] = [HopUp(address)] if change is Change.UP else []
        is_due = change is Change.UP or now_ns - self._published_at_ns >= _ANSWER_GAP_NS
        if self._spec.no_retain and info.is_online and is_due:
            actions += self._schedule_info(now_ns)
        return actions

    def _receive_own_info(self, info: Info, now_ns: int, *, is_retained: bool) -> list[Action]:
        if not info.is_online:
            return self._schedule_info(now_ns)  # the last will of a connection before this one
        # The own info comes back from the broker.
        if info == self._info or is_retained:
            return []
        text = f"{info.name!r} announces the NetID {self._net_id}, which is this station's"
        return self._warn("double", f"{text}; each router of a network needs one of its own")

    def _receive_packet(self, kind: TopicKind, payload: Payload, now_ns: int) -> list[Action]:
        packet = payload.packet
        header = AmsHeader.decode(packet)
        if kind is TopicKind.ANSWERS and not is_reply(packet):
            # Brokers may allow writes there to clients that may not send requests.
            return self._drop(Drop.TOPIC, "request on the topic for answers", str(header.source))
        address = self._peers.address_of(header.source)
        actions = self._note_sender(address, payload, now_ns)
        if len(packet) > MAX_PACKET:
            text = f"{header.source}: {len(packet)} bytes"
            actions += self._drop(Drop.LENGTH, "too long a packet", text)
            return actions + self._refuse(header, address, AdsError.AMS_LENGTH)
        return [*actions, PacketReceived(self._ports.to_client(packet), address)]

    def _note_sender(self, address: str, payload: Payload, now_ns: int) -> list[Action]:
        """Remember the form that *address* uses."""
        self._senders[address] = _Sender(payload.is_prefixed, now_ns)
        self._senders.move_to_end(address)
        if len(self._senders) <= MAX_SENDERS:
            return []
        oldest, _ = self._senders.popitem(last=False)
        return [PeerClosed(oldest)]

    def _refuse(self, header: AmsHeader, address: str, error: AdsError) -> list[Action]:
        if header.state_flags & (StateFlags.RESPONSE | StateFlags.NO_RETURN):
            return []
        packet = response_to(header, AmsAnswer(error_code=error))
        return [self.message_for(address, packet)]

    def _forget(self, since_ns: int, now_ns: int) -> list[Action]:
        were_there, were_not = self._peers.forget(since_ns, now_ns)
        actions: list[Action] = []
        for net_id in were_there:
            actions.append(HopDown(str(net_id), "it has sent no info for too long"))
            actions.append(PeerClosed(str(net_id)))
        actions += [HopUp(str(net_id)) for net_id in (*were_there, *were_not)]
        actions += self._report_missing()
        while self._senders:
            address, sender = next(iter(self._senders.items()))
            if now_ns - sender.received_at_ns < _SILENCE_NS:
                break
            del self._senders[address]
            actions.append(PeerClosed(address))
        return actions

    def _report_missing(self) -> list[Action]:
        return [HopDown(each, "it has sent no info yet") for each in self._peers.missing()]

    def _publish_info(self, now_ns: int) -> Publish:
        self._published_at_ns = now_ns
        self._publish_at_ns = None
        return self.will()._replace(payload=encode_info(self._info))

    def _schedule_info(self, now_ns: int) -> list[Action]:
        # One info a second at most, however many routers connect at once.
        self._publish_at_ns = max(now_ns, self._published_at_ns + _ANNOUNCE_GAP_NS)
        return [self._publish_info(now_ns)] if now_ns >= self._publish_at_ns else []

    def _drop(self, reason: Drop, kind: str, text: str) -> list[Action]:
        warning = self._warn(kind, f"{kind}: {text}; from now on these are only counted")
        return [Dropped(reason), *warning]

    def _warn(self, kind: str, text: str) -> list[Action]:
        if kind in self._warned:
            return []
        self._warned.add(kind)
        return [Warn(text)]
