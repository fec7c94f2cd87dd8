"""A file of a slave of another station, moved by AoE while a client fetches or brings it.

Blocks go on by themselves as far as there is data, or room for it.  The first one is as long as a
packet of FoE, so that the client need not wait for more than it wants; each is twice as long as the
one before, up to BLOCK.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

from devicebus.errors import FoeError
from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import ReadWrite
from eap.appliance.services.slaves.access import RemoteAccessError
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.foe import DATA_OVERHEAD, name_of
from eap.errors import EapError
from eap.gateway.error_table import cause_of_result

if TYPE_CHECKING:
    from eap.appliance.services.slaves.remote_slave import RemoteSlave

BLOCK = 16 << 10
"""Octets of the longest block; where there are only datagrams, one that is lost costs all of it."""
BEHIND = 2 * BLOCK
"""Octets that are taken of a file before those have gone on."""
STEP_S = 5.0
"""How long the answer to a block may take: routers give up after 4.5 s."""
PAUSE_S = 0.02
"""Before a station that is busy is asked again."""
_HANDLE_SIZE = 4
_GIVE_UP = b"\1"


class RemoteFile:
    """A file that is read or written; a FileStream.

    Args:
        slave: Whose file it is.
        name: Of the file, at the slave.
        password: Up to 32 bits.
        is_write: Whether it goes to the slave.
        ahead: Octets that are read before the client wants them.

    Attributes:
        sizes: Of the slave's mailboxes, known when the file is open.
        has_turn: Whether it is open: another station does not tell which client has its slave.
    """

    def __init__(
        self, slave: RemoteSlave, name: str, password: int, *, is_write: bool, ahead: int = BEHIND
    ) -> None:
        self.sizes = MailboxSizes()
        self.has_turn = False
        self._slave = slave
        self._name = name
        self._password = password
        self._is_write = is_write
        self._ahead = ahead
        self._buffer = bytearray()
        self._handle = 0
        self._is_whole = self._is_complete = self._is_closed = False
        self._error: EapError | None = None
        self._changed = asyncio.Event()
        self._task = asyncio.get_running_loop().create_task(self._run())

    @property
    def has_ended(self) -> bool:
        """Whether nothing more goes to the slave or comes from it."""
        return self._is_complete or self._error is not None

    async def wait_open(self) -> None:
        """Wait until the slave has opened the file; raise EapError if it refuses."""
        await self._until(lambda: self.has_turn)

    async def read(self, size: int) -> bytes:
        """Return the next *size* octets, fewer only at the end; raise EapError.

        Cancelling it takes nothing.
        """
        await self._until(lambda: len(self._buffer) >= size)
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._notify()
        return data

    async def write(self, data: bytes) -> None:
        """Take *data* when most of what came before has gone on; raise EapError.

        Cancelling it gives nothing.
        """
        await self._until(lambda: len(self._buffer) < BEHIND)
        self._buffer += data
        self._notify()

    async def finish(self) -> None:
        """Wait until the slave has all that was written; raise EapError if it refuses."""
        self._is_whole = True
        self._notify()
        await self._until(lambda: self._is_complete)

    def close(self) -> None:
        """Give the file up if it is not complete, at the slave too."""
        self._is_closed = True
        if self.has_turn:  # else the handle is not known yet by which the slave is told
            self._task.cancel()

    async def _run(self) -> None:
        try:
            await self._open()
            if not self._is_closed:
                await (self._drain() if self._is_write else self._fill())
        except RemoteAccessError as exc:
            self._error = _foe_error(exc)
        finally:
            if not self._is_complete and self._error is None:
                self._error = RemoteAccessError(AdsError.ABORTED)
            self._notify()
            await self._leave()

    async def _open(self) -> None:
        sizes = await self._slave.sizes()
        self.sizes.set(sizes.to_slave, sizes.to_master)
        if self._is_closed:
            return  # a slave may forget its old file as soon as a new one is begun
        group = IndexGroup.FOE_OPEN_WRITE if self._is_write else IndexGroup.FOE_OPEN_READ
        opened = await self._ask(group, self._password, _HANDLE_SIZE, self._name.encode())
        self._handle = int.from_bytes(opened, "little")
        self.has_turn = True
        self._notify()

    async def _fill(self) -> None:
        size = self.sizes.to_master - DATA_OVERHEAD
        while not self._is_complete:
            await self._wait(lambda: len(self._buffer) < self._ahead)
            data = await self._ask(IndexGroup.FOE_READ, self._handle, size)
            self._buffer += data
            self._is_complete = len(data) < size
            self._notify()
            size = min(2 * size, BLOCK)

    async def _drain(self) -> None:
        while self._buffer or not self._is_whole:
            await self._wait(lambda: bool(self._buffer) or self._is_whole)
            if block := bytes(self._buffer[:BLOCK]):
                await self._ask(IndexGroup.FOE_WRITE, self._handle, 0, block)
                del self._buffer[: len(block)]
                self._notify()
        await self._ask(IndexGroup.FOE_CLOSE, self._handle)
        self._is_complete = True

    async def _leave(self) -> None:
        """Close the file there; what was written of it does not count unless it is complete."""
        if not self.has_turn or (self._is_write and self._is_complete):
            return
        last = ReadWrite(IndexGroup.FOE_CLOSE, self._handle, 0, b"")
        if self._is_write:
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

    def _notify(self) -> None:
        """Let everything that waits for a change look again."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def _until(self, is_so: Callable[[], bool]) -> None:
        """Wait until it is so, or the transfer has ended; raise what has ended it."""
        await self._wait(lambda: is_so() or self.has_ended)
        if self._error is not None:
            raise self._error

    async def _wait(self, is_so: Callable[[], bool]) -> None:
        while not is_so():
            await self._changed.wait()


def _foe_error(error: RemoteAccessError) -> RemoteAccessError | FoeError:
    """Return the refusal with an FoE code; errors of the way to the slave stay as they are."""
    if error.is_of_way:
        return error
    code = cause_of_result(error.result).foe
    text = f"{name_of(code)}: ADS error 0x{error.result:x} ({AdsError.name_of(error.result)})"
    return FoeError(text, code=code, text=text)
