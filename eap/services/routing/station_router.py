"""Router of one station in the running loop, with its transports and services.

- A **transport** receives and sends packets.  Its receiver calls :meth:`StationRouter.receive`
  with the transport's name and the connection or the sender's address.  Answers, and packets for
  the next hop, leave by the :class:`~.service.TransportSender` of the transport.  Where several
  stations share a socket, a demultiplexer finds the station of a packet.
- A **service** answers for one NetID and its AMS ports, see :class:`~.service.Service`.
- **Routes** are in :attr:`StationRouter.table`; the methods here add and remove them, so that their
  hops are probed from then on.
- A **client** of this process sends by :meth:`StationRouter.request`, and needs no transport.

All methods are called from the running loop; no packet of a peer raises an exception.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable, Collection, Hashable, Sequence
from time import monotonic_ns
from typing import TypeAlias

from eap.ams.access import AccessList, AuditEntry, host_of
from eap.ams.error_reply import RoutingError
from eap.ams.hop_prober import HopProber
from eap.ams.inflight import RouterLimits
from eap.ams.record import Outcome, Record, Stats, Trace, reason_of
from eap.ams.report import ConnectionReport, Location, Obstacle, RouteReport
from eap.ams.router import Router
from eap.ams.routes import Route, RouteTable
from eap.ams.subscription_restorer import Interruption
from eap.ams.transport_table import Action, Deliver, Forward, Reply, Transport
from eap.codec.ams import AmsAnswer, AmsHeader, encode_packet
from eap.ids import Endpoint, NetId
from eap.services.limited_log import caused_by
from eap.services.routing.service import (
    LOCAL_TRANSPORT,
    LocalClient,
    LocalRequest,
    SerialQueues,
    Service,
    ServiceTable,
    TransportSender,
)

_SHORTEST_WAIT_S = 0.001
_MOMENT_S = 0.02
"""Delay with which a time-out may be noticed."""


class RouterTimer:
    """Timer for the next time-out, from :meth:`start` to :meth:`stop`.

    Args:
        next_timeout: Returns the next due time, in nanoseconds of the monotonic clock, or None for
            never.
        handle: Called at about that time; it sets the timer again.
    """

    def __init__(self, next_timeout: Callable[[], int | None], handle: Callable[[], None]) -> None:
        self._next_timeout = next_timeout
        self._handle = handle
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._is_soon = False

    def start(self) -> None:
        """Start the timer in the running loop."""
        self._loop = asyncio.get_running_loop()
        self.set()

    def stop(self) -> None:
        """Stop the timer."""
        self._loop = None
        if self._timer is not None:
            self._timer.cancel()

    def set(self) -> None:
        """Set the timer to the next due time."""
        at_ns = self._next_timeout()
        if at_ns is None or self._loop is None:
            return
        if self._timer is not None:
            if self._is_soon or self._timer.when() <= at_ns / 1e9:
                return
            self._timer.cancel()
        at_s = max(at_ns / 1e9, self._loop.time() + _SHORTEST_WAIT_S)
        self._timer = self._loop.call_at(at_s, self._expire)

    def set_soon(self) -> None:
        """Set the timer to a moment from now, because something may be due earlier than before."""
        if self._is_soon or self._loop is None:
            return
        self._is_soon = True
        if self._timer is not None:
            self._timer.cancel()
        # The exact due time is looked up then, and not for each packet, which would cost more.
        self._timer = self._loop.call_later(_MOMENT_S, self._expire)

    def _expire(self) -> None:
        self._timer = None
        self._is_soon = False
        self._handle()


_LEVELS = {
    Outcome.ANSWERED: logging.INFO,
    Outcome.FAILED: logging.WARNING,
    Outcome.DENIED: logging.WARNING,
    Outcome.LOOP: logging.WARNING,
    Outcome.LATE: logging.DEBUG,
    Outcome.DROPPED: logging.DEBUG,
    Outcome.INTERRUPTED: logging.WARNING,
    Outcome.RESTORED: logging.INFO,
}

logger = logging.getLogger(__name__)


class TraceLog:
    """Log lines about the packets of one station."""

    def __init__(self, station: str) -> None:
        self._station = station

    def write(self, trace: Trace) -> None:
        """Log the outcome of a packet."""
        level = _LEVELS[trace.outcome]
        if not logger.isEnabledFor(level):
            return
        host = "" if trace.endpoint is None else host_of(trace.endpoint)
        transport = "" if trace.endpoint is None else trace.endpoint.transport
        # The text has the results inside an answer already.
        code = f" (0x{trace.error_code:x})" if trace.error_code else ""
        extra = caused_by(
            (self._station, *_cause(trace, host)), f"{self._station} {transport} {host}"
        )
        logger.log(level, "%s: %s%s", self._station, trace.text, code, extra=extra)


def _cause(trace: Trace, host: str) -> tuple[Hashable, ...]:
    """Return a key that is equal for packets with the same obstacle.

    A hop that is down is one cause for all requests and clients.  Otherwise each client and target
    has causes of its own, whatever the connection and the AMS port of the client.
    """
    reason = reason_of(trace)
    # One line for a dead hop, whatever the number of its clients and requests.
    if trace.outcome is Outcome.FAILED and trace.hop is not None:
        return trace.outcome, trace.hop, trace.error_code, reason
    header = trace.header
    what = None if header is None else (header.target, header.target_port, header.command)
    return trace.outcome, what, host, trace.error_code, reason


FaultFinder: TypeAlias = Callable[[int], Awaitable[Sequence[str]]]
MAX_FAULTS = 4
MAX_FAULT = 300
"""Characters of each in the report of a trace, which is bounded."""


class StationRouter:
    """Router of the AMS packets of one station.

    Args:
        name: Name of the station.
        net_id: NetID of the router itself.
        net_ids: NetIDs of the station's ports; a request to a port that none of its services has is
            answered with error 6, one to another NetID of the station with error 7.
        access: The access rules; without them other hosts only read.
        limits: Limits of requests and connections.

    Attributes:
        name: Name of the station.
        net_id: NetID of the router itself.
        table: The routes, read-only; changed by :meth:`add_route` and :meth:`remove_route`.
        on_trace: Called with each trace, except that of a request that was simply answered.
        on_audit: Called with each entry of the audit: changes, and denied requests.
        on_routes: Called with the hop of each route that was added or removed.
    """

    def __init__(
        self,
        name: str,
        net_id: NetId,
        net_ids: Collection[NetId] = (),
        *,
        access: AccessList | None = None,
        limits: RouterLimits | None = None,
    ) -> None:
        self.name = name
        self.net_id = net_id
        self.table = RouteTable()
        self.on_trace: list[Callable[[Trace], None]] = [TraceLog(name).write]
        self.on_audit: list[Callable[[AuditEntry], None]] = []
        self.on_routes: list[Callable[[Endpoint], None]] = []
        self._router = Router(
            net_id,
            self.table,
            [],
            # Random, so that late answers to a previous process match no request of this one.
            first_invoke_id=int.from_bytes(os.urandom(4), "little"),
            limits=limits,
            hop_prober=HopProber(net_id, self.table),
            access=access,
            answer_now=self._answer_now,
        )
        self._senders: dict[str, TransportSender] = {}
        self._services = ServiceTable((net_id, *net_ids))
        self._fault_finders: dict[NetId, FaultFinder] = {}
        for each in self._services.net_ids:
            self._router.add_device(each, self._services.ports(each))
        self._queues = SerialQueues(self._finish)
        self._client = LocalClient(self)
        # Requests of this process take the same path as those of peers.
        self.add_transport(LOCAL_TRANSPORT, self._client)
        self._below_waiters: dict[Endpoint, tuple[int, asyncio.Event]] = {}
        self._timer = RouterTimer(self._router.next_timeout, self._handle_timeout)

    @property
    def net_ids(self) -> Collection[NetId]:
        """All NetIDs of the station; none of them is routed."""
        return self._services.net_ids

    @property
    def record(self) -> Record:
        """Traffic by connection and hop, and the latest traces."""
        return self._router.record

    def find_obstacle(self, route: Route) -> Obstacle | None:
        """Return why nothing can go by *route* now; None if something can."""
        return self._router.find_obstacle(route)

    def report(self, route: Route) -> RouteReport:
        """Return the state and the traffic of one of the routes."""
        return self._router.report(route)

    def connections(self) -> list[ConnectionReport]:
        """Return the clients that are connected or sent requests."""
        return self._router.connections()

    def interruptions(self) -> list[Interruption]:
        """Return the interrupted subscriptions, by client and server."""
        return self._router.interruptions()

    @property
    def access(self) -> AccessList:
        """The access rules that are in force."""
        return self._router.access_filter.access

    def set_access(self, access: AccessList) -> None:
        """Apply other access rules from now on."""
        self._router.access_filter.access = access

    def denial(self, header: AmsHeader, body: bytes, endpoint: Endpoint) -> str:
        """Return why the access rules deny a request, empty if they allow it; denials are audited.

        For a service of another station whose requests concern this station, too.
        """
        packet = encode_packet(header, body)
        found = self._router.access_filter.filter_request(header, packet, endpoint, monotonic_ns())
        if not isinstance(found, RoutingError):
            return ""
        self._publish_events()
        return found.text

    def require_record(self, record: Callable[[AuditEntry], str]) -> None:
        """Deny changes that cannot be recorded: *record* returns the reason, or an empty text."""
        self._router.access_filter.before_change = record

    def why_not_recorded(self, entry: AuditEntry) -> str:
        """Record a change before it is made, where that is required; return why it failed."""
        record = self._router.access_filter.before_change
        return record(entry) if record is not None else ""

    def stats(self) -> Stats:
        """Return the current and total figures."""
        return self._router.stats()

    async def serve(self) -> None:
        """Handle time-outs and probe hops until cancelled."""
        self._timer.start()
        try:
            await asyncio.Event().wait()
        finally:
            self._timer.stop()
            await self._queues.close()

    def add_transport(self, transport: Transport, sender: TransportSender) -> None:
        """Add a transport with its sender; raise ValueError if its name exists already."""
        self._router.add_transport(transport)
        self._senders[transport.name] = sender

    def remove_transport(self, name: str) -> None:
        """Remove a transport with its clients.

        Requests that wait for answers by it are answered with 0x1B.
        """
        for endpoint in self._router.endpoints_of(name):
            self._queues.forget(endpoint)
            self._services.client_gone(endpoint)
        self._act(self._router.remove_transport(name, monotonic_ns()))
        del self._senders[name]

    def add_net_id(self, net_id: NetId) -> None:
        """Add a NetID of a port, for which services are added next."""
        self._services.add_net_id(net_id)
        self._router.add_device(net_id, self._services.ports(net_id))

    def remove_net_id(self, net_id: NetId) -> None:
        """Remove a NetID of a port with its services; it is routed from now on."""
        self._router.remove_device(net_id)
        self._services.remove_net_id(net_id)
        self._fault_finders.pop(net_id, None)

    def add_service(self, net_id: NetId, service: Service) -> None:
        """Add *service* behind *net_id* of the station; the first with a port answers.

        Raises:
            KeyError: the station has no such NetID.
        """
        self._services.add(net_id, service)

    def add_fault_finder(self, net_id: NetId, find: FaultFinder) -> None:
        """Have *find* return the faults of the device at each AMS port of *net_id*, for traces."""
        self._fault_finders[net_id] = find

    async def find_faults(self, net_id: NetId, port: int) -> tuple[str, ...]:
        """Return the present faults of an own device in words."""
        find = self._fault_finders.get(net_id)
        found = () if find is None else await find(port)
        return tuple(each[:MAX_FAULT] for each in found[:MAX_FAULTS])

    def add_route(self, route: Route) -> bool:
        """Add *route* to the table; return whether it was accepted."""
        is_taken = self.table.add(route)
        for follow in self.on_routes:
            follow(route.hop)
        self._timer.set()
        return is_taken

    def remove_route(self, net_id: NetId, hop: Endpoint) -> bool:
        """Remove a route; return whether there was one."""
        was_there = self.table.remove(net_id, hop)
        for follow in self.on_routes:
            follow(hop)
        self._timer.set()
        return was_there

    def is_down(self, hop: Endpoint) -> bool:
        """Return whether a hop is down."""
        return self._router.is_down(hop)

    def set_hop_connection(self, transport: str, address: str, connection: str) -> None:
        """Treat packets from *connection* as packets from the hop named *address*."""
        self._router.set_hop_connection(transport, address, connection)

    def has_route_to(self, hop: Endpoint) -> bool:
        """Return whether a route leads to a hop."""
        return any(route.hop == hop for route in self.table)

    def is_awaited(self, hop: Endpoint) -> bool:
        """Return whether an answer from a hop is pending, or subscriptions receive from it."""
        return self._router.is_awaited(hop)

    def locate(self, header: AmsHeader, endpoint: Endpoint) -> Location:
        """Return the next hop of a request received from *endpoint*."""
        return self._router.locate(header, endpoint)

    def is_waiting_for(self, header: AmsHeader, body: bytes, transport: str) -> bool:
        """Return whether a request of this router waits for a packet."""
        return self._router.is_waiting_for(header, body, transport)

    def receive(
        self, data: bytes, transport: str, connection: str, *, is_broadcast: bool = False
    ) -> None:
        """Handle an AMS packet, or a fragment of one.

        Args:
            data: The packet with its header.
            transport: Name of its transport.
            connection: Its connection, or its sender's address; an IP address is followed by a
                colon, for the access rules.
            is_broadcast: Whether other stations got it too: only its target answers then.
        """
        self._act(
            self._router.receive_packet(
                data, transport, connection, monotonic_ns(), is_broadcast=is_broadcast
            )
        )

    def connection_closed(self, transport: str, connection: str) -> None:
        """Drop what is pending for the clients of a closed connection, and notify the services."""
        endpoint = Endpoint(transport, connection)
        self._queues.forget(endpoint)
        self._services.client_gone(endpoint)
        self._act(self._router.connection_closed(transport, connection, monotonic_ns()))

    def hop_down(self, transport: str, address: str | None, text: str) -> None:
        """Mark a hop as down: pending and later requests to it are answered with 0x1B.

        Args:
            transport: Transport of the hop.
            address: Address of the hop; None for all hops of the transport.
            text: Reason, for people.
        """
        self._act(self._router.hop_down(transport, address, text, monotonic_ns()))

    def hop_up(self, transport: str, address: str | None) -> None:
        """Mark a hop as up; the arguments are those of :meth:`hop_down`."""
        self._router.hop_up(transport, address)
        self._timer.set()

    def send_notification(self, endpoint: Endpoint, packet: bytes) -> None:
        """Send a notification of a service to a client, in fragments where needed."""
        self._act(self._router.notify(endpoint, packet))

    async def request(
        self, target: NetId, target_port: int, command: int, body: bytes = b"", *, timeout_s: float
    ) -> AmsAnswer:
        """Send a request to a local or remote *target* as a client of this station.

        Returns:
            The data of the answer.  A failure is the error code of the AMS header, set by the
            router that detected it; 0x719 also stands for the end of *timeout_s*.
        """
        return await self._client.request(target, target_port, command, body, timeout_s=timeout_s)

    def waiting(self, endpoint: Endpoint) -> int:
        """Return the number of pending requests from *endpoint*."""
        return self._router.waiting(endpoint)

    async def wait_below(self, transport: str, connection: str, count: int) -> None:
        """Wait until fewer than *count* requests of a connection are pending.

        Only its reader calls this: while it waits, the flow control of TCP slows the client.
        """
        endpoint = Endpoint(transport, connection)
        if self._router.waiting(endpoint) < count:
            return
        # An event for each reader rather than a condition: only readers that can go on are woken.
        event = asyncio.Event()
        self._below_waiters[endpoint] = count, event
        try:
            await event.wait()
        finally:
            del self._below_waiters[endpoint]

    def _act(self, actions: list[Action]) -> None:
        if self._router.has_events:
            self._publish_events()  # first: the audit is written before the answer is sent
        for action in actions:  # isinstance() is faster than match
            if isinstance(action, Reply):
                endpoint = action.endpoint
                self._senders[endpoint.transport].send(endpoint.connection, action.packets)
            elif isinstance(action, Forward):
                self._forward(action)
            else:
                self._deliver(action)
        self._router.settle()
        for endpoint, (count, event) in self._below_waiters.items():
            if self._router.waiting(endpoint) < count:
                event.set()
        self._timer.set_soon()

    def _publish_events(self) -> None:
        while (trace := self._router.next_event()) is not None:
            for notify in self.on_trace:
                notify(trace)
        while (entry := self._router.access_filter.next_entry()) is not None:
            for write in self.on_audit:
                write(entry)

    def _forward(self, action: Forward) -> None:
        hop = action.hop
        text = self._senders[hop.transport].send(hop.connection, action.packets)
        if text is not None:
            self._act(self._router.send_failed(action.ticket, text, monotonic_ns()))

    def _answer_now(
        self, header: AmsHeader, body: bytes, endpoint: Endpoint
    ) -> tuple[AmsAnswer, int] | None:
        """Return the immediate answer of a service, unless the client has pending requests."""
        # Requests of one client to one port are answered in their order.
        if self._queues.has_work(endpoint, header):
            return None
        return self._services.answer_now(header, body)

    def _deliver(self, action: Deliver) -> None:
        service = self._services.find(action.header)
        if service is not None:
            request = LocalRequest(action.header, action.body, action.endpoint)
            self._queues.put(action.ticket, service, request)

    def _finish(self, ticket: int, answer: AmsAnswer) -> None:
        self._act(self._router.receive_answer(ticket, answer, monotonic_ns()))

    def _handle_timeout(self) -> None:
        actions = self._router.handle_timeout(monotonic_ns())
        for hop in self._router.pop_gone_hops():
            self.connection_closed(*hop)  # a datagram transport has no end of a connection
        if actions:
            self._act(actions)
        else:
            self._timer.set()
