"""The TCP listener of a station: who connects shows by the first frame where it belongs.

Type 4 goes to the engine, descriptor and all; nothing is read here, so the engine finds the frame
whole.  Type 5 is answered in this process.  All other connections are closed, and the reason is
counted at the station.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Coroutine
from typing import Any

from eap.appliance.discards import Refusal
from eap.appliance.handover import PortName
from eap.appliance.passing import PassedConnection, pass_connection
from eap.appliance.services.accepting import accept_connections
from eap.appliance.services.routing.mailbox_stream import MailboxStreams
from eap.codec.ethercat import EtherCatHeader, FrameType

FIRST_FRAME_S = 5.0
"""How long a connection may stay silent before its first frame header."""
MAX_WAITING = 64
"""Connections of one listener whose first frame has not come yet."""
MAX_STREAMS = 64
"""Connections of one listener that carry type 5."""
_PEEK_PAUSE_S = 0.02

logger = logging.getLogger(__name__)


class TcpDoor:
    """One listening socket and the ports behind it.

    Args:
        listener: Opened by the supervisor; it stays open.
        takers: Ports that take type 4 from TCP; may be empty.
        link: To the engine.
        refuse: Counts a connection that was closed.
        streams: Take the connections of type 5.
    """

    def __init__(
        self,
        listener: socket.socket,
        takers: tuple[PortName, ...],
        link: socket.socket,
        refuse: Callable[[Refusal], None],
        streams: MailboxStreams,
        *,
        first_frame_s: float = FIRST_FRAME_S,
    ) -> None:
        self._listener = listener
        self._takers = takers
        self._link = link
        self._refuse = refuse
        self._mailboxes = streams
        self._first_frame_s = first_frame_s
        self._waiting = 0
        self._streams = 0

    async def serve(self) -> None:
        """Accept until cancelled."""
        try:
            await accept_connections(self._listener, "TCP", self._take)
        finally:
            await self._mailboxes.close()

    def _take(
        self, connection: socket.socket, address: tuple[str, int]
    ) -> Coroutine[Any, Any, None] | None:
        peer = "{}:{}".format(*address)
        if self._waiting >= MAX_WAITING:
            self._close(connection, peer, Refusal.TCP_FULL)
            return None
        self._waiting += 1
        return self._sort(connection, peer)

    async def _sort(self, connection: socket.socket, peer: str) -> None:
        try:
            async with asyncio.timeout(self._first_frame_s):
                frame_type = await _first_type(connection)
        except TimeoutError:
            self._close(connection, peer, Refusal.TCP_SILENT)
            return
        except OSError:
            connection.close()  # it left before it said anything
            return
        except asyncio.CancelledError:
            connection.close()
            raise
        finally:
            self._waiting -= 1
        if frame_type == FrameType.MAILBOX:
            await self._serve_stream(connection, peer)
        else:
            self._dispatch(connection, peer, frame_type)

    async def _serve_stream(self, connection: socket.socket, peer: str) -> None:
        if self._streams >= MAX_STREAMS:
            self._close(connection, peer, Refusal.TCP_FULL)
            return
        self._streams += 1
        try:
            await self._mailboxes.serve(connection)
        except Exception:  # one connection is no reason to end all of them
            logger.exception("TCP connection from %s", peer)
        finally:
            self._streams -= 1

    def _dispatch(self, connection: socket.socket, peer: str, frame_type: int) -> None:
        if frame_type != FrameType.PROCESS_DATA:
            self._close(connection, peer, Refusal.WRONG_TYPE)
        elif not self._takers:
            self._close(connection, peer, Refusal.TCP_OFF)
        elif pass_connection(self._link, connection, PassedConnection(self._takers, peer)):
            connection.close()
        else:
            self._close(connection, peer, Refusal.ENGINE_BUSY)

    def _close(self, connection: socket.socket, peer: str, reason: Refusal) -> None:
        logger.debug("TCP connection from %s closed: %s", peer, reason)
        self._refuse(reason)
        connection.close()


async def _first_type(connection: socket.socket) -> int:
    """Return the type in the first frame header, which stays in the socket.

    Raises:
        OSError: the peer closed before it sent a whole header.
    """
    while True:
        await _wait_readable(connection)
        head = connection.recv(EtherCatHeader.SIZE, socket.MSG_PEEK | socket.MSG_DONTWAIT)
        if not head:
            raise ConnectionError("closed before the first frame")
        if len(head) == EtherCatHeader.SIZE:
            return EtherCatHeader.decode(head).type
        await asyncio.sleep(_PEEK_PAUSE_S)  # one octet stays readable: do not spin on it


async def _wait_readable(connection: socket.socket) -> None:
    loop = asyncio.get_running_loop()
    readable = loop.create_future()
    fd = connection.fileno()
    loop.add_reader(fd, _set_once, readable)
    try:
        await readable
    finally:
        loop.remove_reader(fd)


def _set_once(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)
