"""The TCP listener of a station: who connects shows by the first frame where it belongs.

Type 4 goes to the engine, descriptor and all; nothing is read here, so the engine finds the frame
whole.  Type 5 is answered in this process.  All other connections are closed, and the reason is
counted at the station.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.net.connections import CloseReason, Limits
from eap.net.tcp import set_stream_options
from eap.runtime.discards import Refusal
from eap.runtime.handover import PortName
from eap.runtime.passing import PassedConnection, pass_connection
from eap.services.transports.accepting import Listeners, ListeningSocket, wait_readable
from eap.services.transports.mailbox_stream import MailboxStreams, StreamConnection

LIMITS = Limits()
_PEEK_PAUSE_S = 0.02

logger = logging.getLogger(__name__)


class TcpTransport:
    """One listening socket and the ports behind it.

    Connections of type 4 leave the account of this process when they go to the engine, which has
    one of its own for each port (:class:`eap.net.tcpport.TcpPort`).

    Args:
        listener: Opened by the supervisor; it stays open.
        takers: Ports that take type 4 from TCP; may be empty.
        link: To the engine.
        refuse: Counts a connection that was closed.
        streams: Take the connections of type 5.
        listeners: Of this process.
    """

    def __init__(
        self,
        listener: socket.socket,
        takers: tuple[PortName, ...],
        link: socket.socket,
        refuse: Callable[[Refusal], None],
        streams: MailboxStreams,
        listeners: Listeners,
    ) -> None:
        self._takers = takers
        self._link = link
        self._refuse = refuse
        self._mailboxes = streams
        name = "tcp {}:{}".format(*listener.getsockname())
        self._listening = ListeningSocket(listener, name, self, listeners, LIMITS)

    async def serve(self) -> None:
        """Accept until cancelled."""
        try:
            await self._listening.serve()
        finally:
            await self._mailboxes.close()

    def connection_from(self, sock: socket.socket, host: str) -> StreamConnection:
        """Return the connection on a socket that was accepted (ConnectionServer)."""
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
                self._refuse(Refusal.TCP_SLOW)

    def refuse_connection(self, sock: socket.socket, why: str) -> None:
        """Count a connection that gets no place (ConnectionServer)."""
        del sock, why
        self._refuse(Refusal.TCP_FULL)

    def _dispatch(self, sock: socket.socket, host: str, frame_type: int) -> None:
        if frame_type != FrameType.PROCESS_DATA:
            reason = Refusal.WRONG_TYPE
        elif not self._takers:
            reason = Refusal.TCP_OFF
        elif pass_connection(self._link, sock, PassedConnection(self._takers, host)):
            return
        else:
            reason = Refusal.ENGINE_BUSY
        logger.debug("TCP connection from %s closed: %s", host or "this host", reason)
        self._refuse(reason)


async def _first_type(connection: StreamConnection, sock: socket.socket) -> int:
    """Return the type in the first frame header, which stays in the socket.

    Raises:
        OSError: the peer closed before it sent a whole header.
    """
    while True:
        await wait_readable(sock)
        head = sock.recv(EtherCatHeader.SIZE, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        if not head:
            raise ConnectionError("closed before the first frame")
        if len(head) == EtherCatHeader.SIZE:
            return EtherCatHeader.decode(head).type
        connection.note_partial()
        await asyncio.sleep(_PEEK_PAUSE_S)  # one octet stays readable: do not spin on it
