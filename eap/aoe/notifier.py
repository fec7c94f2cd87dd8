"""Notifications that pass a router: who asked for them, and who gets them."""

from __future__ import annotations

import struct
from collections.abc import Callable

from eap.aoe.action import Reply
from eap.aoe.inflight import Pending
from eap.aoe.outlet import Outlet
from eap.aoe.subscriptions import MAX_PER_WAY, Subscription, Subscriptions, divide
from eap.aoe.way import Way
from eap.codec.ads import AdsReadWrite, IndexGroup
from eap.codec.adsnotification import decode_notification
from eap.codec.ams import ADDRESSES, AmsCommand, AmsHeader, encode_packet
from eap.ids import NetId

_GRANTED = struct.Struct("<II")  # result, handle
_HANDLE = 4
_OF_NOTIFICATIONS = frozenset(
    (AmsCommand.ADD_NOTIFICATION, AmsCommand.DELETE_NOTIFICATION, AmsCommand.READ_WRITE)
)
"""Commands that may be about some."""
_SUM_HEAD = 8
"""Octets of result and length before the answers to the items of a sum command."""


class Notifier:
    """Follows requests for notifications and their answers, and hands notifications on.

    Attributes:
        subscriptions: What is known.
    """

    def __init__(self, outlet: Outlet) -> None:
        self.subscriptions = Subscriptions()
        self._outlet = outlet

    def follow_request(self, pending: Pending, body: bytes, way: Way) -> None:
        """Note how many notifications a client asks for, or which it wants no more."""
        command, group, count = pending.header.command, 0, 0
        if command not in _OF_NOTIFICATIONS:
            return
        if command == AmsCommand.READ_WRITE and len(body) >= AdsReadWrite.SIZE:
            head = AdsReadWrite.decode(body)
            group, count = head.group, min(head.offset, MAX_PER_WAY)
        if command == AmsCommand.ADD_NOTIFICATION:
            pending.handles = 1
        elif group == IndexGroup.SUM_ADD_NOTIFICATION:
            pending.handles = count
        elif command == AmsCommand.DELETE_NOTIFICATION:
            self._delete(pending.onward, body[:_HANDLE], way)
        elif group == IndexGroup.SUM_DELETE_NOTIFICATION:
            start = AdsReadWrite.SIZE
            self._delete(pending.onward, body[start : start + count * _HANDLE], way)

    def follow_answer(self, pending: Pending, header: AmsHeader, body: bytes) -> list[Subscription]:
        """Note the notifications that were granted; return those that their server should end."""
        if not pending.handles or header.error_code or pending.route is None:
            return []
        asked = pending.header
        server = bytes(asked.target) + asked.target_port.to_bytes(2, "little")
        start = 0 if header.command == AmsCommand.ADD_NOTIFICATION else _SUM_HEAD
        granted = body[start : start + pending.handles * _GRANTED.size]
        surplus = []
        for result, handle in _GRANTED.iter_unpack(granted[: _whole(granted)]):
            if result:
                continue
            given = Subscription(pending.onward, handle, pending.route, server)
            way = pending.came_by
            oldest = given if way is None else self.subscriptions.add(way, given)
            if oldest is not None:
                surplus.append(oldest)
        return surplus

    def knows(self, header: AmsHeader, body: bytes) -> bool:
        """Say whether somebody here asked for a sample of a notification.

        Raises:
            CodecError: it is shorter or longer than it says.
        """
        onward = ADDRESSES.pack(
            header.source, header.source_port, header.target, header.target_port
        )
        handles = (sample.handle for stamp in decode_notification(body) for sample in stamp.samples)
        return any(self.subscriptions.find(onward, handle) is not None for handle in handles)

    def hand_on(self, header: AmsHeader, body: bytes, is_hop: Callable[[Way], bool]) -> list[Reply]:
        """Return what the clients get of a notification; nothing if nobody here asked for it.

        Raises:
            CodecError: it is shorter or longer than it says.
        """
        onward = ADDRESSES.pack(
            header.source, header.source_port, header.target, header.target_port
        )
        parts = divide(body, onward, self.subscriptions, is_hop)
        replies = []
        for (way, server), part in parts.items():
            source, port = NetId(server[:6]), int.from_bytes(server[6:], "little")
            head = AmsHeader(
                header.target,
                header.target_port,
                source,
                port,
                header.command,
                header.state_flags,
                error_code=header.error_code,
                invoke_id=header.invoke_id,
            )
            replies.append(self._outlet.reply(way, encode_packet(head, part)))
        return replies

    def _delete(self, onward: bytes, handles: bytes, way: Way) -> None:
        for at in range(0, len(handles) - _HANDLE + 1, _HANDLE):
            handle = int.from_bytes(handles[at : at + _HANDLE], "little")
            found = self.subscriptions.find(onward, handle)
            if found is not None and found[0] == way:
                self.subscriptions.remove(onward, handle)


def _whole(granted: bytes) -> int:
    return len(granted) // _GRANTED.size * _GRANTED.size
