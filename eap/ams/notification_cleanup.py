"""What ends notifications: their servers are told when nobody here has them any more.

Whoever asked for one may be gone, may have got its answer too late, or may have asked a router that
was started again since; its server would send to nobody for ever.
"""

from __future__ import annotations

from collections.abc import Iterable
from struct import Struct

from eap.ads.endpoint import Endpoint
from eap.ams.action import Action
from eap.ams.admission import Limits
from eap.ams.inflight import InFlight, Pending
from eap.ams.invoke import InvokeIds
from eap.ams.subscriptions import Grant
from eap.ams.transport_table import TransportTable
from eap.codec.ads import IndexGroup
from eap.codec.ams import ADDRESSES, AmsCommand, AmsHeader, StateFlags, encode_packet
from eap.ids import NetId

_WRITE = Struct("<III")  # group, offset, length


class NotificationCleanup:
    """Asks servers to end notifications.

    Args:
        transports: By which they are asked.
        in_flight: What waits for an answer, these requests too.
        ids: Of requests of this router.
        limits: How much may wait, and for how long.
    """

    def __init__(
        self, transports: TransportTable, in_flight: InFlight, ids: InvokeIds, limits: Limits
    ) -> None:
        self._transports = transports
        self._in_flight = in_flight
        self._ids = ids
        self._limits = limits

    def end(self, grants: Iterable[Grant], now_ns: int) -> list[Action]:
        """Have notifications ended, for nobody and as long as there is room to wait for it."""
        actions: list[Action] = []
        for grant in grants:
            if grant.route.hop.transport not in self._transports.transports:
                continue
            if len(self._in_flight) >= self._limits.in_flight and not self._in_flight.make_room():
                break
            handle = grant.handle.to_bytes(4, "little")
            actions.append(self._ask(grant, AmsCommand.DELETE_NOTIFICATION, handle, now_ns))
            actions += self.release(grant, now_ns)
        return actions

    def release(self, grant: Grant, now_ns: int) -> list[Action]:
        """Give back the handle of a symbol that this router looked up."""
        if grant.symbol_handle is None:
            return []
        handle = grant.symbol_handle.to_bytes(4, "little")
        body = _WRITE.pack(IndexGroup.RELEASE_HANDLE, 0, len(handle)) + handle
        return [self._ask(grant, AmsCommand.WRITE, body, now_ns)]

    def end_unwanted(self, header: AmsHeader, handle: int, endpoint: Endpoint) -> list[Action]:
        """Return what ends a notification that no client here has, at the server that sent it.

        Not while the answer may still come that tells its handle: datagrams overtake each other.
        """
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
        invoke_id = self._ids.take(self._in_flight)
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
