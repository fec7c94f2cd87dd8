"""AMS/TCP as a client: the connection of a station to one peer, kept open and opened again.

Rule 1: there is one connection for each peer, however many NetIDs are behind it: routers close the
older one of two.
Rule 2: the peer may ask on it too, and is answered on it.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Collection, Iterable
from time import monotonic_ns
from typing import NamedTuple, Protocol

from eap.appliance.discards import Refusal
from eap.appliance.services.ams.ams_connection import AmsConnection
from eap.appliance.services.resolving import resolve
from eap.net.backoff import Backoff
from eap.net.connections import OVERDUE_NS, CloseReason
from eap.net.tcp import set_keepalive

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


logger = logging.getLogger(__name__)


class Hops(Protocol):
    """What a connection to a peer needs of the router of its station."""

    @property
    def name(self) -> str:
        """Name of the station."""

    def receive(self, data: bytes, door: str, connection: str) -> None:
        """Act on a packet; what has to be said goes to ``AmsUplink.send``."""

    def connection_closed(self, door: str, connection: str) -> None:
        """Forget what the peer asked for."""

    def hop_down(self, door: str, address: str | None, text: str) -> None:
        """Answer what waits for the peer, and what will be for it."""

    def hop_up(self, door: str, address: str | None) -> None:
        """Pass requests on to it again."""


class Peer(NamedTuple):
    """Where a peer listens."""

    host: str
    """Name or address."""
    port: int

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class AmsUplink:
    """The connection to one peer.

    Args:
        peer: Whom to connect to.
        door: Its name at the router.
        address: By which routes name the peer.
        router: Of the station.
        sources: The station's own IPv4 addresses.
        claims: Peers that the station is connected with, by address and port: all its uplinks share
            it.
        refuse: Counts what is not taken.
        may_be_client: Says whether the peer may be a client that does not listen.
    """

    def __init__(
        self,
        peer: Peer,
        door: str,
        address: str,
        router: Hops,
        *,
        sources: Collection[str],
        claims: dict[tuple[str, int], AmsUplink],
        refuse: Callable[[Refusal], None],
        may_be_client: Callable[[], bool] = bool,
        patience_ns: int = OVERDUE_NS,
    ) -> None:
        self.peer = peer
        self._may_be_client = may_be_client
        self._was_open = False
        self.refuse = refuse
        self._way = door, address
        self._router = router
        self._sources = sources
        self._claims = claims
        self._patience_ns = patience_ns
        self._connection: AmsConnection | None = None
        self._closed: asyncio.Future[str]
        self._early: list[bytes] | None = []
        self._said = ""

    async def serve(self) -> None:
        """Keep the connection until cancelled."""
        loop = asyncio.get_running_loop()
        backoff = Backoff(FIRST_WAIT_S, LONGEST_WAIT_S)
        while True:
            since = loop.time()
            why = await self._try()
            if loop.time() - since > _STABLE_S:
                backoff.reset()
            self._early = None
            self._router.hop_down(*self._way, why)
            if why != self._said:  # it is tried again and again
                self._said = why
                if self._may_be_client() and not self._was_open:
                    text = "%s: %s; a client added the route to it, and does not listen"
                    logger.info(text, self._router.name, why)
                else:
                    logger.warning("%s: %s", self._router.name, why)
            await asyncio.sleep(backoff.next_s())

    def send(self, connection: str, packets: Iterable[bytes]) -> str | None:
        """Send packets to the peer; return why not if that cannot be done (Carrier)."""
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
        """Send what has waited (PacketTaker)."""
        self._connection = connection
        self._was_open = True
        early, self._early = self._early, None
        self._router.hop_up(*self._way)
        if early:
            connection.send(early)

    def take_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Hand a request of the peer on (PacketTaker)."""
        del connection
        self._router.receive(packet, *self._way)

    def take_answer(self, packet: bytes, connection: AmsConnection) -> None:
        """Hand an answer of the peer on (PacketTaker)."""
        del connection
        self._router.receive(packet, *self._way)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Tell the router (PacketTaker)."""
        if self._connection is connection:
            self._connection = None
            self._router.connection_closed(*self._way)
            self._closed.set_result(why)

    def end(self) -> None:
        """Close the connection at once, before the door is gone."""
        if self._connection is not None:
            self._connection.close("")
            self.connection_closed(self._connection, "the route was removed")

    async def _try(self) -> str:
        """Connect, and wait for the end; return why there is no connection, or none any more."""
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
            return await self._connect(host)
        finally:
            del self._claims[key]

    async def _connect(self, host: str) -> str:
        try:
            async with asyncio.timeout(CONNECT_S):
                sock = await _open(host, self.peer.port, source_for(host, self._sources))
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
            while not (await asyncio.wait([self._closed], timeout=self._patience_ns / 4e9))[0]:
                late_ns = connection.late_since_ns
                if late_ns is not None and monotonic_ns() - late_ns >= self._patience_ns:
                    connection.close(CloseReason.OVERDUE)
                if self._said:
                    self._said = ""
                    logger.info("%s: connected to %s", self._router.name, self.peer)
        finally:
            connection.close("the appliance ends")
        why = self._closed.result()
        if loop.time() - since < 1:
            return f"{self.peer} closes connections at once: it may have no route back ({why})"
        return f"{self.peer}: {why}"


async def _open(host: str, port: int, source: str | None) -> socket.socket:
    """Return a socket that is connected; raise OSError if that fails."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        set_keepalive(sock, _UNCONFIRMED_S)
        if source is not None:
            sock.bind((source, 0))
        await asyncio.get_running_loop().sock_connect(sock, (host, port))
        if sock.getsockname() == sock.getpeername():
            raise ConnectionRefusedError  # noqa: TRY301  it met itself: nobody listens there
    except BaseException:
        sock.close()
        raise
    return sock


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
