"""One file that goes to a slave or comes from it while a client asks for it block by block.

The conversation with the slave goes on by itself as far as there is data, or room for it: a block
goes to the slave while the next one is on its way here.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from hashlib import sha256
from time import monotonic

from devicebus.errors import BusError
from devicebus.mailbox import foe_client
from devicebus.mailbox.conversation import Conversation, Progress
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.foe_restart import PAUSE_S, Restarts
from eap.appliance.services.bus.bus_talk import Talk
from eap.codec.foe import DATA_OVERHEAD, FoeOpcode
from eap.errors import EapError

KEPT = 16 << 20
"""Bytes of a file on its way to a slave that are kept, to begin anew if the bus interrupts it."""
ALL_KEPT = 64 << 20
"""Bytes of all files together; one that finds no room goes on, but does not begin anew."""
AHEAD = 64 << 10
"""Octets that are read before anybody asks for them, or taken before the slave has them."""

logger = logging.getLogger(__name__)

_CHANGED = "the slave's file has changed while the bus was interrupted"
_ACK = bytes((FoeOpcode.ACK,))


class _Past:
    """Beginning of a file that was transferred already, for a transfer that begins anew.

    Of a file that is written the data is kept, as far as KEPT, and given to the slave again.  Of
    one that is read a hash is enough: what the client has already is read again and compared.
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
        """Keep what the slave was given."""
        if self._is_kept and self.can_rewind:
            self._data += data
            _Past.all_kept += len(data)
            if len(self._data) > KEPT or _Past.all_kept > ALL_KEPT:
                self.can_rewind = False
                self.forget()

    def forget(self) -> None:
        """Free what is kept."""
        _Past.all_kept -= len(self._data)
        self._data.clear()

    def fresh(self, data: bytes) -> bytes:
        """Return what is new of *data*; raise BusError if the rest is not as it was."""
        known = min(len(data), self._size - self._repeated)
        if known:
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
        """Raise BusError if the file ends before what the client has already."""
        if self._repeated < self._size:
            raise BusError(_CHANGED)

    def rewind(self) -> bytes:
        """Begin anew; return what the slave has to be given again."""
        self._repeated = 0
        self._hash_again = sha256()
        data = bytes(self._data)
        self.forget()
        return data


class Transfer:
    """A file of a slave, open for reading or for writing.

    Args:
        name: Of the file, at the slave.
        password: Up to 32 bits.
        sizes: Of the slave's mailboxes.
        is_write: Whether it goes to the slave.
        ahead: Octets that are read before anybody asks for them.

    Attributes:
        progress: How much of it the slave has, or has given.
        is_whole: Whether nothing more will be written to it.
        has_turn: Whether the slave was asked for it; before, others have their files.
        is_open: Whether the slave has said yes.
        is_complete: Whether all of the file went as it should.
        has_ended: Whether nothing more goes to the slave or comes from it.
        sizes: As given.
    """

    def __init__(
        self,
        name: str,
        password: int,
        sizes: MailboxSizes,
        *,
        is_write: bool,
        ahead: int = AHEAD,
    ) -> None:
        self.is_write = is_write
        self.progress = Progress()
        self.has_turn = self.is_open = self.is_complete = self.has_ended = False
        self._name = name
        self._password = password
        self.sizes = sizes
        self._buffer = bytearray()
        self._ahead = self._wanted = ahead
        self.is_whole = False
        self._past = _Past(is_kept=is_write)
        self._error: EapError | None = None
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def start(self, open_talk: Callable[[], Awaitable[Talk]]) -> None:
        """Begin the transfer, until it is complete or :meth:`close` ends it."""
        self._task = asyncio.get_running_loop().create_task(self.run(open_talk))

    def close(self) -> None:
        """Give the file up if it is not complete, at the slave too."""
        if self._task is not None:
            self._task.cancel()

    async def run(self, open_talk: Callable[[], Awaitable[Talk]]) -> None:
        """Transfer the file; whoever cancels this ends it, at the slave too."""
        restarts = Restarts(self.progress, lambda: self._past.can_rewind, monotonic)
        try:
            while True:
                try:
                    return await self._run_once(open_talk)
                except EapError as exc:
                    if not restarts.allows(exc):
                        self._error = exc
                        return None
                again = self._past.rewind()
                if self.is_write:
                    self._buffer[:0] = again
                logger.info("%s: restart %d after: %s", self._name, restarts.count, restarts.reason)
                await asyncio.sleep(PAUSE_S)
        finally:
            self._past.forget()
            self._note(has_ended=True)

    async def _run_once(self, open_talk: Callable[[], Awaitable[Talk]]) -> None:
        conversation = self._begin()
        try:
            talk = await open_talk()
            self._note(has_turn=True)
            try:
                await self._lead(conversation, talk)
            except asyncio.CancelledError:
                talk.abandon()
                raise
            finally:
                talk.close()
        finally:
            conversation.close()

    async def wait_open(self) -> None:
        """Wait until the slave has said yes; raise EapError if it says no."""
        await self._until(lambda: self.is_open)

    async def read(self, size: int) -> bytes:
        """Return the next *size* octets, fewer only at the end; raise EapError.

        Whoever gives up waiting has taken nothing.
        """
        self._wanted = max(self._ahead, size)
        self._note()
        await self._until(lambda: len(self._buffer) >= size)
        return self._cut(size)

    async def write(self, data: bytes) -> None:
        """Take *data* when most of what came before has gone to the slave; raise EapError.

        Whoever gives up waiting has given nothing.
        """
        await self._until(lambda: len(self._buffer) < AHEAD)
        self._buffer += data
        self._note()

    async def finish(self) -> None:
        """Wait until the slave has all that was written; raise EapError if it does not take it."""
        self.is_whole = True
        self._note()
        await self._until(lambda: self.has_ended)

    def _begin(self) -> Conversation[int]:
        if self.is_write:
            return foe_client.write(
                self._name, self._give, self.sizes, password=self._password, progress=self.progress
            )
        return foe_client.read(
            self._name, self._take, self.sizes, password=self._password, progress=self.progress
        )

    async def _lead(self, conversation: Conversation[int], talk: Talk) -> None:
        room = self.sizes.to_slave - DATA_OVERHEAD
        try:
            ask = next(conversation)
            while True:
                if not self.is_write:
                    await self._wait(lambda: len(self._buffer) < self._wanted)
                try:
                    message = await talk.ask(ask)
                except BusError as exc:
                    ask = conversation.throw(exc)
                    continue
                if self.is_write and message.data[:1] == _ACK:
                    self._note(is_open=True)
                    await self._wait(lambda: self.is_whole or len(self._buffer) >= room)
                ask = conversation.send(message)
        except StopIteration:
            self._past.end()
            self.is_complete = True

    def _take(self, data: bytes) -> None:
        self._buffer += self._past.fresh(data)
        self._note(is_open=True)

    def _give(self, size: int) -> bytes:
        data = self._cut(size)
        self._past.keep(data)
        return data

    def _cut(self, size: int) -> bytes:
        data = bytes(self._buffer[:size])
        del self._buffer[:size]
        self._note()
        return data

    def _note(
        self, *, has_turn: bool = False, is_open: bool = False, has_ended: bool = False
    ) -> None:
        """Let everybody look again who waits for something."""
        self.has_turn |= has_turn
        self.is_open |= is_open
        self.has_ended |= has_ended
        self._changed.set()
        self._changed = asyncio.Event()

    async def _until(self, is_so: Callable[[], bool]) -> None:
        """Wait until it is so or cannot become so any more; raise what has ended the transfer."""
        await self._wait(lambda: is_so() or self.has_ended)
        if self._error is not None:
            raise self._error
        if self.has_ended and not self.is_complete:
            raise BusError(f"file {self._name!r}: the transfer was given up")

    async def _wait(self, is_so: Callable[[], bool]) -> None:
        while not is_so():
            await self._changed.wait()
