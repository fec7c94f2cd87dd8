"""FoE in front of a slave: a file of one client, fetched ahead of it or sent on behind it.

Packets come and go at the client's speed, the file at the slave's.  A client that has to wait is
answered BUSY; a client that stops keeps the slave no longer than its session lasts (ETG.1000.6
knows one file of a server at a time).
"""

from __future__ import annotations

import asyncio
import math

from devicebus.errors import FoeError
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.foe import (
    DATA_OVERHEAD,
    Busy,
    FoeErrorCode,
    FoeHeader,
    FoeOpcode,
    encode_message,
    text_of,
)
from eap.codec.mailbox import MailboxHeader
from eap.errors import MalformedError
from eap.gateway.error_table import Cause
from eap.gateway.refusal import GatewayError
from eap.gateway.request_tracker import MemoryShare
from eap.services.slaves.access import SlaveAccess
from eap.services.slaves.file_stream import FileStream

AHEAD = 4 << 20
"""Octets of a file that are fetched ahead of a client, as far as there is memory for them."""
_LEAST_AHEAD = 64 << 10
_BUSY = encode_message(FoeOpcode.BUSY, Busy(0, 100).number)
_STEPS = frozenset((FoeOpcode.DATA, FoeOpcode.ACK))


class FileCodec:
    """The file that one client reads or writes; a SessionCodec.

    Args:
        access: The slave.
        sizes: Of its mailboxes, until a file is open: what fills them is not a file's last packet.
        memory: For what is fetched ahead.
        wait_s: How long the client waits before it is answered BUSY.
    """

    def __init__(
        self, access: SlaveAccess, sizes: MailboxSizes, memory: MemoryShare, wait_s: float
    ) -> None:
        self.sizes = sizes
        self._access = access
        self._memory = memory
        self._wait_s = wait_s
        self._file: FileStream | None = None
        self._opened = b""
        self._is_write = self._is_last = self._is_taken = False
        self._number: int | None = None
        self._sent = b""

    @property
    def is_running(self) -> bool:
        """Whether a file is open, or is to be opened when the slave has time."""
        return self._file is not None

    @property
    def stalled_since_s(self) -> float:
        """Time since which the slave waits for this client; infinite while it need not."""
        since_s = self._file.stalled_since_s if self._file is not None else None
        return math.inf if since_s is None else since_s

    @property
    def waits_for_turn(self) -> bool:
        """Whether this file waits for those of other clients."""
        return self._file is not None and not self._file.has_turn

    def is_step(self, body: bytes) -> bool:
        """Return whether a request is a packet, or confirms one."""
        return body[:1] in {bytes((opcode,)) for opcode in _STEPS}

    def completes_write(self, body: bytes) -> bool:
        """Return that BUSY answers what takes long."""
        del body
        return False

    def reset(self) -> None:
        """Give up the file if it is not complete."""
        file, self._file = self._file, None
        if file is not None:
            file.close()
        self._memory.hold(0)

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answer to a message: BUSY if it has to wait and the slave is still there."""
        try:
            head = FoeHeader.decode(body)
        except MalformedError:
            self.reset()
            return [encode_message(FoeOpcode.ERROR, FoeErrorCode.ILLEGAL)]
        if head.opcode is FoeOpcode.ERROR:
            self.reset()
            return []
        if head.opcode is FoeOpcode.DATA and len(body) + MailboxHeader.SIZE > self.sizes.to_slave:
            raise GatewayError(Cause.TOO_LONG)
        try:
            async with asyncio.timeout(self._wait_s):
                return await self._step(head, body)
        except TimeoutError:
            await self._access.probe()
            return [_BUSY]
        except FoeError as exc:
            self.reset()
            text = exc.text.encode()[: self.sizes.data_to_master - FoeHeader.SIZE]
            return [encode_message(FoeOpcode.ERROR, exc.code, text)]

    async def _step(self, head: FoeHeader, body: bytes) -> list[bytes]:
        """Do one step; one that is cut short by BUSY goes on when it comes again."""
        data = body[FoeHeader.SIZE :]
        if head.opcode in {FoeOpcode.READ, FoeOpcode.WRITE}:
            return await self._open(body, text_of(data), head)
        if self._file is not None and self._number is not None:
            if head.opcode is FoeOpcode.DATA and self._is_write:
                return await self._take(self._file, head.number, data)
            if head.opcode is FoeOpcode.ACK and not self._is_write:
                if head.number != self._number:
                    raise _wrong_number(head.number, self._number)
                if self._is_last:
                    self.reset()
                    return []
                return await self._send_next(self._file)
            if head.opcode is FoeOpcode.BUSY and not self._is_write:
                return [self._sent]
        text = f"{head.opcode.name} without a transfer"
        raise FoeError(text, code=FoeErrorCode.ILLEGAL, text=text)

    async def _open(self, body: bytes, name: str, head: FoeHeader) -> list[bytes]:
        file = self._file
        if file is None or self._number is not None or body != self._opened:
            self.reset()
            self._opened, self._is_write = body, head.opcode is FoeOpcode.WRITE
            self._number, self._is_last, self._is_taken = None, False, False
            ahead = AHEAD if not self._is_write and self._memory.hold(AHEAD) else _LEAST_AHEAD
            file = self._access.open_file(name, head.number, is_write=self._is_write, ahead=ahead)
            self._file = file
        await file.wait_open()
        self.sizes = file.sizes
        if not self._is_write:
            return await self._send_next(file)
        self._number = 0
        return [encode_message(FoeOpcode.ACK, 0)]

    async def _send_next(self, file: FileStream) -> list[bytes]:
        room = self.sizes.to_master - DATA_OVERHEAD
        data = await file.read(room)
        self._number = (self._number or 0) + 1
        self._is_last = len(data) < room
        self._sent = encode_message(FoeOpcode.DATA, self._number, data)
        return [self._sent]

    async def _take(self, file: FileStream, number: int, data: bytes) -> list[bytes]:
        if number != (self._number or 0) + 1:
            raise _wrong_number(number, (self._number or 0) + 1)
        if not self._is_taken:
            await file.write(data)
            self._is_taken = True  # also if its end takes longer
        if len(data) < self.sizes.to_slave - DATA_OVERHEAD:
            await file.finish()
            self.reset()
        self._number, self._is_taken = number, False
        return [encode_message(FoeOpcode.ACK, number)]


def _wrong_number(number: int, expected: int) -> FoeError:
    text = f"packet {number}, expected {expected}"
    return FoeError(text, code=FoeErrorCode.PACKET_NUMBER, text=text)
