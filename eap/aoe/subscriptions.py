"""Whom notifications are for.

A notification is no answer: it names only the AMS address of its client, which several programs of
one computer share.  What tells them apart is the handle, which the server gave when the one of them
asked for it.  So requests for notifications that pass are remembered with their connections.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import NamedTuple

from eap.aoe.routes import Route
from eap.aoe.way import Way
from eap.codec.adsnotification import Sample, Stamp, decode_notification, encode_notification

MAX_PER_WAY = 1024
"""Notifications of one connection; the oldest makes room."""


class Subscription(NamedTuple):
    """One notification of one client."""

    onward: bytes
    """Address of the server over there, then that of the client, 16 octets."""
    handle: int
    route: Route
    server: bytes
    """Address of the server as its client knows it, 8 octets."""


class Subscriptions:
    """All notifications that come through."""

    def __init__(self) -> None:
        self._ways: dict[tuple[bytes, int], tuple[Way, Subscription]] = {}
        self._of_way: dict[Way, OrderedDict[tuple[bytes, int], Subscription]] = {}

    def __len__(self) -> int:
        return len(self._ways)

    def add(self, way: Way, subscription: Subscription) -> Subscription | None:
        """Remember that *subscription* is for *way*; return the one that makes room."""
        key = subscription.onward, subscription.handle
        self.remove(*key)
        mine = self._of_way.setdefault(way, OrderedDict())
        oldest = None
        if len(mine) >= MAX_PER_WAY:
            oldest = self.remove(*next(iter(mine)))
        self._of_way.setdefault(way, mine)[key] = subscription
        self._ways[key] = way, subscription
        return oldest

    def find(self, onward: bytes, handle: int) -> tuple[Way, Subscription] | None:
        """Return where a sample with *handle* goes, from the first to the second address."""
        return self._ways.get((onward, handle))

    def remove(self, onward: bytes, handle: int) -> Subscription | None:
        """Forget and return a notification."""
        found = self._ways.pop((onward, handle), None)
        if found is None:
            return None
        way, subscription = found
        mine = self._of_way[way]
        del mine[onward, handle]
        if not mine:
            del self._of_way[way]
        return subscription

    def ways(self) -> list[Way]:
        """Return who has any."""
        return list(self._of_way)

    def close(self, way: Way) -> list[Subscription]:
        """Forget and return those of *way*."""
        mine = self._of_way.pop(way, OrderedDict())
        for key in mine:
            del self._ways[key]
        return list(mine.values())

    def forget_hop(self, door: str, address: str | None) -> None:
        """Forget those that came from there."""
        for key, (_, subscription) in list(self._ways.items()):
            hop = subscription.route.hop
            if hop.door == door and address in {None, hop.connection}:
                self.remove(*key)


def divide(
    body: bytes, onward: bytes, subscriptions: Subscriptions, is_hop: Callable[[Way], bool]
) -> dict[tuple[Way, bytes], bytes]:
    """Return what each connection gets of a notification, by connection and server's address.

    A handle that nobody has is left out, or that was given by another hop than *is_hop* says.

    Raises:
        CodecError: the notification is shorter or longer than it says.
    """
    parts: dict[tuple[Way, bytes], list[tuple[int, Sample]]] = {}
    count = 0
    for stamp in decode_notification(body):
        for sample in stamp.samples:
            count += 1
            found = subscriptions.find(onward, sample.handle)
            if found is not None and is_hop(found[1].route.hop):
                parts.setdefault((found[0], found[1].server), []).append((stamp.time, sample))
    if len(parts) == 1 and count == len(next(iter(parts.values()))):
        return dict.fromkeys(parts, body)
    return {key: _join(samples) for key, samples in parts.items()}


def _join(samples: list[tuple[int, Sample]]) -> bytes:
    stamps: dict[int, list[Sample]] = {}
    for time, sample in samples:
        stamps.setdefault(time, []).append(sample)
    return encode_notification(Stamp(time, tuple(each)) for time, each in stamps.items())
