"""Services of a station, the queues before them, and the station's own client.

A *service* answers requests for a NetID of the station, at the AMS ports that it has.  A *sender*
is the sending half of a transport: it sends packets to a connection or an address.  Both are
registered at :class:`~eap.services.routing.station_router.StationRouter`, which calls them from the
running loop only, so neither needs locks.

Requests of one client to one port are answered in their order, all others concurrently.  The
queues are bounded in number and bytes; a request beyond that is answered with an error at once.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Container, Iterable
from itertools import count
from time import monotonic_ns
from typing import NamedTuple, Protocol, TypeAlias

from eap.ams.spec import TransportKind
from eap.ams.transport_table import Transport
from eap.codec.ads import AdsError
from eap.codec.ams import AmsAnswer, AmsHeader, StateFlags, decode_packet, encode_packet
from eap.ids import Endpoint, NetId
from eap.services.tasks import TaskSet


class LocalRequest(NamedTuple):
    """Request for a service of this station, admitted by the access rules.

    Parts of a sum command that the rules deny are not in *body* any more.  Notifications go to
    *endpoint* by ``StationRouter.send_notification``.
    """

    header: AmsHeader
    body: bytes
    endpoint: Endpoint
    ahead: int = 0
    """Requests of the same client to the same port that it waited for."""
    queued_ns: int = 0
    """Monotonic time of its receipt if it waited, else 0."""


AnswerNow: TypeAlias = Callable[[AmsHeader, bytes], AmsAnswer | None]
"""Returns the answer to a request, with its header and body; None if it needs a queue."""


class Service(Protocol):
    """Service behind a NetID.

    The router first calls a method ``answer_now``, an :data:`AnswerNow`, where there is one: its
    answer goes back without any record of the request.  It must not change anything.
    """

    @property
    def ports(self) -> Container[int]:
        """AMS ports that it has now; they may change at any time."""

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request: at once, or later by an awaitable.

        The method may be ``async def``; an answer that is available is better returned as it is,
        which saves a task.  Requests of one client to one port run one at a time, all others
        concurrently.  An exception is logged and answered with ``AdsError.INTERNAL``.  After its
        time limit the router answers with an error, and drops a later answer.
        """

    def client_gone(self, endpoint: Endpoint) -> None:
        """End what belongs to the clients of a closed connection: notifications, handles.

        An address without connections (a datagram's sender) is never closed.
        """


class TransportSender(Protocol):
    """Sending half of a transport."""

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send AMS packets, one or its fragments, without waiting.

        Args:
            connection: Name of an accepted connection, address of a sender without connection, or
                address of a hop that a route names.
            packets: With their headers, none longer than the maximum size of the transport.

        Returns:
            None, or the reason of a failure; a request is answered with 0x1B then.
        """


class ServiceTable:
    """Services of one station.

    Args:
        net_ids: All NetIDs that the station has.
    """

    def __init__(self, net_ids: Iterable[NetId]) -> None:
        self._services: dict[NetId, list[Service]] = {each: [] for each in net_ids}

    @property
    def net_ids(self) -> Collection[NetId]:
        """All NetIDs of the station."""
        return self._services.keys()

    def add_net_id(self, net_id: NetId) -> None:
        """Add a NetID, without services yet."""
        self._services.setdefault(net_id, [])

    def remove_net_id(self, net_id: NetId) -> None:
        """Remove a NetID with its services."""
        del self._services[net_id]

    def add(self, net_id: NetId, service: Service) -> None:
        """Add *service* behind *net_id*; raise KeyError if the station has no such NetID."""
        self._services[net_id].append(service)

    def ports(self, net_id: NetId) -> Container[int]:
        """Return the AMS ports behind *net_id*, which may change at any time."""
        return _Ports(self._services[net_id])

    def find(self, header: AmsHeader) -> Service | None:
        """Return the first service with the target port of a request."""
        # A request may wait for its turn while its device is removed.
        for service in self._services.get(header.target, ()):
            if header.target_port in service.ports:
                return service
        return None

    def answer_now(self, header: AmsHeader, body: bytes) -> tuple[AmsAnswer, int] | None:
        """Return the immediate answer to a request and its time in nanoseconds, None if none."""
        # getattr rather than a method of the protocol: most services have none.
        answer_now: AnswerNow | None = getattr(self.find(header), "answer_now", None)
        if answer_now is None:
            return None
        began_ns = monotonic_ns()
        try:
            answer = answer_now(header, body)
        except Exception:  # noqa: BLE001  it is logged when it fails again, in its queue
            return None
        return None if answer is None else (answer, monotonic_ns() - began_ns)

    def client_gone(self, endpoint: Endpoint) -> None:
        """Notify all services that a connection is closed."""
        for services in self._services.values():
            for service in services:
                service.client_gone(endpoint)


class _Ports:
    """AMS ports that some services have now."""

    def __init__(self, services: Collection[Service]) -> None:
        self._services = services

    def __contains__(self, port: object) -> bool:
        for service in self._services:  # noqa: SIM110  any() takes twice as long
            if port in service.ports:
                return True
        return False


MAX_WAITING = 64
"""Requests of one client to one port that wait for their turn."""
MAX_OCTETS = 16 << 20
"""Bytes of all requests of a station that are running or wait."""
_FAILED = AmsAnswer(error_code=AdsError.INTERNAL)
_FULL = AmsAnswer(error_code=AdsError.MAILBOX_FULL)

Finish: TypeAlias = Callable[[int, AmsAnswer], None]
"""Called with the answer to the request with a ticket."""
_Key: TypeAlias = tuple[Endpoint, bytes]

logger = logging.getLogger(__name__)


class _QueuedRequest(NamedTuple):
    ticket: int
    service: Service
    request: LocalRequest


class SerialQueues:
    """Queues of the requests to one station's services; *finish* gets their answers."""

    def __init__(self, finish: Finish) -> None:
        self._finish = finish
        self._queues: dict[_Key, deque[_QueuedRequest]] = {}
        self._tasks = TaskSet("AoE requests")
        self._octets = 0

    def has_work(self, endpoint: Endpoint, header: AmsHeader) -> bool:
        """Return whether a request of the same client and port is running or waits."""
        return bool(self._queues) and (endpoint, _addresses(header)) in self._queues

    def put(self, ticket: int, service: Service, request: LocalRequest) -> None:
        """Queue a request for *service*, or begin it."""
        key = request.endpoint, _addresses(request.header)
        waiting = _QueuedRequest(ticket, service, request)
        queue = self._queues.get(key)
        if queue is None:
            answer = _begin(waiting)
            # A task would only delay an answer that is available.
            if isinstance(answer, AmsAnswer):
                self._finish(ticket, answer)
                return
            self._queues[key] = queue = deque()
            self._octets += len(request.body)
            self._tasks.start(self._run(key, queue, waiting, answer))
        # Refused at once, so that the client need not wait for its time-out.
        elif len(queue) >= MAX_WAITING or self._octets + len(request.body) > MAX_OCTETS:
            self._finish(ticket, _FULL)
        else:
            self._octets += len(request.body)
            # The client's time-out runs from the receipt, so that the wait is part of the time.
            late = request._replace(ahead=1 + len(queue), queued_ns=monotonic_ns())
            queue.append(waiting._replace(request=late))

    def forget(self, endpoint: Endpoint) -> None:
        """Drop requests from *endpoint* that wait for their turn; those that run continue."""
        for key, queue in self._queues.items():
            if key[0] == endpoint:
                self._octets -= sum(len(each.request.body) for each in queue)
                queue.clear()

    async def close(self) -> None:
        """Cancel the running requests."""
        await self._tasks.close()

    async def _run(
        self,
        key: _Key,
        queue: deque[_QueuedRequest],
        first: _QueuedRequest,
        answer: Awaitable[AmsAnswer],
    ) -> None:
        """Answer the requests in *queue* until it is empty."""
        waiting: _QueuedRequest = first
        outcome: AmsAnswer | Awaitable[AmsAnswer] = answer
        try:
            while True:
                if not isinstance(outcome, AmsAnswer):
                    outcome = await _end(waiting, outcome)
                self._octets -= len(waiting.request.body)
                self._finish(waiting.ticket, outcome)
                if not queue:
                    return
                waiting = queue.popleft()
                outcome = _begin(waiting)
        finally:
            del self._queues[key]


def _begin(waiting: _QueuedRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
    try:
        return waiting.service.answer(waiting.request)
    except Exception:
        logger.exception("AMS request from %s failed", waiting.request.header.source)
        return _FAILED


async def _end(waiting: _QueuedRequest, answer: Awaitable[AmsAnswer]) -> AmsAnswer:
    try:
        return await answer
    except Exception:
        logger.exception("AMS request from %s failed", waiting.request.header.source)
        return _FAILED


def _addresses(header: AmsHeader) -> bytes:
    ports = header.target_port << 16 | header.source_port
    return header.target + header.source + ports.to_bytes(4, "little")


LOCAL_TRANSPORT = Transport(TransportKind.LOCAL, is_stream=True, is_hub=True)
"""Transport of the station's own requests."""
_FIRST_PORT = 0x8000
"""First source port, in the range that AMS routers give to clients."""


class _Station(Protocol):
    @property
    def net_id(self) -> NetId: ...

    def receive(self, data: bytes, transport: str, connection: str) -> None: ...

    def connection_closed(self, transport: str, connection: str) -> None: ...


class LocalClient:
    """Client of one station, and the sender that its answers return to.

    Each request is a connection of its own, so that any number may run at a time.
    """

    def __init__(self, station: _Station) -> None:
        self._station = station
        self._numbers = count(1)
        self._waiting: dict[str, asyncio.Future[AmsAnswer]] = {}

    async def request(
        self, target: NetId, target_port: int, command: int, body: bytes, *, timeout_s: float
    ) -> AmsAnswer:
        """Send a request; return the answer, or the error in its place."""
        number = next(self._numbers)
        # A connection for each request keeps them out of each other's queue.
        connection = str(number)
        answer: asyncio.Future[AmsAnswer] = asyncio.get_running_loop().create_future()
        self._waiting[connection] = answer
        source_port = _FIRST_PORT + number % _FIRST_PORT
        header = AmsHeader(
            target, target_port, self._station.net_id, source_port, command, StateFlags.ADS,
            invoke_id=number & 0xFFFFFFFF,
        )  # fmt: skip
        try:
            self._station.receive(encode_packet(header, body), LOCAL_TRANSPORT.name, connection)
            async with asyncio.timeout(timeout_s):
                return await answer
        except TimeoutError:
            return AmsAnswer(error_code=AdsError.TIMEOUT)
        finally:
            del self._waiting[connection]
            self._station.connection_closed(LOCAL_TRANSPORT.name, connection)

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Complete the request of an answer (TransportSender)."""
        answer = self._waiting.get(connection)
        if answer is not None and not answer.done():
            header, body = decode_packet(packets[0])
            answer.set_result(AmsAnswer(bytes(body), header.error_code))
        return None
