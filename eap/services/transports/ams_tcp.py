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
from typing import NamedTuple, TypedDict, TypeVar

from eap.ams.spec import SecureRouteSpec, TransportKind
from eap.ams.transport_table import Transport
from eap.codec.ams import AMS_TCP_PORT
from eap.codec.secureads import AMS_TLS_PORT
from eap.ids import Endpoint, NetId, parse_host
from eap.net.limits import OVERDUE_NS, CloseReason, ListenerLimits
from eap.net.reconnecting import ReconnectingLink, ReconnectPolicy, connect_tcp
from eap.net.tcp import set_stream_options
from eap.runtime.drop_counters import DropReason
from eap.services.routing.station_router import StationRouter
from eap.services.transports.accepting import (
    ConnectionServer,
    Listeners,
    ListeningSocket,
    connection_name,
)
from eap.services.transports.ams_connection import AmsConnection, ClientAddresses
from eap.services.transports.demultiplexer import Demultiplexer

LIMITS = ListenerLimits()

AmsConnectionT = TypeVar("AmsConnectionT", bound=AmsConnection)

logger = logging.getLogger(__name__)


class AmsClients:
    """Connections to all AMS/TCP listeners of this process, by name; sender of their transport.

    Attributes:
        addresses: For clients that request an AMS address.
    """

    def __init__(self) -> None:
        self.addresses = ClientAddresses(randbelow(1 << 16))
        self._connections: dict[str, AmsConnection] = {}

    def __len__(self) -> int:
        return len(self._connections)

    def add(self, connection: AmsConnection) -> None:
        """Add a connection."""
        self._connections[connection.name] = connection

    def remove(self, connection: AmsConnection) -> None:
        """Remove a closed connection."""
        del self._connections[connection.name]

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets by a connection; return the reason if there is none of that name."""
        found = self._connections.get(connection)
        return "the connection was closed" if found is None else found.send(packets)


class AmsListener(ConnectionServer[AmsConnectionT]):
    """One listening socket for AMS, by TCP or by Secure ADS.

    Args:
        listener: The socket; closed by :meth:`close`.
        name: Shown in ``status`` and the log.
        full: Counter of connections that are not admitted.
        count_dropped: Counts dropped packets and connections.
        listeners: All listeners of the process.
    """

    def __init__(
        self,
        listener: socket.socket,
        name: str,
        full: DropReason,
        count_dropped: Callable[[DropReason], object],
        listeners: Listeners,
    ) -> None:
        self.name = name
        self._count = count_dropped
        self._full = full
        self._listening = ListeningSocket(listener, name, self, listeners, LIMITS)

    async def serve(self) -> None:
        """Accept until cancelled; then close all connections."""
        await self._listening.serve()

    def close(self) -> None:
        """Close the listener, which is not served any more."""
        self._listening.close()

    def refuse_connection(self, sock: socket.socket, why: str) -> None:
        """Count a connection that is not admitted (ConnectionServer)."""
        del sock, why
        self.count_dropped(self._full)

    def handle_answer(self, packet: bytes, connection: AmsConnection) -> None:
        """Count an answer: no requests are sent on accepted connections (PacketHandler)."""
        del packet, connection
        self.count_dropped(DropReason.AMS_UNASKED)

    def count_dropped(self, reason: DropReason) -> None:
        """Count a dropped packet or connection (PacketHandler)."""
        self._count(reason)


class AmsTransport(AmsListener[AmsConnection]):
    """One listening socket and the stations behind it.

    The kernel detects a peer that vanished without FIN within a minute (TCP keep-alive).

    Args:
        listener: Opened by the supervisor; closed by :meth:`close`.
        demultiplexer: To the stations behind the listener.
        clients: All connections of the process.
        count_dropped: Counts dropped packets and connections.
        listeners: All listeners of the process.
    """

    def __init__(
        self,
        listener: socket.socket,
        demultiplexer: Demultiplexer,
        clients: AmsClients,
        count_dropped: Callable[[DropReason], None],
        listeners: Listeners,
    ) -> None:
        self._demultiplexer = demultiplexer
        self._clients = clients
        name = "ams-tcp {}:{}".format(*listener.getsockname())
        super().__init__(listener, name, DropReason.AMS_FULL, count_dropped, listeners)

    def connection_from(self, sock: socket.socket, host: str) -> AmsConnection:
        """Return the connection on an accepted socket (ConnectionServer)."""
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

    def connection_opened(self, connection: AmsConnection) -> None:
        """Add the connection (PacketHandler)."""
        self._clients.add(connection)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Remove the connection (PacketHandler)."""
        logger.debug("AMS/TCP connection %s: %s", connection.name, why)
        self._clients.remove(connection)
        self._demultiplexer.connection_closed(connection.name)

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Forward a request to the stations (PacketHandler)."""
        self._demultiplexer.receive(packet, connection.name)

    def _assign_address(self, host: str) -> tuple[NetId, int]:
        return self._clients.addresses.next(host, self._demultiplexer.has)


async def resolve(host: str) -> str:
    """Return the IPv4 address of a host name or address, without blocking the loop.

    Raises:
        OSError: there is no such name, or no name server answers.
    """
    try:
        return str(IPv4Address(host))
    except ValueError:
        pass
    loop = asyncio.get_running_loop()
    found: asyncio.Future[str] = loop.create_future()

    def complete(result: str | OSError) -> None:
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
            loop.call_soon_threadsafe(complete, result)

    # A thread of its own looks the name up. The executor of asyncio would delay the end of the
    # process until its threads have ended, even if the name server does not answer.
    Thread(target=look_up, name=f"resolve {host}", daemon=True).start()
    return await found


CONNECT_S = 3.0
"""Time limit for connecting to a peer."""
FIRST_WAIT_S = 0.5
LONGEST_WAIT_S = 5.0
"""Pauses before the next attempt."""
MAX_EARLY = 64
"""Packets that wait for the first connection."""
_UNCONFIRMED_S = 10.0
_STABLE_S = 10.0
"""After a connection of this duration the pauses begin anew."""


_UPLINKS = frozenset((TransportKind.AMS_TCP, TransportKind.AMS_TLS))
"""Kinds of transports with uplinks, whose names have the address of the peer behind the kind."""


class PeerAddress(NamedTuple):
    """Host and port of a peer's listener."""

    host: str
    """Name or IPv4 address."""
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class UplinkArguments(TypedDict):
    """Arguments of :class:`AmsUplink` that all uplinks of a station have alike."""

    sources: Collection[str]
    claims: dict[tuple[str, int], AmsUplink]
    count_dropped: Callable[[DropReason], None]
    may_be_client: Callable[[], bool]


class AmsUplink(ReconnectingLink):
    """Connection to one peer.

    Args:
        peer: Host and port to connect to.
        transport: Its name at the router.
        address: Address of the peer in routes.
        router: Router of the station.
        sources: The station's own IPv4 addresses.
        claims: Peers that the station is connected to, by address and port; all its uplinks share
            it.
        count_dropped: Counts dropped packets.
        may_be_client: Returns whether the peer may be a client without a listener.
    """

    def __init__(
        self,
        peer: PeerAddress,
        transport: str,
        address: str,
        router: StationRouter,
        *,
        sources: Collection[str],
        claims: dict[tuple[str, int], AmsUplink],
        count_dropped: Callable[[DropReason], None],
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
        """Send packets to the peer; return the reason of a failure (TransportSender)."""
        del connection  # a peer has one connection
        if self._connection is not None:
            return self._connection.send(packets)
        if self._early is None:
            return "not connected"
        if len(self._early) >= MAX_EARLY:
            return "not connected yet"
        self._early += packets
        return None

    def connection_opened(self, connection: AmsConnection) -> None:
        """Send the packets that waited (PacketHandler)."""
        self._connection = connection
        self._was_open = True
        # Packets wait only for the first connection; after a failure they are refused at once.
        early, self._early = self._early, None
        self._router.hop_up(*self._endpoint)
        if early:
            connection.send(early)

    def handle_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Forward a request or an answer of the peer (PacketHandler)."""
        del connection
        self._router.receive(packet, *self._endpoint)

    handle_answer = handle_packet

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Notify the router (PacketHandler)."""
        if self._connection is connection:
            self._connection = None
            self._router.connection_closed(*self._endpoint)
            self._closed.set_result(why)

    def end(self) -> None:
        """Close the connection at once, before its transport is removed."""
        if self._connection is not None:
            self._connection.close("")
            self.connection_closed(self._connection, "the route was removed")

    def _disconnected(self, reason: str, *, has_lasted: bool) -> bool:
        """Mark the peer as down, and log a new reason (ReconnectingLink)."""
        del has_lasted
        self._early = None
        self._router.hop_down(*self._endpoint, reason)
        if self._is_new_reason(reason):
            # A tool that added a route to itself often has no listener: no fault of the plant.
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
            return f"{self.peer.host}: no address within {CONNECT_S:g} s"
        except OSError as exc:
            return f"{self.peer.host}: no address: {exc.strerror or exc}"
        key = host, self.peer.port
        # Two names of one peer: it would close the older of the two connections again and again.
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
        return await self._serve(sock, host)

    async def _serve(self, sock: socket.socket, host: str) -> str:
        """Serve an open connection; return the reason of its end."""
        loop = asyncio.get_running_loop()
        self._closed = loop.create_future()
        try:
            connection = await self._open(sock, host)
        except OSError as exc:
            return f"{self.peer}: {exc.strerror or exc}"
        since = loop.time()
        try:
            # Four checks in that time: the limit is exceeded by a quarter at most.
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
        # A router without a route back closes each connection at once.
        if loop.time() - since < 1:
            return f"{self.peer} closes connections at once: it may have no route back ({why})"
        return f"{self.peer}: {why}"

    async def _open(self, sock: socket.socket, host: str) -> AmsConnection:
        """Return the connection on a connected socket; raise OSError if there cannot be one."""
        loop = asyncio.get_running_loop()
        _, connection = await loop.create_connection(
            lambda: AmsConnection(str(self.peer), host, self, is_outgoing=True), sock=sock
        )
        return connection


def source_for(host: str, sources: Collection[str]) -> str | None:
    """Return the station's source address towards *host*, None for any."""
    # Routers identify peers by their addresses; stations that share a host and its network each use
    # their own.
    for source in sources:
        if host.startswith("127.") and source.startswith("127."):
            return source
        if host.rpartition(".")[0] == source.rpartition(".")[0]:
            return source
    return None


class AmsUplinks:
    """Uplinks of one station: one for each peer that a route names.

    Args:
        router: Router of the station.
        sources: The station's own IPv4 addresses.
        count_dropped: Counts dropped packets.
        settings_of: Returns the settings of the route that leads to a hop by Secure ADS.
    """

    def __init__(
        self,
        router: StationRouter,
        sources: Collection[str],
        count_dropped: Callable[[DropReason], None],
        settings_of: Callable[[Endpoint], SecureRouteSpec] = lambda hop: SecureRouteSpec(),
    ) -> None:
        self._router = router
        self._sources = sources
        self._count_dropped = count_dropped
        self._settings_of = settings_of
        self._used: dict[Endpoint, SecureRouteSpec] = {}
        """Settings of the open ones, by Secure ADS."""
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

    def follow(self) -> None:
        """Connect again where settings of Secure ADS have changed."""
        for hop in list(self._used):
            self._follow(hop)

    def _follow(self, hop: Endpoint) -> None:
        """Open or close the connection to *hop* after its routes changed."""
        if hop.kind not in _UPLINKS or hop.transport == hop.kind:
            return
        is_used = any(route.hop == hop for route in self._router.table)
        if hop in self._uplinks and (not is_used or self._has_changed(hop)):
            self._close(hop)
        if is_used and hop not in self._uplinks:
            self._open(hop)

    def _has_changed(self, hop: Endpoint) -> bool:
        return hop in self._used and self._used[hop] != self._settings_of(hop)

    def _open(self, hop: Endpoint) -> None:
        is_secure = hop.kind == TransportKind.AMS_TLS
        try:
            usual = AMS_TLS_PORT if is_secure else AMS_TCP_PORT
            peer = PeerAddress(*parse_host(hop.connection, usual))
        except ValueError as exc:
            logger.warning("%s: route ignored: %s", self._router.name, exc)
            return
        rest = UplinkArguments(
            sources=self._sources,
            claims=self._claims,
            count_dropped=self._count_dropped,
            may_be_client=lambda: all(
                route.is_client for route in self._router.table if route.hop == hop
            ),
        )
        if is_secure:
            # Imported here: few plants have such a route.
            from eap.services.transports.secure_ads import AmsTlsUplink

            self._used[hop] = self._settings_of(hop)
            uplink: AmsUplink = AmsTlsUplink(
                peer, *hop, self._router, settings=self._used[hop], rest=rest
            )
        else:
            uplink = AmsUplink(peer, *hop, self._router, **rest)
        self._uplinks[hop] = uplink
        self._router.add_transport(Transport(hop.transport, is_stream=True, is_hub=True), uplink)
        self._start(hop)

    def _close(self, hop: Endpoint) -> None:
        if (task := self._tasks.pop(hop, None)) is not None:
            task.cancel()
        self._uplinks.pop(hop).end()
        self._used.pop(hop, None)
        self._router.hop_up(*hop)  # a removed hop has no state
        self._router.remove_transport(hop.transport)

    def _start(self, hop: Endpoint) -> None:
        if self._group is not None:
            self._tasks[hop] = self._group.create_task(self._uplinks[hop].run())
