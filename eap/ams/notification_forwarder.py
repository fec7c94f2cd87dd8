"""Notifications across a router: requests and answers are tracked, samples go to their clients.

The first router on the path keeps the parameters that it needs to restore a subscription
(``subscription_restorer``): it is the one whose client has a connection to it and whose request
bears no mark of another router.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Callable, Iterable, Sequence
from struct import Struct
from typing import NamedTuple

from eap.ams.inflight import InFlight, InvokeIds, Pending, RouterLimits, is_marked
from eap.ams.subscriptions import MAX_PER_CLIENT, Grant, Subscription, Subscriptions, divide
from eap.ams.transport_table import Action, Reply, TransportTable
from eap.codec.ads import AdsError, AdsReadWrite, IndexGroup
from eap.codec.adsnotification import AddNotification, decode_notification
from eap.codec.ams import ADDRESSES, AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.ids import Endpoint, NetId

_WRITE = Struct("<III")  # group, offset, length


class NotificationCleanup:
    """Ends notifications at their servers when no client here has them any more.

    A client may be gone, may have got its answer too late, or may have used a router that was
    restarted since; without this the server would send samples for ever.

    Args:
        transports: By which requests are sent.
        in_flight: Requests that wait for an answer, these too.
        ids: Of requests of this router.
        limits: How much may wait, and for how long.
    """

    def __init__(
        self, transports: TransportTable, in_flight: InFlight, ids: InvokeIds, limits: RouterLimits
    ) -> None:
        self._transports = transports
        self._in_flight = in_flight
        self._ids = ids
        self._limits = limits

    def end(self, grants: Iterable[Grant], now_ns: int) -> list[Action]:
        """End notifications, as far as the limit of requests in flight allows."""
        actions: list[Action] = []
        for grant in grants:
            if grant.route.hop.transport not in self._transports.transports:
                continue
            if (
                len(self._in_flight) >= self._limits.in_flight
                and not self._in_flight.drop_abandoned()
            ):
                break
            handle = grant.handle.to_bytes(4, "little")
            # As a request of this router: nothing goes back to the client, which may be gone.
            actions.append(self._ask(grant, AmsCommand.DELETE_NOTIFICATION, handle, now_ns))
            actions += self.release(grant, now_ns)
        return actions

    def release(self, grant: Grant, now_ns: int) -> list[Action]:
        """Release the handle of a symbol that this router looked up."""
        if grant.symbol_handle is None:
            return []
        handle = grant.symbol_handle.to_bytes(4, "little")
        body = _WRITE.pack(IndexGroup.RELEASE_HANDLE, 0, len(handle)) + handle
        return [self._ask(grant, AmsCommand.WRITE, body, now_ns)]

    def end_unwanted(self, header: AmsHeader, handle: int, endpoint: Endpoint) -> list[Action]:
        """Return the request that ends a notification without a client here, at its server."""
        # The sample of a notification may overtake the answer with its handle.
        if any(pending.handles for pending in self._in_flight.on(endpoint.transport, None)):
            return []
        head = AmsHeader(
            header.source,
            header.source_port,
            header.target,
            header.target_port,
            AmsCommand.DELETE_NOTIFICATION,
            StateFlags.ADS | StateFlags.NO_RETURN,
        )
        return [self._transports.reply(endpoint, encode_packet(head, handle.to_bytes(4, "little")))]

    def _ask(self, grant: Grant, command: AmsCommand, body: bytes, now_ns: int) -> Action:
        invoke_id = self._ids.allocate(self._in_flight)
        header = header_to(grant.onward, command, invoke_id)
        route, deadline_ns = grant.route, now_ns + self._limits.timeout_ns
        self._in_flight.add(
            Pending(invoke_id, header, None, route, grant.onward, now_ns, deadline_ns)
        )
        return self._transports.forward(route.hop, encode_packet(header, body), invoke_id)


def header_to(addresses: bytes, command: int, invoke_id: int) -> AmsHeader:
    """Return the header of a request with the *addresses* of its server and its client."""
    target, target_port, source, source_port = ADDRESSES.unpack(addresses)
    return AmsHeader(
        NetId(target), target_port, NetId(source), source_port, command, invoke_id=invoke_id
    )


_GRANTED = struct.Struct("<II")  # result, handle
_HANDLE = 4
_ADD = AmsCommand.ADD_NOTIFICATION.value  # plain numbers: members of enums are slow
_DELETE = AmsCommand.DELETE_NOTIFICATION.value
_READ_WRITE = AmsCommand.READ_WRITE.value
TRACKED_COMMANDS = frozenset((_ADD, _DELETE, _READ_WRITE))
"""Commands that may be about notifications."""
_LOOKUPS = frozenset(
    (
        IndexGroup.SYMBOL_HANDLE.value,
        IndexGroup.SYMBOL_BY_NAME.value,
        IndexGroup.SYMBOL_ENTRY_BY_NAME.value,
    )
)
"""Groups whose ReadWrite returns group and offset of a symbol."""
_SUM_ADD = IndexGroup.SUM_ADD_NOTIFICATION.value
_SUM_DELETE = IndexGroup.SUM_DELETE_NOTIFICATION.value
_SUM_HEAD = 8
"""Bytes of result and length before the answers to the items of a sum command."""
_MAX_SYMBOLS = 1024
"""Symbol handles kept for one connection; the oldest one is dropped for a new one."""
_LONGEST_LOOKUP = 272
_PLACE = struct.Struct("<II")  # group, offset
BY_HANDLE = frozenset((IndexGroup.VALUE_BY_HANDLE, IndexGroup.SYMBOL_NOTIFICATION))
"""Groups whose offset is the handle of a symbol."""
_LENGTH = slice(20, 24)


class Granted(NamedTuple):
    """Consequences of the answer to a request for notifications."""

    body: bytes
    """As the client gets it: with the handles that it knows."""
    surplus: list[Grant]
    """Notifications that no client waits for any more."""
    new: list[Subscription]
    displaced: list[Subscription]
    """Subscriptions whose handle the server gave again: it has forgotten them."""


class Samples(NamedTuple):
    """Consequences of a notification."""

    replies: list[Reply]
    ended: list[Subscription]
    """Subscriptions that their server has ended."""
    unknown: list[int]
    """Handles that no client here has."""
    hop: Endpoint | None
    """That samples of known subscriptions came from; None if there are none."""


class NotificationForwarder:
    """Tracks requests for notifications and their answers, and forwards samples.

    Attributes:
        subscriptions: All that pass this router.
    """

    def __init__(self, transports: TransportTable) -> None:
        self.subscriptions = Subscriptions()
        self._transports = transports
        self._symbols: dict[Endpoint, OrderedDict[tuple[bytes, int, int], bytes]] = {}

    def find_deleted(
        self, header: AmsHeader, data: bytes, endpoint: Endpoint
    ) -> list[Subscription] | None:
        """Return the subscriptions of this client that a request deletes.

        None says that it deletes nothing that is known here.
        """
        handles = deleted_handles(header, data)
        if not handles:
            return None
        addresses = data[: ADDRESSES.size]
        find = self.subscriptions.find_of_client
        found = [find(endpoint, addresses, handle) for handle in handles]
        return [each for each in found if each is not None] or None

    def is_within_limits(self, header: AmsHeader, data: bytes, endpoint: Endpoint) -> bool:
        """Return whether the limits allow the notifications that a client requests."""
        count = _count_of(header, data[AmsHeader.SIZE :])
        return not count or self.subscriptions.is_within_limits(
            endpoint, data[: ADDRESSES.size], count
        )

    def track_request(self, pending: Pending, body: bytes, endpoint: Endpoint) -> None:
        """Note the notifications that a client requests, and the symbol that it looks up."""
        header = pending.header
        pending.handles = _count_of(header, body)
        if pending.handles or _group_of(header, body) in _LOOKUPS:
            transport = self._transports.transports[endpoint.transport]
            # Where clients have no connection it is never known that they are gone.
            is_first = (transport.is_stream or transport.is_shared) and not is_marked(
                header.invoke_id
            )
            pending.request_body = body if is_first else b""

    def track_answer(
        self, pending: Pending, header: AmsHeader, body: bytes, now_ns: int
    ) -> Granted | None:
        """Note the notifications that were granted, if any were requested."""
        endpoint, route = pending.endpoint, pending.route
        if header.error_code or route is None:
            return None
        if not pending.handles:
            if pending.request_body and endpoint is not None:
                self._note_symbol(pending, body, endpoint)
            return None
        start = 0 if header.command == AmsCommand.ADD_NOTIFICATION else _SUM_HEAD
        granted = Granted(body, [], [], [])
        addresses = _addresses(pending.header)
        requests = _requests_of(pending)
        for number in range(pending.handles):
            at = start + number * _GRANTED.size
            if at + _GRANTED.size > len(body):
                break
            result, handle = _GRANTED.unpack_from(body, at)
            if result:
                continue
            grant = Grant(pending.onward, handle, route)
            # The client closed its connection, or has its time-out: nothing may stay at the server.
            if endpoint is None:
                granted.surplus.append(grant)
                continue
            request = requests[number] if requests else None
            symbol = self._symbol_of(endpoint, addresses, request)
            subscription = Subscription(endpoint, addresses, grant, now_ns, request, symbol)
            displaced = self.subscriptions.add(subscription)
            granted.new.append(subscription)
            if displaced is not None:
                granted.displaced.append(displaced)
            # The client has this handle already, from another server: it gets one of this router.
            if subscription.handle != handle:
                new = subscription.handle.to_bytes(_HANDLE, "little")
                body = body[: at + _HANDLE] + new + body[at + _GRANTED.size :]
        return granted._replace(body=body)

    def forget(self, subscriptions: Iterable[Subscription]) -> list[Grant]:
        """Remove deleted subscriptions; return their grants."""
        grants = [self.subscriptions.remove(each) for each in subscriptions if not each.is_closed]
        return [grant for grant in grants if grant is not None]

    def knows(self, header: AmsHeader, body: bytes) -> bool:
        """Return whether a client here subscribed to a sample of a notification.

        Raises:
            CodecError: it is shorter or longer than it says.
        """
        onward = _back(header)
        handles = (sample.handle for stamp in decode_notification(body) for sample in stamp.samples)
        return any(self.subscriptions.find(onward, handle) is not None for handle in handles)

    def distribute(
        self, header: AmsHeader, data: bytes, now_ns: int, is_from_hop: Callable[[Endpoint], bool]
    ) -> Samples:
        """Return the part of a notification for each client.

        Raises:
            CodecError: it is shorter or longer than it says.
        """
        body = data[AmsHeader.SIZE :]
        division = divide(body, _back(header), self.subscriptions, now_ns, is_from_hop)
        replies = []
        for endpoint, addresses, part in division.parts:
            length = len(part).to_bytes(4, "little")
            head = data[ADDRESSES.size : _LENGTH.start] + length
            packet = (
                addresses[8:] + addresses[:8] + head + data[_LENGTH.stop : AmsHeader.SIZE] + part
            )
            replies.append(self._transports.reply(endpoint, packet))
        return Samples(replies, division.ended, division.unknown, division.hop)

    def close(self, endpoint: Endpoint) -> list[Grant]:
        """Remove the clients of a connection; return their grants."""
        self._symbols.pop(endpoint, None)
        return self.subscriptions.close(endpoint)

    def _note_symbol(self, pending: Pending, body: bytes, endpoint: Endpoint) -> None:
        place = symbol_location(pending.request_body, body)
        if place is None or len(pending.request_body) > _LONGEST_LOOKUP:
            return
        mine = self._symbols.setdefault(endpoint, OrderedDict())
        # A handle is valid at one server only, so the addresses belong to the key.
        key = _addresses(pending.header), *place
        mine[key] = pending.request_body
        mine.move_to_end(key)
        if len(mine) > _MAX_SYMBOLS:
            mine.popitem(last=False)

    def _symbol_of(
        self, endpoint: Endpoint, addresses: bytes, request: AddNotification | None
    ) -> bytes:
        mine = self._symbols.get(endpoint)
        if request is None or mine is None:
            return b""
        # A handle may be watched by either of two groups; it is stored by one of them.
        group = IndexGroup.VALUE_BY_HANDLE if request.group in BY_HANDLE else request.group
        return mine.get((addresses, group, request.offset), b"")


def symbol_location(lookup: bytes, answer: bytes) -> tuple[int, int] | None:
    """Return group and offset of a symbol from the answer to its *lookup*, None if it has none."""
    group = int.from_bytes(lookup[:4], "little")
    if group == IndexGroup.SYMBOL_HANDLE:
        if len(answer) < _SUM_HEAD + _HANDLE or any(answer[:4]):
            return None
        handle = int.from_bytes(answer[_SUM_HEAD : _SUM_HEAD + _HANDLE], "little")
        return IndexGroup.VALUE_BY_HANDLE, handle
    # An entry has its length before group and offset.
    at = _SUM_HEAD + (4 if group == IndexGroup.SYMBOL_ENTRY_BY_NAME else 0)
    if len(answer) < at + _PLACE.size or any(answer[:4]):
        return None
    found: tuple[int, int] = _PLACE.unpack_from(answer, at)
    return found


def deleted_handles(header: AmsHeader, data: bytes) -> Sequence[int]:
    """Return the handles of the notifications that a request deletes; none if it is another one."""
    body = data[AmsHeader.SIZE :]
    if header.command == _DELETE:
        octets = body[:_HANDLE]
    elif _group_of(header, body) == _SUM_DELETE:
        count = AdsReadWrite.decode(body).offset
        octets = body[AdsReadWrite.SIZE :][: count * _HANDLE]
    else:
        return ()
    return [
        item for (item,) in struct.iter_unpack("<I", octets[: len(octets) // _HANDLE * _HANDLE])
    ]


def encode_deleted(header: AmsHeader, results: Sequence[AdsError]) -> bytes:
    """Return the body of the answer to a request that deletes notifications."""
    octets = b"".join(result.to_bytes(4, "little") for result in results)
    if header.command == _DELETE:
        return octets
    return _GRANTED.pack(0, len(octets)) + octets


def _group_of(header: AmsHeader, body: bytes) -> int:
    """Return the index group of a ReadWrite, 0 for any other command."""
    if header.command != _READ_WRITE or len(body) < AdsReadWrite.SIZE:
        return 0
    return int.from_bytes(body[:4], "little")


def _count_of(header: AmsHeader, body: bytes) -> int:
    """Return the number of notifications in a request."""
    if header.command == _ADD:
        return 1
    if _group_of(header, body) == _SUM_ADD:
        return min(AdsReadWrite.decode(body).offset, MAX_PER_CLIENT)
    return 0


def _requests_of(pending: Pending) -> list[AddNotification]:
    """Return the parameters of the requested notifications, if they are kept here."""
    octets = pending.request_body
    if not octets:
        return []
    if pending.header.command != _ADD:
        octets = octets[AdsReadWrite.SIZE :]
    size = AddNotification.SIZE
    if len(octets) < size * pending.handles:
        return []
    return [AddNotification.decode(octets, size * number) for number in range(pending.handles)]


def _addresses(header: AmsHeader) -> bytes:
    return ADDRESSES.pack(header.target, header.target_port, header.source, header.source_port)


def _back(header: AmsHeader) -> bytes:
    """Return the addresses that the request for a notification had."""
    return ADDRESSES.pack(header.source, header.source_port, header.target, header.target_port)
