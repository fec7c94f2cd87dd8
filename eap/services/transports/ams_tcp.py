"""AMS/TCP: the listener of an address with its clients, and the connections to other routers.

Rule 1: there is one connection for each peer, however many NetIDs are behind it: routers close the
older one of two.
Rule 2: the peer may send requests on it too, and gets its answers on it.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from ipaddress import IPv4Address
from secrets import randbelow
from threading import Thread
from time import monotonic_ns
from typing import NamedTuple, Protocol

from eap.ads.endpoint import Endpoint
from eap.ams.routes import Route
from eap.ams.spec import TransportKind
from eap.ams.transport_table import Transport
from eap.codec.ams import AMS_TCP_PORT
from eap.ids import NetId, parse_host
from eap.net.connections import OVERDUE_NS, CloseReason, Limits
from eap.net.reconnecting import ReconnectingLink, ReconnectPolicy, connect_tcp
from eap.net.tcp import set_stream_options
from eap.runtime.discards import Refusal
from eap.services.routing.service import TransportSender
from eap.services.transports.accepting import Listeners, ListeningSocket, connection_name
from eap.services.transports.ams_connection import AmsConnection, ClientAddresses
from eap.services.transports.demultiplexer import Demultiplexer

LIMITS = Limits()

logger = logging.getLogger(__name__)


class AmsClients:
    """Connections to all AMS/TCP listeners of this process, by name; the carrier of their door.

    Attributes:
        addresses: For clients that ask for an AMS address.
    """

    def __init__(self) -> None:
        self.addresses = ClientAddresses(randbelow(1 << 16))
        self._connections: dict[str, AmsConnection] = {}

    def __len__(self) -> int:
        return len(self._connections)

    def add(self, connection: AmsConnection) -> None:
        """Take one more."""
        self._connections[connection.name] = connection

    def remove(self, connection: AmsConnection) -> None:
        """Forget one that has ended."""
        del self._connections[connection.name]

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets by a connection; return why not if there is none of that name."""
        found = self._connections.get(connection)
        return "the connection was closed" if found is None else found.send(packets)


class AmsTransport:
    """One listening socket and the stations behind it.

    A peer that has vanished without a word is found out by the kernel within a minute.

    Args:
        listener: Opened by the supervisor; it stays open.
        entrance: To the stations that are reached by it.
        clients: Where those who have connected are found when an answer is there.
        count_dropped: Counts what is not answered as it was wanted.
        listeners: Of this process.
    """

    def __init__(
        self,
        listener: socket.socket,
        demultiplexer: Demultiplexer,
        clients: AmsClients,
        count_dropped: Callable[[Refusal], None],
        listeners: Listeners,
    ) -> None:
        self.count_dropped = count_dropped
        self._demultiplexer = demultiplexer
        self._clients = clients
        name = "ams-tcp {}:{}".format(*listener.getsockname())
        self._listening = ListeningSocket(listener, name, self, listeners, LIMITS)

    async def serve(self) -> None:
        """Accept until cancelled; then close all connections."""
        await self._listening.serve()

    def connection_from(self, sock: socket.socket, host: str) -> AmsConnection:
        """Return the connection on a socket that was accepted (ConnectionServer)."""
        set_stream_options(sock)
        return AmsConnection(
            connection_name(sock),
            sock.getpeername()[0],
            self,
            host=host,
            assign_address=self._assign_address,
        )

    async def serve_connection(self, connection: AmsConnection, sock: socket.socket) -> None:
        """Serve a connection until its end (ConnectionServer)."""
        loop = asyncio.get_running_loop()
        await loop.connect_accepted_socket(lambda: connection, sock)
        try:
            await connection.closed
        finally:
            connection.close(CloseReason.ENDED)

    def refuse_connection(self, sock: socket.socket, why: str) -> None:
        """Count a connection that gets no place (ConnectionServer)."""
        del sock, why
        self.count_dropped(Refusal.AMS_FULL)

    def connection_opened(self, connection: AmsConnection) -> None:
        """Keep it (PacketHandler)."""
        self._clients.add(connection)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Let others have its place (PacketHandler)."""
        logger.debug("AMS/TCP connection %s: %s", connection.name, why)
        self._clients.remove(connection)
        self._demultiplexer.connection_closed(connection.name)

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Hand a request to the stations (PacketHandler)."""
        self._demultiplexer.receive(packet, connection.name)

    def handle_answer(self, packet: bytes, connection: AmsConnection) -> None:
        """Count a response: nothing is asked by connections that others opened (PacketHandler)."""
        del packet, connection
        self.count_dropped(Refusal.AMS_UNASKED)

    def _assign_address(self, host: str) -> tuple[NetId, int]:
        return self._clients.addresses.next(host, self._demultiplexer.has)


async def resolve(host: str) -> str:
    """Return the address of *host*, which may be one already.

    Raises:
        OSError: there is no such name, or nobody says whose it is.
    """
    try:
        return str(IPv4Address(host))
    except ValueError:
        pass
    loop = asyncio.get_running_loop()
    found: asyncio.Future[str] = loop.create_future()

    def take(result: str | OSError) -> None:
        if found.done():
            return
        if isinstance(result, str):
            found.set_result(result)
        else:
            found.set_exception(result)

    def look_up() -> None:
        result: str | OSError
        try:
            result = socket.gethostbyname(host)
        except OSError as exc:
            result = exc
        except UnicodeError:
            result = OSError(f"{host!r} is not a host name")
        with suppress(RuntimeError):  # the loop has ended meanwhile
            loop.call_soon_threadsafe(take, result)

    Thread(target=look_up, name=f"resolve {host}", daemon=True).start()
    return await found


CONNECT_S = 3.0
"""How long a peer may take to accept a connection."""
FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 5.0
"""Before a connection is tried again."""
MAX_EARLY = 64
"""Packets that wait for the first connection."""
_UNCONFIRMED_S = 10.0
_STABLE_S = 10.0
"""A connection that lasted so long was a good one: the next is tried soon."""


PEER_PREFIX = f"{TransportKind.AMS_TCP}:"
"""Begin of the names of doors to peers; the address of the peer follows."""


class PacketRouter(Protocol):
    """What a connection to a peer needs of the router of its station."""

    @property
    def name(self) -> str:
        """Name of the station."""

    def receive(self, data: bytes, transport: str, connection: str) -> None:
        """Act on a packet; what has to be said goes to ``AmsUplink.send``."""

    def connection_closed(self, transport: str, connection: str) -> None:
        """Forget what the peer asked for."""

    def hop_down(self, transport: str, address: str | None, text: str) -> None:
        """Answer what waits for the peer, and what will be for it."""

    def hop_up(self, transport: str, address: str | None) -> None:
        """Pass requests on to it again."""


class PeerAddress(NamedTuple):
    """Where a peer listens."""

    host: str
    """Name or address."""
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class AmsUplink(ReconnectingLink):
    """The connection to one peer.

    Args:
        peer: Whom to connect to.
        transport: Its name at the router.
        address: By which routes name the peer.
        router: Of the station.
        sources: The station's own IPv4 addresses.
        claims: Peers that the station is connected with, by address and port: all its uplinks share
            it.
        count_dropped: Counts what is not taken.
        may_be_client: Says whether the peer may be a client that does not listen.
    """

    def __init__(
        self,
        peer: PeerAddress,
        transport: str,
        address: str,
        router: PacketRouter,
        *,
        sources: Collection[str],
        claims: dict[tuple[str, int], AmsUplink],
        count_dropped: Callable[[Refusal], None],
        may_be_client: Callable[[], bool] = bool,
        overdue_ns: int = OVERDUE_NS,
    ) -> None:
        super().__init__(ReconnectPolicy(FIRST_WAIT_S, LONGEST_WAIT_S, _STABLE_S))
        self.peer = peer
        self._may_be_client = may_be_client
        self._was_open = False
        self.count_dropped = count_dropped
        self._endpoint = transport, address
        self._router = router
        self._sources = sources
        self._claims = claims
        self._overdue_ns = overdue_ns
        self._connection: AmsConnection | None = None
        self._closed: asyncio.Future[str]
        self._early: list[bytes] | None = []

    def send(self, connection: str, packets: Iterable[bytes]) -> str | None:
        """Send packets to the peer; return why not if that cannot be done (TransportSender)."""
        del connection  # there is one
        if self._connection is not None:
            return self._connection.send(packets)
        if self._early is None:
            return "not connected"
        if len(self._early) >= MAX_EARLY:
            return "not connected yet"
        self._early += packets
        return None

    def connection_opened(self, connection: AmsConnection) -> None:
        """Send what has waited (PacketHandler)."""
        self._connection = connection
        self._was_open = True
        early, self._early = self._early, None
        self._router.hop_up(*self._endpoint)
        if early:
            connection.send(early)

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Hand a request of the peer on (PacketHandler)."""
        del connection
        self._router.receive(packet, *self._endpoint)

    def handle_answer(self, packet: bytes, connection: AmsConnection) -> None:
        """Hand an answer of the peer on (PacketHandler)."""
        del connection
        self._router.receive(packet, *self._endpoint)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Tell the router (PacketHandler)."""
        if self._connection is connection:
            self._connection = None
            self._router.connection_closed(*self._endpoint)
            self._closed.set_result(why)

    def end(self) -> None:
        """Close the connection at once, before the door is gone."""
        if self._connection is not None:
            self._connection.close("")
            self.connection_closed(self._connection, "the route was removed")

    def _disconnected(self, reason: str, *, has_lasted: bool) -> bool:
        """Tell the router, and the log if the reason is another one."""
        del has_lasted
        self._early = None
        self._router.hop_down(*self._endpoint, reason)
        if self._is_news(reason):
            if self._may_be_client() and not self._was_open:
                text = "%s: %s; a client added the route to it, and does not listen"
                logger.info(text, self._router.name, reason)
            else:
                logger.warning("%s: %s", self._router.name, reason)
        return True

    async def _connect(self) -> str:
        """Connect, and wait for the end (ReconnectingLink)."""
        try:
            async with asyncio.timeout(CONNECT_S):
                host = await resolve(self.peer.host)
        except TimeoutError:
            return f"the address of {self.peer.host} is not found in time"
        except OSError as exc:
            return f"the address of {self.peer.host} is not found: {exc.strerror or exc}"
        key = host, self.peer.port
        other = self._claims.setdefault(key, self)
        if other is not self:
            return f"{self.peer} is {other.peer}, to which there is a route: name both alike"
        try:
            return await self._connect_to(host)
        finally:
            del self._claims[key]

    async def _connect_to(self, host: str) -> str:
        try:
            sock = await connect_tcp(
                host,
                self.peer.port,
                source_for(host, self._sources),
                timeout_s=CONNECT_S,
                unconfirmed_s=_UNCONFIRMED_S,
            )
        except TimeoutError:
            return f"{self.peer} does not answer within {CONNECT_S:g} s"
        except ConnectionRefusedError:
            return f"{self.peer} refuses connections: no router runs there"
        except OSError as exc:
            return f"{self.peer}: {exc.strerror}"
        return await self._last(sock, host)

    async def _last(self, sock: socket.socket, host: str) -> str:
        """Hand over an open connection, and wait for its end; return why it ended."""
        loop = asyncio.get_running_loop()
        self._closed = loop.create_future()
        since = loop.time()
        _, connection = await loop.create_connection(
            lambda: AmsConnection(str(self.peer), host, self, is_ours=True), sock=sock
        )
        try:
            while not (await asyncio.wait([self._closed], timeout=self._overdue_ns / 4e9))[0]:
                late_ns = connection.late_since_ns
                if late_ns is not None and monotonic_ns() - late_ns >= self._overdue_ns:
                    connection.close(CloseReason.OVERDUE)
                if self.reason:
                    self.reason = ""
                    logger.info("%s: connected to %s", self._router.name, self.peer)
        finally:
            connection.close("the appliance ends")
        why = self._closed.result()
        if loop.time() - since < 1:
            return f"{self.peer} closes connections at once: it may have no route back ({why})"
        return f"{self.peer}: {why}"


def source_for(host: str, sources: Collection[str]) -> str | None:
    """Return by which of a station's addresses it is known to *host*, None for any.

    Routers tell peers apart by their addresses; stations that share a machine and its network each
    come from their own.
    """
    for source in sources:
        if host.startswith("127.") and source.startswith("127."):
            return source
        if host.rpartition(".")[0] == source.rpartition(".")[0]:
            return source
    return None


class UplinkRouter(PacketRouter, Protocol):
    """Router of a station, as its uplinks use it.

    Attributes:
        on_routes: Called with the hop of each route that was added or removed.
    """

    on_routes: list[Callable[[Endpoint], None]]

    @property
    def table(self) -> Iterable[Route]:
        """All routes."""

    def add_transport(self, transport: Transport, sender: TransportSender) -> None:
        """Let packets come and go by *transport*."""

    def remove_transport(self, name: str) -> None:
        """Forget a door."""


class AmsUplinks:
    """The uplinks of one station: they follow its routes.

    Args:
        router: Of the station.
        sources: The station's own IPv4 addresses.
        count_dropped: Counts what is not taken.
    """

    def __init__(
        self,
        router: UplinkRouter,
        sources: Collection[str],
        count_dropped: Callable[[Refusal], None],
    ) -> None:
        self._router = router
        self._sources = sources
        self._count_dropped = count_dropped
        self._uplinks: dict[Endpoint, AmsUplink] = {}
        self._tasks: dict[Endpoint, asyncio.Task[None]] = {}
        self._claims: dict[tuple[str, int], AmsUplink] = {}
        self._group: asyncio.TaskGroup | None = None
        for route in router.table:
            self._follow(route.hop)
        router.on_routes.append(self._follow)

    async def serve(self) -> None:
        """Keep the connections until cancelled."""
        async with asyncio.TaskGroup() as self._group:
            for endpoint in self._uplinks:
                self._start(endpoint)
            await asyncio.Event().wait()

    def _follow(self, hop: Endpoint) -> None:
        """Open the connection to *hop*, or close it, as there are routes to it or none."""
        if not hop.transport.startswith(PEER_PREFIX):
            return
        is_used = any(route.hop == hop for route in self._router.table)
        if is_used and hop not in self._uplinks:
            self._open(hop)
        elif not is_used and hop in self._uplinks:
            self._close(hop)

    def _open(self, hop: Endpoint) -> None:
        try:
            peer = PeerAddress(*parse_host(hop.connection, AMS_TCP_PORT))
        except ValueError as exc:
            logger.warning("a route leads nowhere: %s", exc)
            return
        self._uplinks[hop] = uplink = AmsUplink(
            peer,
            *hop,
            self._router,
            sources=self._sources,
            claims=self._claims,
            count_dropped=self._count_dropped,
            may_be_client=lambda: all(
                route.is_client for route in self._router.table if route.hop == hop
            ),
        )
        self._router.add_transport(Transport(hop.transport, is_stream=True, is_hub=True), uplink)
        self._start(hop)

    def _close(self, hop: Endpoint) -> None:
        if (task := self._tasks.pop(hop, None)) is not None:
            task.cancel()
        self._uplinks.pop(hop).end()
        self._router.hop_up(*hop)  # nothing is known of it any more
        self._router.remove_transport(hop.transport)

    def _start(self, hop: Endpoint) -> None:
        if self._group is not None:
            self._tasks[hop] = self._group.create_task(self._uplinks[hop].run())
