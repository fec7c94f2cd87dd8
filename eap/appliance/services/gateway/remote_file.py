"""One file of a slave of another station, on its way by AoE while a client asks packet by packet.

Blocks go on by themselves as far as there is data, or room for it.  The first one is as long as a
packet, so that the client need not wait for more than it asked for; each is twice as long as the
one before, up to BLOCK.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from devicebus.mailbox.foe_server import NotReadyError
from devicebus.mailbox.protocol import MINIMUM_SIZE, MailboxSizes
from eap.aoe.ads_operation import ReadWrite
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.foe import DATA_OVERHEAD
from eap.gateway.elsewhere import ElsewhereError

BLOCK = 16 << 10
"""Octets of the longest block; where there are only datagrams, one that is lost costs all of it."""
AHEAD = 2 * BLOCK
"""Octets that are read before anybody asks for them, or taken before they have gone on."""
STEP_S = 5.0
"""How long the answer to a block may take: routers give up after 4.5 s."""
PAUSE_S = 0.02
"""Before somebody who is busy is asked again."""
_HANDLE_SIZE = 4
_GIVE_UP = b"\1"


class Wanted(NamedTuple):
    """Which file, and what with it."""

    name: str
    password: int
    is_write: bool


class RemoteFile:
    """A file; as a FileReader and FileWriter of the FoE server it is not ready until it is.

    What was refused elsewhere raises ElsewhereError from all methods but ``close`` and ``discard``.

    Args:
        link: Leads to the slave.
        wanted: Which file.
        sizes: Of the slave's mailboxes; they are set before the file is opened.

    Attributes:
        wanted: As given.
        is_over: Whether nobody wants anything of it any more.
    """

    def __init__(self, link: RemoteLink, wanted: Wanted, sizes: MailboxSizes) -> None:
        self.wanted = wanted
        self.is_over = False
        self._link = link
        self._sizes = sizes
        self._buffer = bytearray()
        self._handle = 0
        self._is_open = self._is_whole = self._is_complete = False
        self._error: ElsewhereError | None = None
        self._changed = asyncio.Event()
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def wait_change(self) -> None:
        """Wait until something has come, or has gone on."""
        await self._changed.wait()

    def check_open(self) -> None:
        """Raise NotReadyError until the first packet may go."""
        is_there = self.wanted.is_write or self._has(self._sizes.to_master - DATA_OVERHEAD)
        self._check(is_ready=self._is_open and is_there)

    def read(self, size: int, /) -> bytes:
        """Return the next octets, fewer only at the end."""
        self._check(is_ready=self._has(size))
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._note()
        return data

    def write(self, data: bytes, /) -> None:
        """Take the next octets."""
        self._check(is_ready=len(self._buffer) < AHEAD)
        self._buffer += data
        self._note()

    def commit(self) -> None:
        """The file is whole; this is ready when the slave has all of it."""
        self._is_whole = True
        self._note()
        self._check(is_ready=self._is_complete)
        self.is_over = True

    def close(self) -> None:
        """Give the file up if it is not complete."""
        self.is_over = True
        if self._is_open and not self._is_complete:
            self._task.cancel()

    discard = close

    def _has(self, size: int) -> bool:
        return len(self._buffer) >= size or self._is_complete

    def _check(self, *, is_ready: bool) -> None:
        if self._error is not None:
            raise self._error
        if not is_ready:
            raise NotReadyError

    async def _run(self) -> None:
        """Transfer the file; whoever cancels this gives it up, at the slave too."""
        try:
            await self._open()
            if not self.is_over:
                await (self._drain() if self.wanted.is_write else self._fill())
        except ElsewhereError as exc:
            self._error = exc
        finally:
            if not self._is_complete and self._error is None:
                self._error = ElsewhereError(AdsError.ABORTED)
            self._note()
            await self._leave()

    async def _open(self) -> None:
        to_slave, to_master = await self._link.mailboxes()
        if min(to_slave, to_master) < MINIMUM_SIZE:
            raise ElsewhereError(AdsError.NOT_READY)
        self._sizes.set(to_slave, to_master)
        if self.is_over:
            return  # a slave may forget its old file as soon as a new one is begun
        name, password, is_write = self.wanted
        group = IndexGroup.FOE_OPEN_WRITE if is_write else IndexGroup.FOE_OPEN_READ
        opened = await self._ask(group, password, _HANDLE_SIZE, name.encode())
        self._handle = int.from_bytes(opened, "little")
        self._is_open = True
        self._note()

    async def _fill(self) -> None:
        size = self._sizes.to_master - DATA_OVERHEAD
        while not self._is_complete:
            await self._wait(lambda: len(self._buffer) < AHEAD)
            data = await self._ask(IndexGroup.FOE_READ, self._handle, size)
            self._buffer += data
            self._is_complete = len(data) < size
            self._note()
            size = min(2 * size, BLOCK)

    async def _drain(self) -> None:
        while self._buffer or not self._is_whole:
            await self._wait(lambda: bool(self._buffer) or self._is_whole)
            if block := bytes(self._buffer[:BLOCK]):
                await self._ask(IndexGroup.FOE_WRITE, self._handle, 0, block)
                del self._buffer[: len(block)]
                self._note()
        await self._ask(IndexGroup.FOE_CLOSE, self._handle)
        self._is_complete = True

    async def _leave(self) -> None:
        """Close the file there; what was written of it does not count unless it is complete."""
        if not self._is_open or (self.wanted.is_write and self._is_complete):
            return
        farewell = ReadWrite(IndexGroup.FOE_CLOSE, self._handle, 0, b"")
        if self.wanted.is_write:
            farewell = ReadWrite(IndexGroup.FOE_PROGRESS, self._handle, 0, _GIVE_UP)
        with suppress(ElsewhereError):
            await self._link.perform(farewell)

    async def _ask(self, group: int, offset: int, length: int = 0, data: bytes = b"") -> bytes:
        """Ask, and again as long as the answer is BUSY and somebody wants the file."""
        while True:
            try:
                return await self._link.perform(
                    ReadWrite(group, offset, length, data), timeout_s=STEP_S
                )
            except ElsewhereError as exc:
                if exc.result != AdsError.BUSY or self.is_over:
                    raise
            await asyncio.sleep(PAUSE_S)

    def _note(self) -> None:
        """Let everybody look again who waits for something."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def _wait(self, is_so: Callable[[], bool]) -> None:
        while not is_so():
            await self._changed.wait()
