"""A turn at a slave's mailbox."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from time import monotonic_ns

from devicebus.mailbox.conversation import MailboxMessage, MailboxRequest
from devicebus.mailbox.farewell import FAREWELLS
from eap.appliance.bus_request import AskMailbox
from eap.appliance.control_bus import MARGIN_S
from eap.appliance.services.engine_link import EngineLink
from eap.codec.mailbox import MailboxType
from eap.errors import EngineGoneError

_S = 1_000_000_000


class Talk:
    """A turn at the mailbox of one slave in one protocol; :meth:`close` gives it back."""

    def __init__(
        self,
        link: EngineLink,
        bus: int,
        station: int,
        kind: MailboxType,
        give_back: Callable[[], None],
    ) -> None:
        self._link = link
        self._bus = bus
        self._station = station
        self._kind = kind
        self._give_back = give_back
        self._is_open = True
        self._is_silent = True

    async def ask(self, ask: MailboxRequest) -> MailboxMessage:
        """Do one step.

        Raises:
            BusError: as the engine's master says.
            EngineGoneError: there is no engine, or not the one with which it began.
        """
        self._is_silent = False
        answer = await self._link.ask(
            lambda number: self._request(ask, number),
            (ask.delay_ns + ask.timeout_ns) / _S + MARGIN_S,
        )
        return MailboxMessage(self._kind, answer.data, monotonic_ns(), answer.counter)

    def abandon(self) -> None:
        """Close it in the middle: the slave is told that what it has begun will not go on."""
        farewell = FAREWELLS.get(self._kind)
        if self._is_open and not self._is_silent and farewell is not None:
            with suppress(EngineGoneError):
                self._link.tell(lambda number: self._request(farewell, number))
        self.close()

    def close(self) -> None:
        """Let the next one talk; harmless when it is closed."""
        if self._is_open:
            self._is_open = False
            self._give_back()

    def _request(self, ask: MailboxRequest, number: int) -> AskMailbox:
        return AskMailbox(
            id=number,
            bus=self._bus,
            station=self._station,
            type=self._kind,
            request=ask.request,
            listen=ask.listen,
            timeout_ns=ask.timeout_ns,
            delay_ns=ask.delay_ns,
            expects_reply=ask.expects_reply,
        )
