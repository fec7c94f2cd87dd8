"""One AMS/TCP connection: requests in, and each answer back on it (Beckhoff ADS, AMS/TCP).

Rule 1: one request of a connection is answered before its next one is looked at, so what a client
sends ahead waits in its own connection and nowhere else.
Rule 2: answers know their connection, not their client: clients of one host share its NetID, and
often ports and numbers of requests too.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

from eap.aoe.answer import AmsAnswer, response_to
from eap.aoe.stream import PacketCutter, Piece, TooLong
from eap.appliance.discards import Refusal
from eap.appliance.services.aoe_desk import AoeDesk, find_desk
from eap.codec.ads import AdsError
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags
from eap.codec.amstcp import encode_with_prefix
from eap.errors import MalformedError

LONGEST_PACKET = 256 << 10
"""Octets of an AMS packet; nothing here has a value a quarter as long."""
PATIENCE_S = 10.0
"""How long a packet may take from its first octet to its last, and an answer to be taken."""
_CHUNK = 64 << 10

logger = logging.getLogger(__name__)


class AmsConnection:
    """One client that has connected.

    Args:
        reader: What it sends.
        writer: To it.
        desks: Of the stations behind the listener.
        refuse: Counts what is not answered as it was wanted.
        is_this_host: Whether it runs on this machine: others only read.
    """

    def __init__(
        self,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        desks: Sequence[AoeDesk],
        refuse: Callable[[Refusal], None],
        *,
        is_this_host: bool,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._reader = reader
        self._writer = writer
        self._desks = desks
        self._refuse = refuse
        self._is_this_host = is_this_host
        self._patience_s = patience_s
        self._cutter = PacketCutter(LONGEST_PACKET)
        self._has_warned = False

    async def serve(self) -> None:
        """Answer until the client leaves, or breaks the rules.

        Raises:
            OSError: the connection broke.
        """
        try:
            while (piece := await self._next_piece()) is not None:
                packet = await self._answer(piece)
                if packet is not None:
                    await self._send(packet)
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

    async def _send(self, packet: bytes) -> None:
        self._writer.write(encode_with_prefix(packet))
        if self._writer.transport.get_write_buffer_size():  # mostly the kernel takes it at once
            async with asyncio.timeout(self._patience_s):
                await self._writer.drain()

    async def _answer(self, piece: Piece) -> bytes | None:
        """Return the packet that goes back, None for what has no answer."""
        if isinstance(piece, TooLong):
            header, length = piece
        else:
            header, length = AmsHeader.decode(piece), len(piece)
        if header.state_flags & StateFlags.RESPONSE:
            self._refuse(Refusal.AMS_UNASKED)
            return None
        if isinstance(piece, TooLong) or header.length != length - AmsHeader.SIZE:
            self._refuse(Refusal.AMS_LENGTH)
            answer = AmsAnswer(error_code=AdsError.AMS_LENGTH)
        elif not self._is_this_host and header.command not in _READS:
            answer = self._deny(header)
        else:
            answer = await self._ask(header, piece[AmsHeader.SIZE :])
        no_return = header.state_flags & StateFlags.NO_RETURN
        return None if no_return else response_to(header, answer)

    async def _ask(self, header: AmsHeader, body: bytes) -> AmsAnswer:
        if header.command == AmsCommand.FRAGMENT:
            return AmsAnswer(error_code=AdsError.COMMAND)  # these belong to mailboxes
        found = find_desk(self._desks, header)
        if isinstance(found, AdsError):
            return AmsAnswer(error_code=found)
        desk, services = found
        return await desk.ask(header, body, services)

    def _deny(self, header: AmsHeader) -> AmsAnswer:
        self._refuse(Refusal.AMS_ACCESS)
        if not self._has_warned:
            self._has_warned = True  # a flood of writes is no flood of lines
            command = AmsCommand.name_of(header.command)
            peer = "{}:{}".format(*self._writer.get_extra_info("peername")[:2])
            where = f"{header.target}:{header.target_port}"
            logger.warning("AMS/TCP %s: %s to %s refused: only reads", peer, command, where)
        return AmsAnswer(error_code=AdsError.ACCESS_DENIED)


_READS = frozenset((AmsCommand.READ_DEVICE_INFO, AmsCommand.READ, AmsCommand.READ_STATE))
"""What other hosts may do.  ReadWrite is a write."""
