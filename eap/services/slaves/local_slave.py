"""Access to a slave of an own bus, through the engine."""

from __future__ import annotations

import asyncio
from collections.abc import Hashable
from functools import partial
from typing import TypeVar

from devicebus.drive import drive_async
from devicebus.mailbox import aoe_client, coe_client, soe_client, voe
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.ams import AmsHeader, StateFlags, encode_packet
from eap.codec.coe import SdoInfoOpcode
from eap.codec.mailbox import MailboxType, VoeHeader
from eap.codec.soe import Idn
from eap.runtime.bus_request import SlaveDescription, no_mailbox
from eap.services.slaves.bus_client import BusClient
from eap.services.slaves.file_stream import AHEAD, LocalFile
from eap.services.slaves.mailbox_queue import MailboxTurn
from eap.services.slaves.object_stream import ObjectStream

T = TypeVar("T")


class LocalSlave:
    """A slave of an own bus, for one requester; a SlaveAccess.

    Args:
        bus: Its bus.
        slave: As the engine describes it.
        requester: Client; the operations of several clients take turns.
        turn_s: Limit for the wait for a turn, which MailboxBusyError ends; None for no limit.
    """

    def __init__(
        self,
        bus: BusClient,
        slave: SlaveDescription,
        requester: Hashable,
        *,
        turn_s: float | None = None,
    ) -> None:
        self.bus = bus
        self._slave = slave
        self._requester = requester
        self._turn_s = turn_s

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
        turn = await self.bus.open_turn(
            self._slave.station, MailboxType.COE, self._requester, self._turn_s
        )
        try:
            begin = coe_client.begin_upload(index, subindex, complete=complete)
            start = await drive_async(begin, turn.exchange)
        except asyncio.CancelledError:
            turn.abandon()
            raise
        except BaseException:
            turn.close()
            raise
        stream = ObjectStream(*start)
        if len(start.data) == start.size:
            turn.close()
        else:
            rest = coe_client.continue_upload(index, subindex, start, sink=stream.take)
            task = stream.follow(drive_async(rest, turn.exchange))
            # Not within the coroutine: one that is cancelled before its first step never runs.
            task.add_done_callback(partial(_end_turn, turn))
        return stream

    async def write_object(
        self, index: int, subindex: int, data: bytes, *, complete: bool = False
    ) -> None:
        """Write an entry, or with *complete* an object from subindex 0 or 1 on."""
        sizes = self._sizes()
        await self._converse(coe_client.download(index, subindex, data, sizes, complete=complete))

    async def write_unsized(self, index: int, subindex: int, octets: bytes) -> None:
        """Write an entry from four octets of which as many count as the entry has."""
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
        """Begin to move a file, *ahead* octets before its reader; it is closed by the caller."""
        # By the file, not by the requester: two of its files take turns like those of two.
        open_turn = partial(self.bus.open_turn, self._slave.station, MailboxType.FOE)
        return LocalFile(name, password, self._sizes(), open_turn, is_write=is_write, ahead=ahead)

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
        return await self.bus.converse(station, conversation, self._requester, self._turn_s)


def _end_turn(turn: MailboxTurn, task: asyncio.Task[object]) -> None:
    if task.cancelled():
        turn.abandon()
    turn.close()


def _single(ask: MailboxRequest) -> Conversation[MailboxMessage]:
    return (yield ask)
