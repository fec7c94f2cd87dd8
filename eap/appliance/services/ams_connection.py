"""AMS/TCP connections: requests in, and each answer back on its own (Beckhoff ADS, AMS/TCP).

Rule 1: few requests of a connection are under way, and of large ones only one, so what a client
sends ahead waits in its own connection and nowhere else.
Rule 2: answers know their connection, not their client: clients of one host share its NetID, and
often ports and numbers of requests too.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from eap.aoe.answer import AmsAnswer, response_to
from eap.aoe.stream import PacketCutter, Piece, TooLong
from eap.appliance.discards import Refusal
from eap.appliance.services.routing.entrance import Entrance
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags
from eap.codec.amstcp import encode_with_prefix
from eap.errors import MalformedError

LONGEST_PACKET = 256 << 10
"""Octets of an AMS packet; nothing here has a value a quarter as long."""
PATIENCE_S = 10.0
"""How long a packet may take from its first octet to its last, and an answer to be taken."""
MAX_UNANSWERED = 32
"""Requests of one connection that wait for their answers."""
LARGE_REQUEST = 8 << 10
"""Octets of a request that is answered before the next one is looked at."""
_MAX_UNSENT = 1 << 20
"""Octets that wait for a client that does not take them."""
_CHUNK = 64 << 10

logger = logging.getLogger(__name__)


class AmsClients:
    """All AMS/TCP connections of this process by name; the carrier of each station's door."""

    def __init__(self) -> None:
        self._connections: dict[str, AmsConnection] = {}

    def add(self, name: str, connection: AmsConnection) -> None:
        """Take one more."""
        self._connections[name] = connection

    def remove(self, name: str) -> None:
        """Forget one that has ended."""
        del self._connections[name]

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets on a connection; return why not if that cannot be done."""
        client = self._connections.get(connection)
        if client is None:
            return "the connection is closed"
        for packet in packets:
            client.send(packet)
        return None


class AmsConnection:
    """One client that has connected.

    Args:
        name: Of the connection.
        reader: What it sends.
        writer: To it.
        entrance: To the stations behind the listener.
        refuse: Counts what is not answered as it was wanted.
    """

    def __init__(
        self,
        name: str,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        entrance: Entrance,
        refuse: Callable[[Refusal], None],
        *,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._name = name
        self._reader = reader
        self._writer = writer
        self._entrance = entrance
        self._refuse = refuse
        self._patience_s = patience_s
        self._cutter = PacketCutter(LONGEST_PACKET)

    async def serve(self) -> None:
        """Answer until the client leaves, or breaks the rules.

        Raises:
            OSError: the connection broke.
        """
        try:
            while (piece := await self._next_piece()) is not None:
                self._take(piece)
                is_large = len(piece) > LARGE_REQUEST
                await self._entrance.wait_below(self._name, 1 if is_large else MAX_UNANSWERED)
                if self._writer.transport.get_write_buffer_size():  # mostly it is gone at once
                    async with asyncio.timeout(self._patience_s):
                        await self._writer.drain()
        except MalformedError as exc:
            logger.debug("AMS/TCP connection closed: %s", exc)
            self._refuse(Refusal.AMS_TYPE)
        except TimeoutError as exc:
            if exc.errno is not None:
                raise  # the kernel found out that the client has vanished
            self._refuse(Refusal.AMS_SLOW)

    async def _next_piece(self) -> Piece | None:
        """Return what comes next, None at the end; a silence between packets may last."""
        deadline: float | None = None
        if (piece := self._cutter.next_piece()) is not None:
            await asyncio.sleep(0)  # others first: who sends ahead has had an answer just now
        while piece is None:
            if self._cutter.has_begun and deadline is None:
                deadline = asyncio.get_running_loop().time() + self._patience_s
            if deadline is None:
                data = await self._reader.read(_CHUNK)
            else:
                async with asyncio.timeout_at(deadline):
                    data = await self._reader.read(_CHUNK)
            if not data:
                return None
            self._cutter.receive(data)
            piece = self._cutter.next_piece()
        return piece

    def _take(self, piece: Piece) -> None:
        """Hand a request on, or say what is wrong with it."""
        if isinstance(piece, TooLong):
            header, length = piece
        else:
            header, length = AmsHeader.decode(piece), len(piece)
        if header.state_flags & StateFlags.RESPONSE:
            self._refuse(Refusal.AMS_UNASKED)
        elif isinstance(piece, TooLong) or header.length != length - AmsHeader.SIZE:
            self._refuse(Refusal.AMS_LENGTH)
            self._answer(header, AdsError.AMS_LENGTH)
        elif header.command == AmsCommand.FRAGMENT:
            self._answer(header, AdsError.COMMAND)  # these belong to mailboxes
        else:
            self._entrance.receive(piece, self._name)

    def send(self, packet: bytes) -> None:
        """Send a packet, unless the client takes nothing any more."""
        if self._writer.transport.get_write_buffer_size() > _MAX_UNSENT:
            self._refuse(Refusal.AMS_SLOW)
            self._writer.transport.abort()
        elif not self._writer.is_closing():
            self._writer.write(encode_with_prefix(packet))

    def _answer(self, header: AmsHeader, error: AdsError) -> None:
        if not header.state_flags & StateFlags.NO_RETURN:
            self.send(response_to(header, AmsAnswer(error_code=error)))
