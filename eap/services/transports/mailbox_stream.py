"""Frames over TCP 34980: the listener of a station, its connections, and those to other stations.

The type of the first frame decides on an accepted connection.  Type 4 goes to the engine with its
descriptor; the header is only peeked at, so the engine reads the whole frame.  Type 5 is served in
this process.  All other connections are closed, and the reason is counted at the station.

A connection to another station is opened when there is data to send, and again when it breaks.
Data sent before it is open waits for it, in bounded memory.  A hop that cannot be reached is down,
so that requests for it are answered at once; it is tried again with growing pauses for as long as a
route leads to it.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import deque
from collections.abc import Awaitable, Callable
from typing import TypeAlias

from eap.codec.ams import StateFlags
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.mailbox import MailboxHeader
from eap.net.limits import OWN_HOST, Activity, CloseReason, ListenerLimits
from eap.net.reconnecting import ReconnectingLink, ReconnectPolicy, connect_tcp
from eap.net.tcp import set_stream_options
from eap.runtime.drop_counters import DropReason
from eap.runtime.handover import PortName
from eap.runtime.passing import PassedConnection, pass_connection
from eap.services.tasks import TaskSet
from eap.services.transports.accepting import (
    Listeners,
    ListeningSocket,
    TaskConnection,
    connection_name,
    wait_readable,
)
from eap.services.transports.ams_connection import SubscriptionCounter
from eap.services.transports.demultiplexer import Demultiplexer
from eap.services.transports.mailbox_frames import FrameCounters, FrameHandler, aoe_packet

CONNECT_S = 3.0
"""Time limit for connecting."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 8.0
_LASTING_S = 5.0
"""A connection that ends sooner counts as a failed attempt."""
_UNCONFIRMED_S = 10.0
"""Time without acknowledgement of sent data until the connection is closed (TCP_USER_TIMEOUT)."""
_MAX_WAITING = 256 << 10
"""Limit of the bytes that wait for one connection."""

Write: TypeAlias = Callable[[bytes], None]
Serve: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter, str], Awaitable[None]]
"""Serves a connection to the named address until its end."""


class StreamUplinks:
    """Connections of one transport to other stations, by ``ADDRESS:PORT``.

    Args:
        hops: Notified of hops that are down or up.
        serve: Serves a connection.
        source: Own address to connect from; empty for any.
    """

    def __init__(self, hops: Demultiplexer, serve: Serve, source: str = "") -> None:
        self._hops = hops
        self._serve = serve
        self._source = source
        self._uplinks: dict[str, _StreamUplink] = {}
        self._tasks = TaskSet("connections to other stations")

    def send(self, address: str, data: bytes) -> str | None:
        """Send *data* now or as soon as there is a connection; return the reason of a failure."""
        uplink = self._uplinks.get(address)
        if uplink is None:
            if not _is_address(address):
                return "the connection is closed"
            uplink = _StreamUplink(address, self._source, self._hops, self._serve)
            self._uplinks[address] = uplink
            self._tasks.start(self._run(address, uplink))
        return uplink.send(data)

    async def close(self) -> None:
        """Close all connections."""
        await self._tasks.close()

    async def _run(self, address: str, uplink: _StreamUplink) -> None:
        try:
            await uplink.run()
        finally:
            del self._uplinks[address]
            self._hops.hop_up(address)


class _StreamUplink(ReconnectingLink):
    """Connection to one other station, and the data that waits for it."""

    def __init__(self, address: str, source: str, hops: Demultiplexer, serve: Serve) -> None:
        super().__init__(ReconnectPolicy(FIRST_PAUSE_S, LONGEST_PAUSE_S, _LASTING_S))
        self._address = address
        self._source = source or None
        self._hops = hops
        self._serve = serve
        self._writer: asyncio.StreamWriter | None = None
        self._waiting: deque[bytes] = deque()
        self._octets = 0

    def send(self, data: bytes) -> str | None:
        """Send data, or keep it for the next connection; return the reason of a failure."""
        if self._writer is not None:
            if self._writer.is_closing():
                return "the connection is closed"
            if self._writer.transport.get_write_buffer_size() > _MAX_WAITING:
                return "the peer does not read"
            self._writer.write(data)
            return None
        if self._octets + len(data) > _MAX_WAITING:
            return "the queue of the connection is full"
        self._octets += len(data)
        self._waiting.append(data)
        return None

    async def _connect(self) -> str:
        """Connect, and serve until the end (ReconnectingLink)."""
        host, _, port = self._address.rpartition(":")
        try:
            sock = await connect_tcp(
                host,
                int(port),
                self._source,
                timeout_s=CONNECT_S,
                unconfirmed_s=_UNCONFIRMED_S,
            )
        except TimeoutError:
            return f"no connection within {CONNECT_S:g} s"
        except OSError as exc:
            return f"no connection: {exc.strerror or exc}"
        reader, writer = await asyncio.open_connection(sock=sock)
        try:
            self._hops.hop_up(self._address)
            self._writer = writer
            writer.writelines(self._waiting)
            self._forget()
            await self._serve(reader, writer, self._address)
        except (OSError, TimeoutError) as exc:
            return f"connection lost: {exc.strerror or 'the peer does not read'}"
        finally:
            self._writer = None
            writer.transport.abort()
        return ""

    def _disconnected(self, reason: str, *, has_lasted: bool) -> bool:
        """Mark the hop as down, unless no answer is pending (ReconnectingLink)."""
        del has_lasted
        self._forget()
        # A peer may close an idle connection; the next request opens it again.
        if not reason and not self._hops.is_awaited(self._address):
            return False
        self._hops.hop_down(self._address, reason or "the connection was closed")
        return True

    def _is_wanted(self) -> bool:
        """Return whether a route leads there (ReconnectingLink)."""
        return self._hops.has_route_to(self._address)

    def _forget(self) -> None:
        self._waiting.clear()
        self._octets = 0


def _is_address(text: str) -> bool:
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdecimal()


SLOW_READER_S = 10.0
"""Time without reading, while answers wait, until a peer is disconnected."""
LARGEST_FRAME = EtherCatHeader.SIZE + 0x7FF
"""Largest value of the 11-bit Length, with the frame header."""
MAX_UNANSWERED = 64
"""Limit of the pending requests of one connection; later ones stay in the socket."""
MAX_AT_GATEWAY = 16
"""Likewise, requests to slaves and masters."""
_FLAGS, _RESPONSE = 18, StateFlags.RESPONSE.value
"""Offset of the AMS state flags, and their bit for answers."""
_MAX_UNSENT = 1 << 20
"""Limit of the bytes that a client has not read."""


class StreamConnection(TaskConnection):
    """Accepted connection of a TCP listener.

    Attributes:
        subscriptions: Notifications of its client.
        waiting: Returns the number of its pending requests.
    """

    def __init__(self, host: str) -> None:
        super().__init__(host)
        self.subscriptions = SubscriptionCounter()
        self.waiting: Callable[[], int] = int

    @property
    def activity(self) -> Activity:
        """Current use, for the policy."""
        if self.subscriptions.count:
            return Activity.SUBSCRIBED
        return Activity.BUSY if self.waiting() else super().activity


class MailboxStreams:
    """All connections of one port, accepted and opened; sender of its transport.

    Args:
        demultiplexer: To the stations behind the port.
        gateway: For all but AoE to a station.
        count_dropped: Counts dropped frames.
        source: Own address to connect from; empty for any.
        is_aoe_here: Whether AoE is for the stations; otherwise the gateway gets it too.
    """

    def __init__(
        self,
        demultiplexer: Demultiplexer,
        gateway: FrameHandler,
        count_dropped: Callable[[DropReason], None],
        source: str = "",
        *,
        is_aoe_here: bool = True,
    ) -> None:
        self._demultiplexer = demultiplexer
        self._gateway = gateway
        self._count_dropped = count_dropped
        self._is_aoe_here = is_aoe_here
        self._uplinks = StreamUplinks(demultiplexer, self._serve_uplink, source)
        self._counters = FrameCounters()
        self._streams: dict[str, tuple[asyncio.StreamWriter, StreamConnection]] = {}

    async def serve(self, connection: StreamConnection, sock: socket.socket) -> None:
        """Serve an accepted connection until its end, and close it.

        Its first frame may have been peeked at; it is still in the socket.
        """
        reader, writer = await asyncio.open_connection(sock=sock)
        name = connection_name(sock)
        self._streams[name] = writer, connection
        connection.waiting = lambda: self._demultiplexer.waiting(name) + self._gateway.waiting(name)
        try:
            await self._handle_frames(reader, writer, name, connection)
            async with asyncio.timeout(SLOW_READER_S):
                # A client that closed its sending side may still read.
                await self._demultiplexer.wait_below(name, 1)
                await self._gateway.wait_below(name, 1)
                writer.close()
                await writer.wait_closed()
        except TimeoutError:
            connection.closed_for = CloseReason.OVERDUE
        except OSError:
            pass
        finally:
            writer.transport.abort()
            del self._streams[name]
            self._demultiplexer.connection_closed(name)
            self._gateway.connection_closed(name)

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets on a connection; return the reason of a failure."""
        frames = b"".join(self._counters.frame(connection, packet) for packet in packets)
        if connection not in self._streams:
            return self._uplinks.send(connection, frames)
        if packets[0][_FLAGS] & _RESPONSE:
            self._streams[connection][1].subscriptions.note_answer(packets[0])
        return self.send_frame(connection, frames)

    def send_frame(self, connection: str, frame: bytes) -> str | None:
        """Send a complete frame on an accepted connection; returns as :meth:`send` does."""
        found = self._streams.get(connection)
        if found is None or found[0].is_closing():
            return "the connection is closed"
        writer, _ = found
        if writer.transport.get_write_buffer_size() > _MAX_UNSENT:
            writer.transport.abort()
            return "the peer does not read"
        writer.write(frame)
        return None

    async def close(self) -> None:
        """Close the connections to other stations."""
        await self._uplinks.close()

    async def _serve_uplink(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, name: str
    ) -> None:
        try:
            await self._handle_frames(reader, writer, name, StreamConnection(OWN_HOST))
        finally:
            self._demultiplexer.connection_closed(name)

    async def _handle_frames(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        name: str,
        connection: StreamConnection,
    ) -> None:
        """Handle frames until the end, or until an invalid one."""
        while True:
            try:
                # The first byte starts the time limit of a frame; silence before it may last.
                head = await reader.readexactly(1)
                connection.note_partial()
                head += await reader.readexactly(EtherCatHeader.SIZE - 1)
                header = EtherCatHeader.decode(head)
                # A stream has no boundaries to resume at after an invalid header.
                if header.type != FrameType.MAILBOX or header.length < MailboxHeader.SIZE:
                    self._count_dropped(DropReason.TCP_TYPE)
                    return
                frame = head + await reader.readexactly(header.length)
            except asyncio.IncompleteReadError:
                return
            connection.note_frame()
            packet = aoe_packet(frame) if self._is_aoe_here else None
            if packet is not None:
                connection.subscriptions.note_request(packet)
                self._demultiplexer.receive(packet, name)
                await self._demultiplexer.wait_below(name, MAX_UNANSWERED)
            else:
                refusal = self._gateway.receive(frame, name, self.send_frame)
                if refusal is not None:
                    self._count_dropped(refusal)
                await self._gateway.wait_below(name, MAX_AT_GATEWAY)
            async with asyncio.timeout(SLOW_READER_S):
                await writer.drain()
            await asyncio.sleep(0)  # a fast sender must not keep the loop from other connections


LIMITS = ListenerLimits()
_PEEK_PAUSE_S = 0.02

logger = logging.getLogger(__name__)


class TcpTransport:
    """One listening socket and the ports behind it.

    A connection of type 4 leaves the connection table of this process when the engine gets it; the
    engine has one for each port (:class:`eap.net.tcpport.TcpPort`).

    Args:
        listener: Opened by the supervisor; closed by :meth:`close`.
        takers: Ports that accept type 4 by TCP; may be empty.
        link: Link to the engine.
        count_dropped: Counts closed connections.
        streams: Serves the connections of type 5.
        listeners: All listeners of the process.

    Attributes:
        takers: As above; may change.
    """

    def __init__(
        self,
        listener: socket.socket,
        takers: tuple[PortName, ...],
        link: socket.socket,
        count_dropped: Callable[[DropReason], None],
        streams: MailboxStreams,
        listeners: Listeners,
    ) -> None:
        self.takers = takers
        self._link = link
        self._count_dropped = count_dropped
        self._mailboxes = streams
        name = "tcp {}:{}".format(*listener.getsockname())
        self._listening = ListeningSocket(listener, name, self, listeners, LIMITS)

    async def serve(self) -> None:
        """Accept until cancelled."""
        try:
            await self._listening.serve()
        finally:
            await self._mailboxes.close()

    def close(self) -> None:
        """Close the listener, which is not served any more."""
        self._listening.close()

    def connection_from(self, sock: socket.socket, host: str) -> StreamConnection:
        """Return the connection on an accepted socket (ConnectionServer)."""
        set_stream_options(sock)
        return StreamConnection(host)

    async def serve_connection(self, connection: StreamConnection, sock: socket.socket) -> None:
        """Serve a connection until its end, or pass it to the engine (ConnectionServer)."""
        connection.begin()
        try:
            frame_type = await _first_type(connection, sock)
            if frame_type == FrameType.MAILBOX:
                await self._mailboxes.serve(connection, sock)
            else:
                self._dispatch(sock, connection.host, frame_type)
        finally:
            if connection.closed_for is CloseReason.OVERDUE:
                self._count_dropped(DropReason.TCP_SLOW)

    def refuse_connection(self, sock: socket.socket, why: str) -> None:
        """Count a connection that is not admitted (ConnectionServer)."""
        del sock, why
        self._count_dropped(DropReason.TCP_FULL)

    def _dispatch(self, sock: socket.socket, host: str, frame_type: int) -> None:
        if frame_type != FrameType.PROCESS_DATA:
            reason = DropReason.WRONG_TYPE
        elif not self.takers:
            reason = DropReason.TCP_OFF
        elif pass_connection(self._link, sock, PassedConnection(self.takers, host)):
            return
        else:
            reason = DropReason.ENGINE_BUSY
        logger.debug("TCP connection from %s closed: %s", host or "this host", reason)
        self._count_dropped(reason)


async def _first_type(connection: StreamConnection, sock: socket.socket) -> int:
    """Return the type in the first frame header, which stays in the socket.

    Raises:
        OSError: the peer closed the connection before a whole header.
    """
    while True:
        await wait_readable(sock)
        # Peeked, because the descriptor may go to the engine, which reads the whole frame.
        head = sock.recv(EtherCatHeader.SIZE, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        if not head:
            raise ConnectionError("closed before the first frame")
        if len(head) == EtherCatHeader.SIZE:
            return EtherCatHeader.decode(head).type
        connection.note_partial()
        await asyncio.sleep(_PEEK_PAUSE_S)  # one byte stays readable: do not spin on it
