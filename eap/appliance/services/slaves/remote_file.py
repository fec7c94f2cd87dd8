"""A file of a slave of another station, moved by AoE.

Blocks go on by themselves as far as there is data, or room for it.  The first one is as long as a
packet of FoE, so that the client need not wait for more than it wants; each is twice as long as the
one before, up to BLOCK.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING

from devicebus.errors import FoeError
from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import ReadWrite
from eap.appliance.services.slaves.access import RemoteAccessError
from eap.appliance.services.slaves.file_stream import AHEAD, FileStream
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.foe import DATA_OVERHEAD, name_of
from eap.gateway.error_table import cause_of_result

if TYPE_CHECKING:
    from eap.appliance.services.slaves.remote_slave import RemoteSlave

BLOCK = 16 << 10
"""Octets of the longest block; where there are only datagrams, one that is lost costs all of it."""
STEP_S = 5.0
"""How long the answer to a block may take: routers give up after 4.5 s."""
PAUSE_S = 0.02
"""Before a station that is busy is asked again."""
_HANDLE_SIZE = 4
_GIVE_UP = b"\1"


class RemoteFile(FileStream):
    """A file of a slave of another station, which does not tell whose turn it is.

    Args:
        slave: Whose file it is.
        name: Of the file, at the slave.
        password: Up to 32 bits.
        is_write: Whether it goes to the slave.
        ahead: Octets that are read before the client wants them.
    """

    def __init__(
        self, slave: RemoteSlave, name: str, password: int, *, is_write: bool, ahead: int = AHEAD
    ) -> None:
        super().__init__(name, MailboxSizes(), is_write=is_write, ahead=ahead)
        self._slave = slave
        self._password = password
        self._handle = 0
        self._is_closed = False

    def close(self) -> None:
        """Give the file up if it is not complete, at the slave too."""
        self._is_closed = True
        if self.is_open:  # else the handle is not known yet by which the slave is told
            super().close()

    async def move(self) -> None:
        """Move the file in blocks."""
        try:
            await self._open()
            await (self._drain() if self.is_write else self._fill())
        except RemoteAccessError as exc:
            raise _foe_error(exc) from None

    async def run(self) -> None:
        """Move the file, and close it at the other station once its reader or writer knows."""
        try:
            await super().run()
        finally:
            await self._leave()

    async def _open(self) -> None:
        sizes = await self._slave.sizes()
        self.sizes.set(sizes.to_slave, sizes.to_master)
        self._check_wanted()  # a slave may forget its old file as soon as a new one is begun
        group = IndexGroup.FOE_OPEN_WRITE if self.is_write else IndexGroup.FOE_OPEN_READ
        opened = await self._ask(group, self._password, _HANDLE_SIZE, self.name.encode())
        self._handle = int.from_bytes(opened, "little")
        self.notify(has_turn=True, is_open=True)
        self._check_wanted()

    def _check_wanted(self) -> None:
        if self._is_closed:
            raise RemoteAccessError(AdsError.ABORTED)

    async def _fill(self) -> None:
        size = self.sizes.to_master - DATA_OVERHEAD
        is_last = False
        while not is_last:
            await self.wait_room()
            data = await self._ask(IndexGroup.FOE_READ, self._handle, size)
            self.buffer += data
            self.progress.done += len(data)
            self.notify()
            is_last = len(data) < size
            size = min(2 * size, BLOCK)

    async def _drain(self) -> None:
        while self.buffer or not self.is_whole:
            await self.wait_data(1)
            if block := bytes(self.buffer[:BLOCK]):
                await self._ask(IndexGroup.FOE_WRITE, self._handle, 0, block)
                self.progress.done += len(block)
                self.cut(len(block))
        await self._ask(IndexGroup.FOE_CLOSE, self._handle)

    async def _leave(self) -> None:
        """Close the file there; what was written of it does not count unless it is complete."""
        if not self.is_open or (self.is_write and self.is_complete):
            return
        last = ReadWrite(IndexGroup.FOE_CLOSE, self._handle, 0, b"")
        if self.is_write:
            last = ReadWrite(IndexGroup.FOE_PROGRESS, self._handle, 0, _GIVE_UP)
        with suppress(RemoteAccessError):
            await self._slave.perform(last)

    async def _ask(self, group: int, offset: int, length: int = 0, data: bytes = b"") -> bytes:
        """Send a request, and again as long as the answer is BUSY and the file is wanted."""
        while True:
            try:
                return await self._slave.perform(
                    ReadWrite(group, offset, length, data), timeout_s=STEP_S
                )
            except RemoteAccessError as exc:
                if exc.result != AdsError.BUSY or self._is_closed:
                    raise
            await asyncio.sleep(PAUSE_S)


def _foe_error(error: RemoteAccessError) -> RemoteAccessError | FoeError:
    """Return the refusal with an FoE code; errors of the way to the slave stay as they are."""
    if error.is_of_way:
        return error
    code = cause_of_result(error.result).foe
    text = f"{name_of(code)}: ADS error 0x{error.result:x} ({AdsError.name_of(error.result)})"
    return FoeError(text, code=code, text=text)
