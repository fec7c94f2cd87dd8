"""Files of slaves as streams: read ahead of their reader, or written behind their writer.

A file moves by itself as far as there is data, or room for it, so that a block goes to the slave
while the client brings the next one.  A fault of the bus that interrupts a file of an own bus does
not end it: FoE cannot go on in the middle of a file (ETG.1000.6), so it begins anew.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Hashable
from hashlib import sha256
from time import monotonic

from devicebus.errors import BusError
from devicebus.mailbox import foe_client
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxMessage,
    MailboxRequest,
    Progress,
    drive_async,
)
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.foe import DATA_OVERHEAD, FoeOpcode
from eap.errors import EapError
from eap.runtime.foe_restart import PAUSE_S, Restarts
from eap.services.slaves.bus_client import MailboxLock
from eap.services.tasks import TaskSet

AHEAD = 64 << 10
"""Octets that are read before the reader wants them, unless it says otherwise."""
SHORT_PAUSE_S = 0.5
"""A shorter wait for a packet of the client is no stall."""
MAX_UNSENT = 64 << 10
"""Octets that are taken from the writer before they have gone on."""
MAX_KEPT = 16 << 20
"""Bytes of a file on its way to a slave that are kept, to begin anew if the bus interrupts it."""
MAX_ALL_KEPT = 64 << 20
"""Bytes of all files together; one that finds no room goes on, but does not begin anew."""
_CHANGED = "the slave's file has changed while the bus was interrupted"
_ACK = bytes((FoeOpcode.ACK,))

logger = logging.getLogger(__name__)


class StallMeter:
    """Time that a slave has waited for the client of a file, less the time that it worked since.

    A client that brings each packet just in time does not hold the slave for ever.
    """

    def __init__(self) -> None:
        self._total_s = 0.0
        self._at_s = 0.0
        self._is_waiting = False

    def begin(self, now_s: float) -> None:
        """Note that the slave begins to wait."""
        self._total_s, self._at_s, self._is_waiting = self.total_s(now_s), now_s, True

    def end(self, now_s: float) -> None:
        """Note that it goes on."""
        pause_s = now_s - self._at_s
        # To a distant client each packet takes a round trip: that is no stall.
        change_s = pause_s if pause_s >= SHORT_PAUSE_S else -pause_s
        self._total_s = max(0.0, self._total_s + change_s)
        self._at_s, self._is_waiting = now_s, False

    def total_s(self, now_s: float) -> float:
        """Return the time at *now_s*, with the present pause."""
        passed_s = now_s - self._at_s
        return max(0.0, self._total_s + (passed_s if self._is_waiting else -passed_s))


class FileStream(ABC):
    """A file that is moved from a slave or to it, from the constructor on.

    The methods that wait raise the error that has ended the transfer; cancelling one takes nothing
    and gives nothing.

    Args:
        name: Of the file, at the slave.
        sizes: Of the slave's mailboxes.
        is_write: Whether it goes to the slave.
        ahead: As AHEAD.

    Attributes:
        is_write: As given.
        sizes: Of the slave's mailboxes, known when the file is open.
        progress: Bytes that the slave has, or has given.
        has_lock: Whether it is its turn at the slave; before, other files are moved.
        is_open: Whether the slave has opened it.
        is_finished: Whether nothing more will be written to it.
        is_complete: Whether all of it was moved.
        stalls: Time that the slave has waited for the reader or writer, by the clock of the loop.
    """

    def __init__(self, name: str, sizes: MailboxSizes, *, is_write: bool, ahead: int) -> None:
        self.is_write = is_write
        self.sizes = sizes
        self.progress = Progress()
        self.has_lock = self.is_open = self.is_finished = self.is_complete = False
        self.name = name
        self.buffer = bytearray()
        """Octets read that are not fetched yet, or written that have not gone on."""
        self.stalls = StallMeter()
        self._ahead = ahead
        self._wanted = 0
        self._error: EapError | None = None
        self._changed = asyncio.Event()
        self._tasks = TaskSet(f"file {name!r}")
        self._tasks.start(self.run())

    @property
    def has_ended(self) -> bool:
        """True if the transfer has completed or failed."""
        return self.is_complete or self._error is not None

    async def wait_open(self) -> None:
        """Wait until the slave has opened the file."""
        await self._wait_until(lambda: self.is_open)

    async def read(self, size: int) -> bytes:
        """Return the next *size* bytes, fewer only at the end."""
        self._wanted = size
        self.notify()
        await self._wait_until(lambda: len(self.buffer) >= size)
        return self.pop(size)

    async def write(self, data: bytes) -> None:
        """Accept *data* once most of the data before it has been sent."""
        await self._wait_until(lambda: len(self.buffer) < MAX_UNSENT)
        self.buffer += data
        self.notify()

    async def finish(self) -> None:
        """Wait until the slave has all that was written."""
        self.is_finished = True
        self.notify()
        await self._wait_until(lambda: self.is_complete)

    def close(self) -> None:
        """Abort the file if it is not complete, at the slave too."""
        if not self.has_ended:
            self._tasks.cancel()

    @abstractmethod
    async def move(self) -> None:
        """Move the whole file; raise EapError.  Cancelling it ends it at the slave too."""

    def notify(self, *, has_lock: bool = False, is_open: bool = False) -> None:
        """Wake all waiters to check their conditions again."""
        self.has_lock |= has_lock
        self.is_open |= is_open
        # Waiters of the old event check their conditions; later ones wait for the next event.
        self._changed.set()
        self._changed = asyncio.Event()

    def pop(self, size: int) -> bytes:
        """Take bytes out of the buffer."""
        data = bytes(self.buffer[:size])
        del self.buffer[:size]
        self.notify()
        return data

    async def wait_space(self) -> None:
        """Wait until more is to be read: once there was no room, until there is for a half."""
        # Hysteresis: one packet for each packet fetched would be one stall each.
        if len(self.buffer) >= max(self._ahead, self._wanted):
            await self._wait_stalled(lambda: len(self.buffer) < max(self._ahead // 2, self._wanted))

    async def wait_data(self, size: int) -> None:
        """Wait for bytes that go to the slave, fewer than *size* only at the end."""
        await self._wait_stalled(lambda: self.is_finished or len(self.buffer) >= size)

    async def run(self) -> None:
        """Move the file, and let its reader or writer know the end."""
        try:
            await self.move()
            self.is_complete = True
        except EapError as exc:
            self._error = exc
        finally:
            if not self.has_ended:
                self._error = BusError(f"file {self.name!r}: the transfer was aborted")
            self.notify()

    async def _wait_stalled(self, is_so: Callable[[], bool]) -> None:
        """Wait for the reader or writer."""
        if not is_so():
            loop = asyncio.get_running_loop()
            self.stalls.begin(loop.time())
            try:
                await self._wait(is_so)
            finally:
                self.stalls.end(loop.time())

    async def _wait_until(self, is_so: Callable[[], bool]) -> None:
        """Wait for a condition or the end of the transfer; raise the error that ended it."""
        await self._wait(lambda: is_so() or self.has_ended)
        if self._error is not None:
            raise self._error

    async def _wait(self, is_so: Callable[[], bool]) -> None:
        while not is_so():
            await self._changed.wait()


class FileHistory:
    """Part of a file that was transferred already, for a transfer that is restarted.

    The data of a written file is kept, up to MAX_KEPT, and sent to the slave again.  For a file
    that is read a hash is enough: what the reader has already is read again and compared.
    """

    all_kept = 0
    """Bytes that all transfers of the process keep now."""

    def __init__(self, *, is_kept: bool) -> None:
        self.can_rewind = True
        self._is_kept = is_kept
        self._data = bytearray()
        self._size = self._repeated = 0
        self._hash, self._hash_again = sha256(), sha256()

    def keep(self, data: bytes) -> None:
        """Keep data that was sent to the slave."""
        if self._is_kept and self.can_rewind:
            self._data += data
            FileHistory.all_kept += len(data)
            # Beyond the limit the file goes on, but a fault of the bus ends it.
            if len(self._data) > MAX_KEPT or FileHistory.all_kept > MAX_ALL_KEPT:
                self.can_rewind = False
                self.forget()

    def forget(self) -> None:
        """Free the data kept."""
        FileHistory.all_kept -= len(self._data)
        self._data.clear()

    def new_part(self, data: bytes) -> bytes:
        """Return the new part of *data*; raise BusError if the repeated part has changed."""
        known = min(len(data), self._size - self._repeated)
        if known:
            # The reader has these bytes already: the new transfer must bring the same.
            self._hash_again.update(data[:known])
            self._repeated += known
            if self._repeated == self._size and self._hash_again.digest() != self._hash.digest():
                raise BusError(_CHANGED)
            data = data[known:]
        self._hash.update(data)
        self._size += len(data)
        self._repeated += len(data)
        return data

    def end(self) -> None:
        """Raise BusError if the file ends before the data that the reader has already."""
        if self._repeated < self._size:
            raise BusError(_CHANGED)

    def rewind(self) -> bytes:
        """Restart; return the data to be sent to the slave again."""
        self._repeated = 0
        self._hash_again = sha256()
        data = bytes(self._data)
        self.forget()
        return data


class LocalFile(FileStream):
    """A file of a slave of an own bus, moved by an FoE conversation.

    Args:
        name: Of the file, at the slave.
        password: Up to 32 bits.
        sizes: Of the slave's mailboxes.
        lock_mailbox: Waits for the file's turn at the slave; the file itself is the requester.
        is_write: Whether it goes to the slave.
        ahead: As AHEAD.
    """

    def __init__(
        self,
        name: str,
        password: int,
        sizes: MailboxSizes,
        lock_mailbox: Callable[[Hashable], Awaitable[MailboxLock]],
        *,
        is_write: bool,
        ahead: int = AHEAD,
    ) -> None:
        super().__init__(name, sizes, is_write=is_write, ahead=ahead)
        self._password = password
        self._lock_mailbox = lock_mailbox
        self._history = FileHistory(is_kept=is_write)

    async def move(self) -> None:
        """Move the file, again from its beginning after a fault of the bus."""
        restarts = Restarts(self.progress, lambda: self._history.can_rewind, monotonic)
        try:
            while True:
                try:
                    return await self._move_once()
                except EapError as exc:
                    if not restarts.allows(exc):
                        raise
                again = self._history.rewind()
                if self.is_write:
                    # In front of what waits: the slave gets the whole file in its order.
                    self.buffer[:0] = again
                logger.info("%s: restart %d after: %s", self.name, restarts.count, restarts.reason)
                await asyncio.sleep(PAUSE_S)
        finally:
            self._history.forget()

    async def _move_once(self) -> None:
        room = self.sizes.to_slave - DATA_OVERHEAD
        lock = await self._lock_mailbox(self)
        self.notify(has_lock=True)

        async def exchange(request: MailboxRequest) -> MailboxMessage:
            if not self.is_write:
                await self.wait_space()
            message = await lock.exchange(request)
            # Waits between packets, where slaves allow pauses, not within one.
            if self.is_write and message.data[:1] == _ACK:
                self.notify(is_open=True)
                await self.wait_data(room)
            return message

        try:
            await drive_async(self._begin(), exchange)
        except asyncio.CancelledError:
            lock.abandon()
            raise
        finally:
            lock.close()
        self._history.end()

    def _begin(self) -> Conversation[int]:
        name, sizes, password, progress = self.name, self.sizes, self._password, self.progress
        if self.is_write:
            return foe_client.write(
                name, self._next_data, sizes, password=password, progress=progress
            )
        return foe_client.read(name, self._take, sizes, password=password, progress=progress)

    def _take(self, data: bytes) -> None:
        self.buffer += self._history.new_part(data)
        self.notify(is_open=True)

    def _next_data(self, size: int) -> bytes:
        data = self.pop(size)
        self._history.keep(data)
        return data
