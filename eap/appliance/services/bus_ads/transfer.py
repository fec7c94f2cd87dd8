"""One file that goes to a slave or comes from it while a client asks for it block by block.

The conversation with the slave goes on by itself as far as there is data, or room for it: a block
goes to the slave while the next one is on its way here.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

from devicebus.errors import BusError
from devicebus.mailbox import foe_client
from devicebus.mailbox.conversation import Conversation, Progress
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.services.bus.bus_talk import Talk
from eap.codec.foe import DATA_OVERHEAD, FoeOpcode
from eap.errors import EapError

AHEAD = 64 << 10
"""Octets that are read before anybody asks for them, or taken before the slave has them."""
_ACK = bytes((FoeOpcode.ACK,))


class Transfer:
    """A file of a slave, open for reading or for writing.

    Args:
        name: Of the file, at the slave.
        password: Up to 32 bits.
        sizes: Of the slave's mailboxes.
        is_write: Whether it goes to the slave.

    Attributes:
        progress: How much of it the slave has, or has given.
        is_whole: Whether nothing more will be written to it.
        has_turn: Whether the slave was asked for it; before, others have their files.
        is_open: Whether the slave has said yes.
        is_complete: Whether all of the file went as it should.
        has_ended: Whether nothing more goes to the slave or comes from it.
    """

    def __init__(self, name: str, password: int, sizes: MailboxSizes, *, is_write: bool) -> None:
        self.is_write = is_write
        self.progress = Progress()
        self.has_turn = self.is_open = self.is_complete = self.has_ended = False
        self._name = name
        self._password = password
        self._sizes = sizes
        self._buffer = bytearray()
        self._wanted = AHEAD
        self.is_whole = False
        self._error: EapError | None = None
        self._changed = asyncio.Event()

    async def run(self, open_talk: Callable[[], Awaitable[Talk]]) -> None:
        """Transfer the file; whoever cancels this ends it, at the slave too."""
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
        except EapError as exc:
            self._error = exc
        finally:
            conversation.close()
            self._note(has_ended=True)

    async def wait_open(self) -> None:
        """Wait until the slave has said yes; raise EapError if it says no."""
        await self._until(lambda: self.is_open)

    async def read(self, size: int) -> bytes:
        """Return the next *size* octets, fewer only at the end; raise EapError.

        Whoever gives up waiting has taken nothing.
        """
        self._wanted = max(AHEAD, size)
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
                self._name, self._cut, self._sizes, password=self._password, progress=self.progress
            )
        return foe_client.read(
            self._name, self._take, self._sizes, password=self._password, progress=self.progress
        )

    async def _lead(self, conversation: Conversation[int], talk: Talk) -> None:
        room = self._sizes.to_slave - DATA_OVERHEAD
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
            self.is_complete = True

    def _take(self, data: bytes) -> None:
        self._buffer += data
        self._note(is_open=True)

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
