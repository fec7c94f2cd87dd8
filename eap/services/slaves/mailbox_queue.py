"""Per-slave mailbox queue: one conversation at a time in each protocol, clients in turn."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Hashable
from contextlib import suppress

from devicebus.mailbox.conversation import ABORT_MESSAGES, MailboxMessage, MailboxRequest
from eap.codec.mailbox import MailboxType
from eap.control.bus import MARGIN_S
from eap.errors import EngineGoneError
from eap.runtime.bus_request import ExchangeMailbox
from eap.services.engine_link import EngineLink

_S = 1_000_000_000


class MailboxQueues:
    """The queues of all mailboxes.

    A client with many requests does not keep out one with few: behind each turn comes the next
    client, not the next request.
    """

    def __init__(self) -> None:
        self._waiting: dict[Hashable, dict[Hashable, deque[asyncio.Future[None]]]] = {}

    def is_free(self, mailbox: Hashable) -> bool:
        """Return whether a turn begins without waiting."""
        return mailbox not in self._waiting

    async def take(self, mailbox: Hashable, client: Hashable) -> None:
        """Wait for a turn, which lasts until :meth:`release`; cancelling it gives up the wait."""
        if self.is_free(mailbox):
            self._waiting[mailbox] = {}
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting[mailbox].setdefault(client, deque()).append(turn)
        try:
            await turn
        except asyncio.CancelledError:
            if turn.done() and not turn.cancelled():  # it came in the same moment
                self.release(mailbox)
            raise

    def release(self, mailbox: Hashable) -> None:
        """End a turn; the next client has the next one."""
        clients = self._waiting[mailbox]
        while clients:
            client = next(iter(clients))
            turns = clients.pop(client)
            turn = turns.popleft()
            if turns:
                clients[client] = turns
            if not turn.done():
                turn.set_result(None)
                return
        del self._waiting[mailbox]


class MailboxTurn:
    """A turn at the mailbox of one slave in one protocol; :meth:`close` ends it."""

    def __init__(
        self,
        link: EngineLink,
        bus: int,
        station: int,
        kind: MailboxType,
        release: Callable[[], None],
    ) -> None:
        self._link = link
        self._bus = bus
        self._station = station
        self._kind = kind
        self._release = release
        self._is_open = True
        self._is_unused = True

    async def exchange(self, request: MailboxRequest) -> MailboxMessage:
        """Do one step of a conversation.

        Raises:
            BusError: as the engine's master says.
            EngineGoneError: there is no engine, or not the one with which it began.
        """
        self._is_unused = False
        limit_s = (request.delay_ns + request.timeout_ns) / _S + MARGIN_S
        reply = await self._link.request(lambda number: self._step(number, request), limit_s)
        return reply.message or MailboxMessage(self._kind, b"")

    def abandon(self) -> None:
        """Close it in the middle, and have the slave end the transfer that was begun."""
        farewell = ABORT_MESSAGES.get(self._kind)
        if self._is_open and not self._is_unused and farewell is not None:
            with suppress(EngineGoneError):
                self._link.send(lambda number: self._step(number, farewell))
        self.close()

    def close(self) -> None:
        """Give the next client its turn; harmless when it is closed."""
        if self._is_open:
            self._is_open = False
            self._release()

    def _step(self, number: int, request: MailboxRequest) -> ExchangeMailbox:
        return ExchangeMailbox(id=number, bus=self._bus, station=self._station, request=request)
