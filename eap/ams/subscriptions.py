"""Subscriptions of clients to notifications that pass this router.

A notification is no answer: it names only the AMS address of its client, which several programs may
share.  The handle of the server tells them apart.  So each subscription is kept with
the connection of its client; the handle that the client knows stays the same when the server gives
another one, because the subscription was restored.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import NamedTuple

from eap.ams.access import host_of
from eap.ams.routes import Route
from eap.codec.adsnotification import (
    UNIT_NS,
    AddNotification,
    NotificationSample,
    Stamp,
    TransMode,
    decode_notification,
    encode_notification,
)
from eap.codec.ams import ADDRESSES, AmsCommand, AmsHeader, encode_packet
from eap.ids import Endpoint, NetId

MAX_PER_CLIENT = 1024
"""Subscriptions of one AMS address of one connection; TwinCAT's limit as well."""
# A host, which may be another router with all its clients, has at most as many as it leaves: one
# takes a half, two take three quarters, and some remain for others.
MAX_TOTAL = 16_384
"""Of one router."""
_FIRST_OWN_HANDLE = 0xC000_0000
_ON_CHANGE = frozenset((TransMode.SERVER_ON_CHANGE, TransMode.SERVER_ON_CHANGE_2))
_SHORTEST_QUIET_NS = 2_000_000_000
_CHANGE_QUIET_NS = 30_000_000_000
_LONGEST_QUIET_NS = 120_000_000_000


class Grant(NamedTuple):
    """One notification as its server knows it."""

    onward: bytes
    """Address of the server over there, then that of the client, 16 bytes."""
    handle: int
    route: Route
    symbol_handle: int | None = None
    """Of the symbol that it watches, if this router looked it up; it is released at the end."""


class Subscription:
    """One notification of one client.

    Attributes:
        endpoint: Connection of the client.
        addresses: Server and client, as the request of the client has them, 16 bytes.
        handle: That the client knows.
        grant: What the server gave last; None if it is known to be gone.
        request: Parameters, if this router restores the subscription; None if another one does.
        symbol: Request by which the client looked up the symbol that is watched; empty if none.
        is_closed: Whether the client has ended it.
        is_queued: Whether it is to be established again.
        interrupted_at_ns: Since when nothing comes; None while it is established.
        why: Why nothing comes.
        refused_at_ns: Since when the server refuses it with an error that may pass.
        established_at_ns: When the server granted it last.
        received_at_ns: When the latest sample came, or the grant.
        time: Stamp of the latest sample.
        digest: Hash of the latest sample.
        skips_repeat: Whether the next sample is left out if it is the latest one again.
        checks: How many checks in a row found it alive.
        ends: How often the server ended it since the latest sample.
    """

    __slots__ = (
        "addresses",
        "checks",
        "digest",
        "endpoint",
        "ends",
        "established_at_ns",
        "grant",
        "handle",
        "interrupted_at_ns",
        "is_closed",
        "is_queued",
        "received_at_ns",
        "refused_at_ns",
        "request",
        "skips_repeat",
        "symbol",
        "time",
        "why",
    )  # fmt: skip

    def __init__(
        self, endpoint: Endpoint, addresses: bytes, grant: Grant, now_ns: int,
        request: AddNotification | None = None, symbol: bytes = b"",
    ) -> None:  # fmt: skip
        self.endpoint = endpoint
        self.addresses = addresses
        self.handle = grant.handle
        self.grant: Grant | None = grant
        self.request = request
        self.symbol = symbol
        self.is_closed = False
        self.is_queued = False
        self.interrupted_at_ns: int | None = None
        self.why = ""
        self.refused_at_ns: int | None = None
        self.established_at_ns = self.received_at_ns = now_ns
        self.time = 0
        self.digest = 0
        self.skips_repeat = False
        self.checks = 0
        self.ends = 0

    @property
    def server(self) -> NetId:
        """NetID of the server, as the client knows it."""
        return NetId(self.addresses[:6])

    @property
    def is_on_change(self) -> bool:
        """True if samples come only when the value changes."""
        return self.request is not None and self.request.mode in _ON_CHANGE

    def quiet_limit_ns(self) -> int:
        """Return how long no sample may come before it is checked whether there are any."""
        assert self.request is not None  # noqa: S101  for the type
        limit_ns = _CHANGE_QUIET_NS
        if not self.is_on_change:
            usual_ns = (self.request.cycle + self.request.max_delay) * UNIT_NS
            limit_ns = max(_SHORTEST_QUIET_NS, 3 * usual_ns)
        return limit_ns if not self.checks else min(
            limit_ns << min(self.checks, 6), max(limit_ns, _LONGEST_QUIET_NS)
        )  # fmt: skip

    def encode_end(self, now_ns: int) -> bytes:
        """Return the packet that signals the end of the subscription to the client."""
        # In the clock of the server, which may differ: its last stamp plus the time since.
        time = self.time + (now_ns - self.received_at_ns) // UNIT_NS if self.time else 0
        # The end is a sample without bytes, as TwinCAT sends it, alone in its packet, because
        # AdsLib skips what follows such a sample.
        body = encode_notification([Stamp(time, (NotificationSample(self.handle, b""),))])
        server, port, client, client_port = ADDRESSES.unpack(self.addresses)
        header = AmsHeader(NetId(client), client_port, NetId(server), port, AmsCommand.NOTIFICATION)
        return encode_packet(header, body)


class Subscriptions:
    """All subscriptions of one router.

    Attributes:
        hops: How many subscriptions there are by each hop.
    """

    def __init__(self) -> None:
        self.hops: dict[Endpoint, int] = {}
        self._by_grant: dict[tuple[bytes, int], Subscription] = {}
        self._by_client: dict[Endpoint, dict[bytes, dict[int, Subscription]]] = {}
        self._counts: Counter[str] = Counter()
        """By host."""
        self._own_handle = 0
        self._total = 0

    def __len__(self) -> int:
        return self._total

    def __iter__(self) -> Iterator[Subscription]:
        for clients in self._by_client.values():
            for handles in clients.values():
                yield from handles.values()

    def is_within_limits(self, endpoint: Endpoint, addresses: bytes, count: int) -> bool:
        """Return whether a client may have *count* more."""
        mine = self._by_client.get(endpoint, {}).get(addresses, ())
        return (
            len(mine) + count <= MAX_PER_CLIENT
            and self._counts[host_of(endpoint)] + count <= MAX_TOTAL - self._total
        )

    def add(self, subscription: Subscription) -> Subscription | None:
        """Take a new one, and give it a handle that its client does not have yet.

        Returns:
            The one that had its grant; the server does not know that one any more.
        """
        endpoint = subscription.endpoint
        grant, subscription.grant = subscription.grant, None
        displaced = None if grant is None else self._by_grant.get(key_of(grant))
        # One that another router restores is forgotten here: that router requests it again.
        if displaced is not None and displaced.request is None:
            self.remove(displaced)
        elif displaced is not None:
            self.detach(displaced)
        mine = self._by_client.setdefault(endpoint, {}).setdefault(subscription.addresses, {})
        # Two servers behind one address may give the same handle; the client sees distinct ones.
        while subscription.handle in mine:
            subscription.handle = _FIRST_OWN_HANDLE + self._own_handle % (1 << 30)
            self._own_handle += 1
        mine[subscription.handle] = subscription
        self._counts[host_of(endpoint)] += 1
        self._total += 1
        if grant is not None:
            self.attach(subscription, grant)
        return displaced

    def attach(self, subscription: Subscription, grant: Grant) -> Subscription | None:
        """Let the samples of *grant* be for a subscription; return the one that they were for."""
        self.detach(subscription)
        displaced = self._by_grant.get(key_of(grant))
        if displaced is not None:
            self.detach(displaced)
        subscription.grant = grant
        self._by_grant[key_of(grant)] = subscription
        hop = grant.route.hop
        self.hops[hop] = self.hops.get(hop, 0) + 1
        return displaced

    def detach(self, subscription: Subscription) -> Grant | None:
        """Let nothing be for a subscription any more.

        Returns:
            What the server gave for it, unless it has given the same handle to another one.
        """
        grant, subscription.grant = subscription.grant, None
        if grant is None:
            return None
        owner = self._by_grant.get(key_of(grant))
        if owner is not subscription:
            return grant if owner is None else None
        del self._by_grant[key_of(grant)]
        hop = grant.route.hop
        self.hops[hop] -= 1
        if not self.hops[hop]:
            del self.hops[hop]
        return grant

    def suspend(self, subscription: Subscription) -> None:
        """Let nothing be for a subscription, and remember what has to be deleted at its server."""
        subscription.grant = self.detach(subscription)

    def find(self, onward: bytes, handle: int) -> Subscription | None:
        """Return the subscription of a sample with *handle* between the addresses *onward*."""
        return self._by_grant.get((onward, handle))

    def find_of_client(
        self, endpoint: Endpoint, addresses: bytes, handle: int
    ) -> Subscription | None:
        """Return the one that a client knows by *handle*."""
        return self._by_client.get(endpoint, {}).get(addresses, {}).get(handle)

    def remove(self, subscription: Subscription) -> Grant | None:
        """Forget a subscription; return what the server gave for it."""
        endpoint, addresses = subscription.endpoint, subscription.addresses
        clients = self._by_client[endpoint]
        del clients[addresses][subscription.handle]
        if not clients[addresses]:
            del clients[addresses]
        host = host_of(endpoint)
        self._counts[host] -= 1
        if not self._counts[host]:
            del self._counts[host]
        self._total -= 1
        if not clients:
            del self._by_client[endpoint]
        subscription.is_closed = True
        return self.detach(subscription)

    def endpoints(self) -> list[Endpoint]:
        """Return the connections with subscriptions."""
        return list(self._by_client)

    def close(self, endpoint: Endpoint) -> list[Grant]:
        """Forget those of *endpoint*; return what the servers gave for them."""
        mine = [
            each
            for handles in self._by_client.get(endpoint, {}).values()
            for each in handles.values()
        ]
        grants = [self.remove(each) for each in mine]
        return [grant for grant in grants if grant is not None]

    def of_hop(self, transport: str, address: str | None) -> list[Subscription]:
        """Return the subscriptions by a hop, or by any hop of a transport."""
        found = []
        for each in self._by_grant.values():
            hop = each.grant.route.hop if each.grant is not None else None
            if hop is not None and hop.transport == transport and address in {None, hop.connection}:
                found.append(each)
        return found


class Division(NamedTuple):
    """Samples of one notification, divided by client."""

    parts: list[tuple[Endpoint, bytes, bytes]]
    """Connection of a client, the addresses of its request, and the data that it gets."""
    ended: list[Subscription]
    """Subscriptions that their server has ended by a sample without bytes."""
    unknown: list[int]
    """Handles that no client here has."""
    hop: Endpoint | None
    """That samples of known subscriptions came from; None if there are none."""


def divide(
    body: bytes, onward: bytes, subscriptions: Subscriptions, now_ns: int,
    is_from_hop: Callable[[Endpoint], bool],
) -> Division:  # fmt: skip
    """Divide a notification by client connection.

    A handle counts as unknown that was given by another hop than *is_from_hop* says.

    Raises:
        CodecError: the notification is shorter or longer than it says.
    """
    parts: dict[tuple[Endpoint, bytes], list[tuple[int, NotificationSample]]] = {}
    ended: list[Subscription] = []
    unknown: list[int] = []
    hop: Endpoint | None = None
    is_as_it_came = True
    for stamp in decode_notification(body):
        for sample in stamp.samples:
            found = subscriptions.find(onward, sample.handle)
            if found is None or found.grant is None or not is_from_hop(found.grant.route.hop):
                unknown.append(sample.handle)
                is_as_it_came = False
                continue
            hop = found.grant.route.hop
            # A sample without bytes ends a subscription, unless zero bytes were requested.
            if not sample.data and (found.request is None or found.request.length):
                ended.append(found)
                is_as_it_came = False
            elif not _note_sample(found, stamp.time, sample.data, now_ns):
                is_as_it_came = False
            else:
                mine = parts.setdefault((found.endpoint, found.addresses), [])
                if sample.handle == found.handle:
                    mine.append((stamp.time, sample))
                else:
                    mine.append((stamp.time, NotificationSample(found.handle, sample.data)))
                    is_as_it_came = False
    # The usual case, one client and nothing to change: the body is sent without encoding it again.
    if len(parts) == 1 and is_as_it_came:
        bodies = [(*client, body) for client in parts]
    else:
        bodies = [(*client, _join(samples)) for client, samples in parts.items()]
    return Division(bodies, ended, unknown, hop)


def _note_sample(subscription: Subscription, time: int, data: bytes, now_ns: int) -> bool:
    """Note a sample; return whether the client gets it."""
    subscription.received_at_ns = now_ns
    subscription.time = time
    subscription.ends = 0
    if not subscription.is_on_change:
        subscription.checks = 0
        return True
    digest = hash(data)
    is_repeat = subscription.skips_repeat and digest == subscription.digest
    subscription.digest = digest
    subscription.skips_repeat = False
    if not is_repeat:
        subscription.checks = 0
    return not is_repeat


def key_of(grant: Grant) -> tuple[bytes, int]:
    """Return by what samples name a grant."""
    return grant.onward, grant.handle


def _join(samples: list[tuple[int, NotificationSample]]) -> bytes:
    stamps: dict[int, list[NotificationSample]] = {}
    for time, sample in samples:
        stamps.setdefault(time, []).append(sample)
    return encode_notification(Stamp(time, tuple(each)) for time, each in stamps.items())
