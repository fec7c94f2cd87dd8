"""ADS notifications of one device: sampling, collection and end.

Rule 1: values are sampled when the caller says that a cycle is over (``handle_cycle``), never in
between, and never in the cycle in which a notification was added: its first sample always follows
the answer with its handle, that of a value on change by ``first_change_ns`` at least.
Rule 2: a sample waits for others of its client at most as long as that client allows, and less if
a packet is full: nothing is ever dropped here, and what waits is bounded.
Rule 3: a source that fails for good ends its notification; the client gets a sample without
bytes, as TwinCAT does, in a packet of its own, because AdsLib skips what follows such a sample.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from eap.ads.request import AdsRefusedError
from eap.ads.space import Source
from eap.codec.ads import AdsError
from eap.codec.adsnotification import (
    UNIT_NS,
    AddNotification,
    NotificationSample,
    Stamp,
    TransMode,
    encode_notification,
)
from eap.codec.ams import AmsCommand, AmsHeader, encode_packet
from eap.ids import Endpoint, NetId

MAX_HANDLES = 1024
"""Notifications of one client; TwinCAT's limit as well."""
MAX_CLIENTS = 256
MAX_WATCHED = 0xFFFF
"""Bytes of the largest value: that of a variable."""
FULL_PACKET = 32 * 1024
"""Bytes of samples of one client that are sent without waiting for more."""

# TwinCAT's variants "in context" belong to the cycle of a task; here is only one cycle for all.
_CYCLIC = frozenset((TransMode.SERVER_CYCLE, TransMode.SERVER_CYCLE_2))
_ON_CHANGE = frozenset((TransMode.SERVER_ON_CHANGE, TransMode.SERVER_ON_CHANGE_2))
_FOR_NOW = frozenset((AdsError.BUSY, AdsError.NOT_READY))


class AdsClient(NamedTuple):
    """ADS client: an AMS address, which programs of one computer may share, and its connection."""

    endpoint: Endpoint
    net_id: NetId
    port: int


class Notice(NamedTuple):
    """The data of a DeviceNotification for *client*."""

    client: AdsClient
    data: bytes

    def encode(self, net_id: NetId, port: int) -> bytes:
        """Return the packet that brings it, from the device at *net_id* and *port*."""
        client = self.client
        header = AmsHeader(client.net_id, client.port, net_id, port, AmsCommand.NOTIFICATION)
        return encode_packet(header, self.data)


class NotificationStats(NamedTuple):
    """Counters since the start, and how many notifications there are now."""

    notifications: int
    clients: int
    samples: int
    packets: int
    ended: int
    """Because their source failed."""


class _Notification:
    __slots__ = (
        "_due_ns",
        "client",
        "cycle_ns",
        "delay_ns",
        "handle",
        "last",
        "next_ns",
        "on_change",
        "source",
    )

    def __init__(
        self,
        client: AdsClient,
        handle: int,
        request: AddNotification,
        source: Source,
        first_ns: int,
    ) -> None:
        self.client = client
        self.handle = handle
        self.source = source
        self.on_change = request.mode in _ON_CHANGE
        self.cycle_ns = request.cycle * UNIT_NS
        self.delay_ns = request.max_delay * UNIT_NS
        self.last: bytes | None = None
        self._due_ns = first_ns - 1
        self.next_ns = first_ns

    def advance(self, now_ns: int) -> None:
        """Set the next time; the mean interval is the requested one, if cycles allow it."""
        self._due_ns += self.cycle_ns
        if self._due_ns <= now_ns:
            self._due_ns = now_ns + self.cycle_ns
        # Cycles do not come to the dot: one that is a little early is the one that was meant.
        self.next_ns = max(now_ns + 1, self._due_ns - self.cycle_ns // 8)


class _Outbox:
    """Samples that wait to be sent to one client."""

    __slots__ = ("deadline_ns", "handles", "size", "stamps")

    def __init__(self) -> None:
        self.handles: set[int] = set()
        self.stamps: list[tuple[int, list[NotificationSample]]] = []
        self.size = 0
        self.deadline_ns = 0

    def add(self, time: int, sample: NotificationSample, deadline_ns: int) -> None:
        if not self.stamps or deadline_ns < self.deadline_ns:
            self.deadline_ns = deadline_ns
        if not self.stamps or self.stamps[-1][0] != time:
            self.stamps.append((time, []))
        self.stamps[-1][1].append(sample)
        self.size += sample.size

    def encode(self) -> bytes:
        data = encode_notification(Stamp(time, tuple(samples)) for time, samples in self.stamps)
        self.stamps = []
        self.size = 0
        return data


def handle_numbers(first: int) -> Iterator[int]:
    """Yield handles from *first* on, and from 1 again behind the last one."""
    handle = first
    while True:
        yield handle
        handle = handle % 0xFFFF_FFFF + 1


class NotificationTable:
    """The notifications of one device, or of one value where several tables share *handles*.

    Args:
        first_handle: Another one at each start keeps a router that missed the start from taking a
            handle for one that it knows.
        first_change_ns: Time between a request for changes and its first sample.
        handles: By default those from *first_handle* on.

    Attributes:
        on_add: Called whenever there is one more.
    """

    def __init__(
        self,
        first_handle: int = 1,
        first_change_ns: int = 1,
        *,
        handles: Iterator[int] | None = None,
    ) -> None:
        self._first_change_ns = first_change_ns
        self.on_add: Callable[[], None] | None = None
        self._notifications: dict[int, _Notification] = {}
        self._clients: dict[AdsClient, _Outbox] = {}
        self._due: list[tuple[int, int]] = []
        self._handles = handle_numbers(first_handle) if handles is None else handles
        self._samples = 0
        self._packets = 0
        self._ended = 0

    def __len__(self) -> int:
        return len(self._notifications)

    def __contains__(self, handle: int) -> bool:
        return handle in self._notifications

    def shortest_cycle_ns(self) -> int:
        """Return the shortest cycle of a notification, 0 without any."""
        return min((each.cycle_ns for each in self._notifications.values()), default=0)

    def add(self, client: AdsClient, request: AddNotification, source: Source, now_ns: int) -> int:
        """Return the handle of a new notification; its first sample is due later.

        Raises:
            AdsRefusedError: TRANS_MODE, WATCH_SIZE or NO_MORE_HANDLES.
        """
        if request.mode not in _CYCLIC and request.mode not in _ON_CHANGE:
            raise AdsRefusedError(AdsError.TRANS_MODE)
        # An empty sample means the end of a notification, so a length of 0 cannot be watched.
        if not 0 < request.length <= MAX_WATCHED:
            raise AdsRefusedError(AdsError.WATCH_SIZE)
        pending = self._clients.get(client)
        if pending is None:
            if len(self._clients) >= MAX_CLIENTS:
                raise AdsRefusedError(AdsError.NO_MORE_HANDLES)
            pending = self._clients[client] = _Outbox()
        if len(pending.handles) >= MAX_HANDLES:
            raise AdsRefusedError(AdsError.NO_MORE_HANDLES)
        handle = self._take_handle()
        pending.handles.add(handle)
        first_ns = now_ns + (self._first_change_ns if request.mode in _ON_CHANGE else 1)
        notification = _Notification(client, handle, request, source, first_ns)
        self._notifications[handle] = notification
        heappush(self._due, (notification.next_ns, handle))
        if self.on_add is not None:
            self.on_add()
        return handle

    def delete(self, client: AdsClient, handle: int) -> None:
        """End a notification; raise AdsRefusedError if it is none of *client*'s."""
        notification = self._notifications.get(handle)
        if notification is None or notification.client != client:
            raise AdsRefusedError(AdsError.NOTIFICATION_HANDLE)
        self._remove(notification)

    def forget(self, endpoint: Endpoint) -> None:
        """End all notifications of a closed connection."""
        for client in [client for client in self._clients if client.endpoint == endpoint]:
            for handle in self._clients.pop(client).handles:
                del self._notifications[handle]
        self._clear_due()

    def next_timeout(self) -> int | None:
        """Return when a cycle has something to do at the earliest, None if never."""
        if not self._notifications:
            return None  # the times of those that were deleted are still listed
        times = [pending.deadline_ns for pending in self._clients.values() if pending.stamps]
        if self._due:
            times.append(self._due[0][0])
        return min(times, default=None)

    def handle_cycle(self, now_ns: int, time: int) -> list[Notice]:
        """Sample what is due at the end of a cycle; return what is to be sent.

        Args:
            now_ns: The time on the monotonic clock.
            time: The same moment as a FILETIME, for the stamps.
        """
        notices: list[Notice] = []
        due = self._take_due(now_ns)
        for notification in due:
            try:
                data = notification.source()
            except AdsRefusedError as exc:
                if exc.result not in _FOR_NOW:
                    notices += self._end(notification, time)
                continue
            notices += self._sample(notification, data, now_ns, time)
        # Those that are due again in the same cycle come back only now, or this would never end.
        for notification in due:
            if notification.handle in self._notifications:
                heappush(self._due, (notification.next_ns, notification.handle))
        for client, pending in self._clients.items():
            if pending.stamps and pending.deadline_ns <= now_ns:
                notices.append(self._send(client, pending))
        return notices

    def stats(self) -> NotificationStats:
        """Return a snapshot of the counters."""
        return NotificationStats(
            len(self._notifications), len(self._clients), self._samples, self._packets, self._ended
        )

    def _take_handle(self) -> int:
        # 256 clients with 1024 handles leave most of 32 bits free.
        return next(handle for handle in self._handles if handle not in self._notifications)

    def _take_due(self, now_ns: int) -> list[_Notification]:
        due = []
        while self._due and self._due[0][0] <= now_ns:
            at_ns, handle = heappop(self._due)
            notification = self._notifications.get(handle)
            if notification is None or notification.next_ns != at_ns:
                continue  # it was deleted, and its handle may be another's by now
            notification.advance(now_ns)
            due.append(notification)
        return due

    def _sample(
        self, notification: _Notification, data: bytes, now_ns: int, time: int
    ) -> list[Notice]:
        if notification.on_change and data == notification.last:
            return []
        notification.last = data
        self._samples += 1
        pending = self._clients[notification.client]
        sample = NotificationSample(notification.handle, data)
        notices = []
        if pending.stamps and pending.size + sample.size > FULL_PACKET:
            notices.append(self._send(notification.client, pending))
        pending.add(time, sample, now_ns + notification.delay_ns)
        return notices

    def _end(self, notification: _Notification, time: int) -> list[Notice]:
        client = notification.client
        pending = self._clients[client]
        notices = [self._send(client, pending)] if pending.stamps else []
        data = encode_notification([Stamp(time, (NotificationSample(notification.handle, b""),))])
        self._packets += 1
        self._ended += 1
        self._remove(notification)
        return [*notices, Notice(client, data)]

    def _send(self, client: AdsClient, pending: _Outbox) -> Notice:
        self._packets += 1
        return Notice(client, pending.encode())

    def _remove(self, notification: _Notification) -> None:
        del self._notifications[notification.handle]
        pending = self._clients[notification.client]
        pending.handles.discard(notification.handle)
        if not pending.handles:
            del self._clients[notification.client]
        if len(self._due) > 2 * len(self._notifications) + 16:
            self._clear_due()

    def _clear_due(self) -> None:
        self._due = [entry for entry in self._due if entry[1] in self._notifications]
        heapify(self._due)
