"""A slave whose mailbox is in memory, and clients of a session codec in front of it."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Hashable
from typing import Any, TypeVar, cast

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxMessage,
    MailboxRequest,
    answers,
    drive_async,
)
from devicebus.mailbox.protocol import MailboxSizes, ProtocolServer
from devicebus.wire.sii import SiiProtocol
from eap.codec.mailbox import MailboxType
from eap.gateway.request_tracker import MemoryBudget, MemoryShare
from eap.ids import Endpoint
from eap.runtime.engine_messages import SlaveDescription
from eap.services.gateway.sessions import SessionCodec
from eap.services.slaves.access import LocalSlave
from eap.services.slaves.bus_client import BusClient, MailboxLock
from tests.support.mailbox import Line, open_line

T = TypeVar("T")
CLIENT = Endpoint("udp:eap0", "127.0.0.1:1")


class MemoryMailbox:
    """The bus of one slave; stands for BusClient, and for its only MailboxLock.

    Attributes:
        asked: Requests that the slave got.
        is_abandoned: Whether a conversation was left in the middle.
    """

    def __init__(self, line: Line) -> None:
        self.asked: list[bytes] = []
        self.is_abandoned = False
        self._line = line

    async def converse(
        self,
        station: int,
        conversation: Conversation[T],
        requester: Hashable,
        lock_s: float | None = None,
    ) -> T:
        try:
            return await drive_async(conversation, self.exchange)
        except asyncio.CancelledError:
            self.abandon()
            raise

    async def lock_mailbox(
        self, station: int, kind: MailboxType, requester: Hashable, lock_s: float | None = None
    ) -> MailboxLock:
        return cast("MailboxLock", self)

    async def exchange(self, ask: MailboxRequest) -> MailboxMessage:
        self.asked.append(ask.request)
        await asyncio.sleep(0)  # other clients have their turns
        return self._line.exchange(ask)

    def abandon(self) -> None:
        self.is_abandoned = True

    def close(self) -> None:
        """Each conversation has the slave for itself."""


def memory_slave(
    kind: MailboxType, server: ProtocolServer, sizes: MailboxSizes
) -> tuple[LocalSlave, MemoryMailbox]:
    """Return access to a slave that has one protocol, and its mailbox."""
    mailbox = MemoryMailbox(open_line(kind, server, sizes))
    slave = SlaveDescription(
        station=1001, name="s", vendor=1, product=2, revision=3, serial=4, alias=0, state=8,
        target=8, to_slave=sizes.to_slave, to_master=sizes.to_master, protocols=sum(SiiProtocol),
    )  # fmt: skip
    return LocalSlave(cast("BusClient", mailbox), slave, CLIENT), mailbox


def memory_share(octets: int = 1 << 20) -> MemoryShare:
    """Return memory for one session."""
    return MemoryShare(MemoryBudget(octets, octets), CLIENT.connection)


async def lead(
    codec: SessionCodec, conversation: Conversation[Any], running: list[bool] | None = None
) -> Any:
    """Drive a client's conversation with a codec; note whether a transfer runs after each step."""
    waiting: deque[bytes] = deque()

    async def exchange(ask: MailboxRequest) -> MailboxMessage:
        if not ask.listen:
            waiting.clear()
            waiting.extend(await codec.answer(ask.request))
            if running is not None:
                running.append(codec.is_running)
        if not ask.expects_reply:
            assert not waiting
            return MailboxMessage(ask.type, b"")
        if not waiting:
            raise MailboxTimeoutError("no answer")
        reply = waiting.popleft()
        assert answers(ask.type, ask.request, reply), f"{reply.hex()} answers another request"
        return MailboxMessage(ask.type, reply)

    return await drive_async(conversation, exchange)
