"""What ends notifications: their servers are told when nobody here has them any more.

Whoever asked for one may be gone, may have got its answer too late, or may have asked a router that
was started again since; its server would send to nobody for ever.
"""

from __future__ import annotations

from collections.abc import Iterable

from eap.aoe.action import Action
from eap.aoe.inflight import InFlight, Pending
from eap.aoe.invoke import InvokeIds
from eap.aoe.judge import Limits
from eap.aoe.outlet import Outlet
from eap.aoe.subscriptions import Subscription
from eap.aoe.way import Way
from eap.codec.adsnotification import decode_notification
from eap.codec.ams import ADDRESSES, AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.ids import NetId


class Ending:
    """Asks servers to end notifications.

    Args:
        outlet: By which they are asked.
        in_flight: What waits for an answer, these requests too.
        ids: Of requests of this router.
        limits: How much may wait, and for how long.
    """

    def __init__(self, outlet: Outlet, in_flight: InFlight, ids: InvokeIds, limits: Limits) -> None:
        self._outlet = outlet
        self._in_flight = in_flight
        self._ids = ids
        self._limits = limits

    def end(self, subscriptions: Iterable[Subscription], now_ns: int) -> list[Action]:
        """Have notifications ended, for nobody and as long as there is room to wait for it."""
        actions: list[Action] = []
        for subscription in subscriptions:
            if len(self._in_flight) >= self._limits.in_flight and not self._in_flight.make_room():
                break
            actions.append(self._ask(subscription, now_ns))
        return actions

    def end_unwanted(self, header: AmsHeader, body: bytes, way: Way) -> list[Action]:
        """Return what ends a notification that nobody here has, at the server that sent it.

        Not while the answer may still come that tells its handle: datagrams overtake each other.
        It is the first that a packet tells of: one may have many handles, and ask for many packets.
        Others come again.

        Raises:
            CodecError: the notification is shorter or longer than it says.
        """
        if any(pending.handles for pending in self._in_flight.on(way.door, None)):
            return []
        handles = (sample.handle for stamp in decode_notification(body) for sample in stamp.samples)
        handle = next(handles, None)
        if handle is None:
            return []
        head = AmsHeader(
            header.source,
            header.source_port,
            header.target,
            header.target_port,
            AmsCommand.DELETE_NOTIFICATION,
            StateFlags.ADS | StateFlags.NO_RETURN,
        )
        return [self._outlet.reply(way, encode_packet(head, handle.to_bytes(4, "little")))]

    def _ask(self, subscription: Subscription, now_ns: int) -> Action:
        target, target_port, source, source_port = ADDRESSES.unpack(subscription.onward)
        invoke_id = self._ids.take(self._in_flight)
        header = AmsHeader(
            NetId(target),
            target_port,
            NetId(source),
            source_port,
            AmsCommand.DELETE_NOTIFICATION,
            invoke_id=invoke_id,
        )
        route, deadline_ns = subscription.route, now_ns + self._limits.timeout_ns
        self._in_flight.add(
            Pending(invoke_id, header, None, route, subscription.onward, now_ns, deadline_ns)
        )
        packet = encode_packet(header, subscription.handle.to_bytes(4, "little"))
        return self._outlet.forward(route.hop, packet, invoke_id)
