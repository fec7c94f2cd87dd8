"""Notifications that pass a router: who asked for them, who gets them, and how they end."""

from __future__ import annotations

import struct
from collections.abc import Callable

from eap.aoe.action import Reply
from eap.aoe.inflight import Pending
from eap.aoe.outlet import Outlet
from eap.aoe.routes import Route
from eap.aoe.subscriptions import Subscription, Subscriptions, divide
from eap.aoe.way import Way
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.ids import NetId

_ADDRESSES = struct.Struct("<6sH6sH")
_RESULT = struct.Struct("<II")  # result, handle


class Notifier:
    """Follows requests for notifications and their answers, and hands notifications on.

    Attributes:
        subscriptions: What is known.
    """

    def __init__(self, outlet: Outlet) -> None:
        self.subscriptions = Subscriptions()
        self._outlet = outlet

    def follow_request(self, header: AmsHeader, body: bytes, onward: bytes, way: Way) -> None:
        """Note that a client wants no more of a notification."""
        if header.command != AmsCommand.DELETE_NOTIFICATION or len(body) < 4:
            return
        handle = int.from_bytes(body[:4], "little")
        found = self.subscriptions.find(onward, handle)
        if found is not None and found[0] == way:
            self.subscriptions.remove(onward, handle)

    def follow_answer(
        self, pending: Pending, header: AmsHeader, body: bytes
    ) -> Subscription | None:
        """Note a notification that was granted; return one that its server should end."""
        if header.command != AmsCommand.ADD_NOTIFICATION or header.error_code:
            return None
        if len(body) < _RESULT.size or pending.route is None:
            return None
        result, handle = _RESULT.unpack_from(body)
        if result:
            return None
        asked = pending.header
        server = bytes(asked.target) + asked.target_port.to_bytes(2, "little")
        granted = Subscription(pending.onward, handle, pending.route, server)
        if pending.came_by is None:
            return granted
        return self.subscriptions.add(pending.came_by, granted)

    def hand_on(self, header: AmsHeader, body: bytes, is_hop: Callable[[Way], bool]) -> list[Reply]:
        """Return what the clients get of a notification; nothing if nobody here asked for it.

        Raises:
            TruncatedError: it is shorter than it says.
        """
        onward = _ADDRESSES.pack(
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


def request_to_end(subscription: Subscription) -> tuple[AmsHeader, bytes, Route]:
    """Return the request that ends a notification, as it goes to its hop."""
    target, target_port, source, source_port = _ADDRESSES.unpack(subscription.onward)
    header = AmsHeader(
        NetId(target),
        target_port,
        NetId(source),
        source_port,
        AmsCommand.DELETE_NOTIFICATION,
        StateFlags.ADS,
    )
    return header, subscription.handle.to_bytes(4, "little"), subscription.route
