"""Access to one slave's mailbox: whole operations on objects, elements, files and messages.

Both implementations, LocalSlave here and RemoteSlave, raise the same errors: SdoAbortError,
SoeError and FoeError for a refusal of the slave with its own code, the BusErrors of the mailbox,
EngineGoneError for an own bus that is not served, and RemoteAccessError for another station.
"""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine, Hashable
from functools import partial
from typing import Any, Protocol, TypeVar

from devicebus.mailbox import aoe_client, coe_client, soe_client, voe
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest, drive_async
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader, StateFlags, encode_packet
from eap.codec.coe import SdoInfoOpcode
from eap.codec.mailbox import MailboxType, VoeHeader
from eap.codec.soe import Idn
from eap.errors import EapError
from eap.gateway.error_table import cause_of_result
from eap.runtime.engine_messages import SlaveDescription, no_mailbox
from eap.services.slaves.bus_client import BusClient, MailboxLock
from eap.services.slaves.file_stream import AHEAD, FileStream, LocalFile
from eap.services.tasks import TaskSet


class ObjectStream:
    """Octets of an object, from the moment when its size is known.

    Args:
        size: Bytes of all of it.
        data: The first ones; all of them unless :meth:`follow` brings the rest.

    Attributes:
        size: As given.
        done: Bytes that the reader has taken.
    """

    def __init__(self, size: int, data: bytes) -> None:
        self.size = size
        self.done = 0
        self._data = bytearray(data)
        self._changed = asyncio.Event()
        self._task: asyncio.Task[object] | None = None

    def follow(self, rest: Coroutine[Any, Any, object]) -> asyncio.Task[object]:
        """Start the task that reads the rest at the slave's speed and gives it to :meth:`take`."""
        self._task = TaskSet("upload").start_awaited(rest)
        self._task.add_done_callback(lambda _: self._changed.set())
        return self._task

    def take(self, piece: bytes) -> None:
        """Add the next bytes."""
        self._data += piece
        self._changed.set()

    async def read(self, size: int) -> bytes:
        """Return the next *size* bytes, fewer only at the end; cancelling it takes nothing.

        Raises:
            EapError: that has ended the upload, as SlaveAccess says.
        """
        end = min(self.done + size, self.size)
        while len(self._data) < end and self._task is not None:
            if self._task.done():
                self._task.result()
                break
            self._changed.clear()
            await self._changed.wait()
        data = bytes(self._data[self.done : end])
        self.done = end
        return data

    def close(self) -> None:
        """End the upload, at the slave too if it is not complete there."""
        task, self._task = self._task, None
        if task is None or task.cancelled():
            return
        if task.done():
            # asyncio warns of an exception that is never retrieved.
            task.exception()  # the reader has it, or does not want it any more
        else:
            task.cancel()


class RemoteAccessError(EapError):
    """A slave of another station was not reached, or refused without a code of its protocol.

    Attributes:
        result: Error of ADS.
        is_routing_error: Whether the slave was not reached; every other error is its own refusal.
    """

    def __init__(self, result: int) -> None:
        super().__init__(AdsError.words_of(result))
        self.result = result
        self.is_routing_error = not cause_of_result(result).is_from_slave


class SlaveAccess(Protocol):
    """Access to one slave for one requester; the operations of several requesters take turns.

    Every operation raises the errors that the module's text names.  Cancelling it ends what is
    under way, at the slave too.
    """

    async def sizes(self) -> MailboxSizes:
        """Return the sizes of the slave's mailboxes; raise NoMailboxError if none is open."""

    async def probe(self) -> None:
        """Raise RemoteAccessError if the slave's station does not answer."""

    async def read_object(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Read an entry, or with *complete* an object from subindex 0 or 1 on."""

    async def open_object(
        self, index: int, subindex: int, *, complete: bool = False
    ) -> ObjectStream:
        """Begin to read as :meth:`read_object` does; the stream is closed by the caller."""

    async def write_object(
        self, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or with *complete* an object from subindex 0 or 1 on."""

    async def write_unsized(self, index: int, subindex: int, octets: bytes) -> None:
        """Write an entry from four bytes of which as many count as the entry has."""

    async def read_info(self, opcode: SdoInfoOpcode, request: bytes) -> bytes:
        """Return the body of an SDO information answer, its fragments joined."""

    async def read_elements(self, idn: int, elements: int, *, drive: int) -> bytes:
        """Read elements of an IDN, one behind the other; lists and texts with their heads."""

    async def write_elements(self, idn: int, elements: int, data: bytes, *, drive: int) -> None:
        """Write an element of an IDN; a list or text with its head."""

    def open_file(
        self, name: str, password: int, *, is_write: bool, ahead: int = AHEAD
    ) -> FileStream:
        """Begin to move a file, *ahead* bytes before its reader; it is closed by the caller."""

    async def exchange_vendor(self, message: bytes) -> bytes:
        """Return the answer to a VoE message, both with their VoE headers."""

    async def send_vendor(self, message: bytes) -> None:
        """Send a VoE message that is not answered."""

    async def exchange_ads(self, header: AmsHeader, data: bytes) -> bytes:
        """Return the AMS packet that answers an AoE request; nothing if it wants no answer."""

    async def exchange(
        self, kind: MailboxType, request: bytes, *, expects_reply: bool = True
    ) -> MailboxMessage:
        """Pass a mailbox message that has no operation here, and return its answer."""


T = TypeVar("T")


class LocalSlave:
    """A slave of an own bus, for one requester; a SlaveAccess.

    Args:
        bus: Its bus.
        slave: As the engine describes it.
        requester: Client; the operations of several clients take turns.
        lock_s: Limit for the wait for a turn, which MailboxBusyError ends; None for no limit.
    """

    def __init__(
        self,
        bus: BusClient,
        slave: SlaveDescription,
        requester: Hashable,
        *,
        lock_s: float | None = None,
    ) -> None:
        self.bus = bus
        self._slave = slave
        self._requester = requester
        self._lock_s = lock_s

    async def sizes(self) -> MailboxSizes:
        """Return the sizes of the slave's mailboxes; raise NoMailboxError if none is open."""
        return self._sizes()

    async def probe(self) -> None:
        """Do nothing: the engine answers for its slaves."""

    async def read_object(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        """Read an entry, or with *complete* an object from subindex 0 or 1 on."""
        return await self._converse(coe_client.upload(index, subindex, complete=complete))

    async def open_object(
        self, index: int, subindex: int, *, complete: bool = False
    ) -> ObjectStream:
        """Begin to read as :meth:`read_object` does; the stream is closed by the caller."""
        lock = await self.bus.lock_mailbox(
            self._slave.station, MailboxType.COE, self._requester, self._lock_s
        )
        try:
            begin = coe_client.begin_upload(index, subindex, complete=complete)
            start = await drive_async(begin, lock.exchange)
        except asyncio.CancelledError:
            lock.abandon()
            raise
        except BaseException:
            lock.close()
            raise
        stream = ObjectStream(*start)
        # The object came whole: the mailbox is free before its reader has taken it.
        if len(start.data) == start.size:
            lock.close()
        else:
            rest = coe_client.continue_upload(index, subindex, start, sink=stream.take)
            task = stream.follow(drive_async(rest, lock.exchange))
            # Not within the coroutine: one that is cancelled before its first step never runs.
            task.add_done_callback(partial(_end_lock, lock))
        return stream

    async def write_object(
        self, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or with *complete* an object from subindex 0 or 1 on."""
        sizes = self._sizes()
        await self._converse(coe_client.download(index, subindex, data, sizes, complete=complete))

    async def write_unsized(self, index: int, subindex: int, octets: bytes) -> None:
        """Write an entry from four bytes of which as many count as the entry has."""
        await self._converse(coe_client.download_unsized(index, subindex, octets))

    async def read_info(self, opcode: SdoInfoOpcode, request: bytes) -> bytes:
        """Return the body of an SDO information answer, its fragments joined."""
        return await self._converse(coe_client.read(opcode, request))

    async def read_elements(self, idn: int, elements: int, *, drive: int) -> bytes:
        """Read elements of an IDN, one behind the other; lists and texts with their heads."""
        return await self._converse(soe_client.read(Idn.of(idn), elements, drive=drive))

    async def write_elements(self, idn: int, elements: int, data: bytes, *, drive: int) -> None:
        """Write an element of an IDN; a list or text with its head."""
        sizes = self._sizes()
        await self._converse(
            soe_client.write(Idn.of(idn), data, sizes, elements=elements, drive=drive)
        )

    def open_file(
        self, name: str, password: int, *, is_write: bool, ahead: int = AHEAD
    ) -> LocalFile:
        """Begin to move a file, *ahead* bytes before its reader; it is closed by the caller."""
        # By the file, not by the requester: two of its files take turns like those of two.
        lock_mailbox = partial(self.bus.lock_mailbox, self._slave.station, MailboxType.FOE)
        return LocalFile(
            name, password, self._sizes(), lock_mailbox, is_write=is_write, ahead=ahead
        )

    async def exchange_vendor(self, message: bytes) -> bytes:
        """Return the answer to a VoE message, both with their VoE headers."""
        return (await self.exchange(MailboxType.VOE, message)).data

    async def send_vendor(self, message: bytes) -> None:
        """Send a VoE message that is not answered."""
        head = VoeHeader.decode(message)
        data = message[VoeHeader.SIZE :]
        await self._converse(voe.send(head.vendor_id, head.vendor_type, data))

    async def exchange_ads(self, header: AmsHeader, data: bytes) -> bytes:
        """Return the AMS packet that answers an AoE request; nothing if it wants no answer."""
        sizes = self._sizes()
        if header.state_flags & StateFlags.NO_RETURN:
            await self._converse(aoe_client.send(header, data, sizes))
            return b""
        return encode_packet(*await self._converse(aoe_client.exchange(header, data, sizes)))

    async def exchange(
        self, kind: MailboxType, request: bytes, *, expects_reply: bool = True
    ) -> MailboxMessage:
        """Pass a mailbox message that has no operation here, and return its answer."""
        return await self._converse(
            _single(MailboxRequest(kind, request, expects_reply=expects_reply))
        )

    def _sizes(self) -> MailboxSizes:
        if not self._slave.to_slave:
            raise no_mailbox(self._slave)
        return MailboxSizes(self._slave.to_slave, self._slave.to_master)

    async def _converse(self, conversation: Conversation[T]) -> T:
        station = self._slave.station
        return await self.bus.converse(station, conversation, self._requester, self._lock_s)


def _end_lock(lock: MailboxLock, task: asyncio.Task[object]) -> None:
    if task.cancelled():
        lock.abandon()
    lock.close()


def _single(ask: MailboxRequest) -> Conversation[MailboxMessage]:
    return (yield ask)
