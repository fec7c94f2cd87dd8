"""Whom notifications are for.

A notification is no answer: it names only the AMS address of its client, which several programs of
one computer share.  What tells them apart is the handle, which the server gave when the one of them
asked for it.  So requests for notifications that pass are remembered with their connections.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
from typing import NamedTuple

from eap.aoe.routes import Route
from eap.aoe.way import Way
from eap.errors import TruncatedError

MAX_PER_WAY = 1024
"""Notifications of one connection; the oldest makes room."""
_HEAD = struct.Struct("<II")  # octets behind the first field, stamps
_STAMP = struct.Struct("<QI")  # FILETIME, samples
_SAMPLE = struct.Struct("<II")  # handle, octets


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


class _Sample(NamedTuple):
    time: int
    handle: int
    octets: bytes
    """With the handle and the length."""


def _samples(body: bytes) -> Iterator[_Sample]:
    try:
        _, stamps = _HEAD.unpack_from(body)
        at = _HEAD.size
        for _ in range(stamps):
            time, samples = _STAMP.unpack_from(body, at)
            at += _STAMP.size
            for _ in range(samples):
                handle, length = _SAMPLE.unpack_from(body, at)
                octets, at = body[at : at + _SAMPLE.size + length], at + _SAMPLE.size + length
                yield _Sample(time, handle, octets)
    except struct.error as exc:
        raise TruncatedError(str(exc), layout="Notification") from None
    if at > len(body):
        raise TruncatedError("the last sample is cut", layout="Notification")


def divide(
    body: bytes, onward: bytes, subscriptions: Subscriptions, is_hop: Callable[[Way], bool]
) -> dict[tuple[Way, bytes], bytes]:
    """Return what each connection gets of a notification, by connection and server's address.

    A handle that nobody has is left out, or that was given by another hop than *is_hop* says.

    Raises:
        TruncatedError: the notification is shorter than it says.
    """
    parts: dict[tuple[Way, bytes], list[_Sample]] = {}
    count = 0
    for sample in _samples(body):
        count += 1
        found = subscriptions.find(onward, sample.handle)
        if found is not None and is_hop(found[1].route.hop):
            parts.setdefault((found[0], found[1].server), []).append(sample)
    if len(parts) == 1 and count == len(next(iter(parts.values()))):
        return dict.fromkeys(parts, body)
    return {key: _join(samples) for key, samples in parts.items()}


def _join(samples: list[_Sample]) -> bytes:
    stamps: dict[int, list[bytes]] = {}
    for sample in samples:
        stamps.setdefault(sample.time, []).append(sample.octets)
    content = b"".join(
        _STAMP.pack(time, len(octets)) + b"".join(octets) for time, octets in stamps.items()
    )
    return _HEAD.pack(len(content) + 4, len(stamps)) + content
