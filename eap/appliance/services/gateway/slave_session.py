"""One client's session with one slave in one mailbox protocol.

Rule 1: while a transfer runs, the slave's server for its protocol belongs to this session; others
wait for a while, then they are told that it is busy.
Rule 2: a request is answered within a time, by the slave or by the gateway.
Rule 3: a transfer that nobody goes on with is ended, and the slave is told.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import asynccontextmanager

import msgspec
from msgspec.structs import replace

from devicebus.errors import (
    BusError,
    MailboxRefusedError,
    MailboxTimeoutError,
)
from devicebus.mailbox.conversation import Ask, Message
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.wire.sii import SiiProtocol
from eap.appliance.bus_failure import no_mailbox
from eap.appliance.bus_request import SlaveReport
from eap.appliance.services.bus.bus_talk import Talk
from eap.codec.coe import CoeHeader
from eap.codec.mailbox import MailboxHeader, MailboxType
from eap.codec.sdoinfo import SdoInfoHeader
from eap.errors import EapError, EngineGoneError
from eap.gateway.error_table import cause_of
from eap.gateway.refusal import Reason, mailbox_error, refuse
from eap.gateway.transfer import Transfer

IDLE_S = 5.0
"""How long a transfer waits for its client's next step."""
_NAMED = {
    MailboxType.COE: CoeHeader.SIZE + SdoInfoHeader.SIZE,
    MailboxType.SOE: 2,
}
"""Octets of a request that fragments of its answer repeat."""
_GRACE_S = 0.03
"""For the engine, which answers at the deadline itself."""
_S = 1_000_000_000


class Reply(msgspec.Struct, frozen=True):
    """A message that goes back to the client; *counter* is the slave's, 0 if it is our own."""

    type: MailboxType
    body: bytes
    counter: int = 0
    reason: Reason | None = None
    """Why, if the gateway itself answers."""
    is_again: bool = False
    """Whether it answers a repeated step of a transfer, as it answered the step itself."""


def again(replies: Iterable[Reply]) -> list[Reply]:
    """Return replies as what answers a step that is repeated."""
    return [replace(each, is_again=True) for each in replies]


class NoTurnError(EapError):
    """Others had their turns all the time that there was."""


@asynccontextmanager
async def turn_of(lock: asyncio.Lock, deadline_s: float) -> AsyncIterator[None]:
    """Wait for a turn, in which a session does one request; raise NoTurnError at the deadline."""
    try:
        async with asyncio.timeout_at(deadline_s):
            await lock.acquire()
    except TimeoutError:
        raise NoTurnError from None
    try:
        yield
    finally:
        lock.release()


class SlaveSession:
    """What one client does with one slave in one protocol.

    Args:
        kind: The protocol.
        slave: As the engine knows it.
        open_talk: Takes a turn at the slave's mailbox.
        answer_s: How long an answer may take.
        idle_s: As IDLE_S.
    """

    def __init__(
        self,
        kind: MailboxType,
        slave: SlaveReport,
        open_talk: Callable[[], Awaitable[Talk]],
        *,
        answer_s: float,
        idle_s: float = IDLE_S,
    ) -> None:
        self._kind = kind
        self._open_talk = open_talk
        self._answer_s = answer_s
        self._idle_s = idle_s
        self._transfer = Transfer(kind, MailboxSizes(slave.to_slave, slave.to_master))
        self._last: list[Reply] = []
        self._talk: Talk | None = None
        self._turn = asyncio.Lock()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_running(self) -> bool:
        """Whether a transfer is under way."""
        return self._transfer.is_running

    async def ask(self, body: bytes, *, is_step: bool) -> list[Reply]:
        """Have the slave answer a request; return what goes back, which may be nothing.

        Args:
            body: What stands behind the mailbox header.
            is_step: Whether it only makes sense within a transfer.
        """
        deadline_s = asyncio.get_running_loop().time() + self._answer_s
        try:
            async with turn_of(self._turn, deadline_s):
                return await self._ask(body, deadline_s, is_step=is_step)
        except NoTurnError:
            return self._refuse(body, Reason.TIMEOUT)

    async def _ask(self, body: bytes, deadline_s: float, *, is_step: bool) -> list[Reply]:
        if self._transfer.is_repeated(body):
            return again(self._last)
        if is_step and not self.is_running:
            return self._refuse(body, Reason.SERVICE, "no transfer is under way")
        self._stop_timer()
        try:
            self._last = await self._exchange(body, deadline_s)
        except BaseException:
            self.close()
            raise
        if self.is_running:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(self._idle_s, self.close)
        else:
            self._let_go()
        return self._last

    def close(self) -> None:
        """End what is under way: the slave is told that it will not go on."""
        self._stop_timer()
        talk, self._talk = self._talk, None
        if talk is not None:
            talk.abandon()
        self._transfer.end()

    async def _exchange(self, body: bytes, deadline_s: float) -> list[Reply]:
        try:
            talk = await self._take_turn(deadline_s)
            return await self._pass_on(talk, body, deadline_s)
        except NoTurnError:
            return self._refuse(body, Reason.BUSY)
        except MailboxRefusedError as exc:
            self._transfer.end()
            return [Reply(*mailbox_error(exc.detail))]
        except (BusError, EngineGoneError) as exc:
            self.close()
            return self._refuse(body, cause_of(exc), str(exc))

    async def _take_turn(self, deadline_s: float) -> Talk:
        if self._talk is None:
            try:
                async with asyncio.timeout_at(deadline_s):
                    self._talk = await self._open_talk()
            except TimeoutError:
                raise NoTurnError from None
        return self._talk

    async def _pass_on(self, talk: Talk, body: bytes, deadline_s: float) -> list[Reply]:
        expects_reply = self._transfer.ask(body)
        whole = self._transfer.whole
        ask = Ask(self._kind, body, expects_reply=expects_reply and not whole)
        message = await self._step(talk, ask, deadline_s)
        if not expects_reply:
            return []
        named = whole or body[: _NAMED.get(self._kind, len(body))]
        if whole:  # its answer does not name the fragment that was last
            message = await self._step(talk, Ask(self._kind, named, listen=True), deadline_s)
        replies = [self._note(message)]
        while self._transfer.has_more(message.data):
            message = await self._step(talk, Ask(self._kind, named, listen=True), deadline_s)
            replies.append(self._note(message))
        return replies

    async def _step(self, talk: Talk, ask: Ask, deadline_s: float) -> Message:
        rest_s = deadline_s - asyncio.get_running_loop().time()
        asked = replace(ask, timeout_ns=max(1, int(rest_s * _S)))
        try:
            # The engine's time counts from when the mailbox is free.
            async with asyncio.timeout_at(deadline_s + _GRACE_S):
                return await talk.ask(asked)
        except TimeoutError:
            raise MailboxTimeoutError("its mailbox was not free in time") from None

    def _note(self, message: Message) -> Reply:
        self._transfer.answer(message.data)
        return Reply(message.type, message.data, message.counter)

    def _refuse(self, body: bytes, reason: Reason, text: str = "") -> list[Reply]:
        return [Reply(*refuse(self._kind, body, reason, text), reason=reason)]

    def _let_go(self) -> None:
        talk, self._talk = self._talk, None
        if talk is not None:
            talk.close()

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def find_refusal(kind: MailboxType, body: bytes, slave: SlaveReport) -> Reason | None:
    """Return why a request does not even go to the slave it is for."""
    if not slave.to_slave:
        return cause_of(no_mailbox(slave))
    if not slave.protocols & SiiProtocol[kind.name]:
        return Reason.NO_PROTOCOL
    if len(body) + MailboxHeader.SIZE > slave.to_slave:
        return Reason.TOO_LONG
    return None
