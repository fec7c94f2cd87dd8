"""A conversation with somebody behind a mailbox gateway, as frames to send and to receive.

A reply is known by its protocol's content, never by its counter: slaves count for themselves.
Nothing here sends or waits, so a blocking and an asynchronous client share it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

from devicebus.errors import MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox.conversation import Ask, Conversation, Message
from devicebus.mailbox.counter import next_counter
from devicebus.mailbox.farewell import FAREWELLS
from devicebus.mailbox.match import answers
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_frame,
    encode_frame,
)
from eap.codec.wire import Buffer
from eap.errors import CodecError

T = TypeVar("T")


class Dialogue(Generic[T]):
    """One conversation, step by step.

    The caller waits for *delay_ns*, sends *frame* if there is one, and hands over what comes until
    :meth:`receive` says that it was the reply; after *timeout_ns* it sends again, or gives up.
    Then the next step stands there, or the conversation is done.

    Args:
        conversation: What is to be said.
        address: Of the slave, 0 is the master.
        counter: Of the last message to that gateway; see *counter*.

    Attributes:
        counter: Of the last message that was made here.
        is_done: Whether it has ended; :meth:`result` says how.
        frame: What to send now, None only to wait.
    """

    def __init__(self, conversation: Conversation[T], address: int, counter: int = 0) -> None:
        self.counter = counter
        self.is_done = False
        self.frame: bytes | None = None
        self._conversation = conversation
        self._address = address
        self._ask: Ask | None = None
        self._result: list[T] = []
        self._error: BaseException | None = None
        self._go_on(lambda: next(conversation))

    @property
    def delay_ns(self) -> int:
        """How long to wait before sending."""
        return self._ask.delay_ns if self._ask else 0

    def result(self) -> T:
        """Return what the conversation returned, or raise what it raised."""
        if self._error is not None:
            raise self._error
        return self._result[0]

    def receive(self, octets: Buffer) -> bool:
        """Take a frame; return whether it was the reply, and the next step is there."""
        if self._ask is None:
            return False
        try:
            header, body = decode_frame(octets)
        except CodecError:
            return False
        if header.address != self._address:
            return False
        data = bytes(body)
        if header.type is MailboxType.ERR:
            self._throw(_refusal(self._address, data))
            return True
        is_reply = header.type is self._ask.type and answers(header.type, self._ask.request, data)
        if is_reply:
            self._advance(Message(header.type, data, counter=header.counter))
        return is_reply

    def sent(self) -> None:
        """Go on after sending what nobody answers."""
        if self._ask is not None and not self._ask.expects_reply:
            self._advance(Message(self._ask.type, b""))

    @property
    def expects_reply(self) -> bool:
        """Whether somebody answers *frame*."""
        return self._ask is None or self._ask.expects_reply

    def expire(self, reason: str) -> None:
        """Give up waiting; *reason* says for whom."""
        self._throw(MailboxTimeoutError(f"no answer from address {self._address}: {reason}"))

    def close(self) -> bytes | None:
        """End it; return a frame, not answered, that frees the slave if that was in the middle."""
        ask, was_done, self.is_done = self._ask, self.is_done, True
        self._conversation.close()
        farewell = None if was_done or ask is None else FAREWELLS.get(ask.type)
        return None if farewell is None else self._frame_of(farewell)

    def _advance(self, message: Message) -> None:
        self._go_on(lambda: self._conversation.send(message))

    def _throw(self, error: Exception) -> None:
        self._go_on(lambda: self._conversation.throw(error))

    def _go_on(self, step: Callable[[], Ask]) -> None:
        """Have the conversation do its next step, and keep what it says."""
        try:
            ask = step()
        except StopIteration as end:
            self._result.append(end.value)
            self._end()
        except BaseException as exc:  # noqa: BLE001  it belongs to who wants the result
            self._error = exc
            self._end()
        else:
            self._ask = ask
            self.frame = None if ask.listen else self._frame_of(ask)

    def _frame_of(self, ask: Ask) -> bytes:
        self.counter = next_counter(self.counter)
        header = MailboxHeader(0, self._address, type=ask.type, counter=self.counter)
        return encode_frame(header, ask.request)

    def _end(self) -> None:
        self.is_done = True
        self.frame = self._ask = None


def patience(timeout_s: float, tries: int, transport: str) -> str:
    """Return in words how long a gateway was silent, and what that may mean."""
    return (
        f"was silent for {timeout_s * tries:g} s; is it started, and does a firewall let"
        f" {transport} through?"
    )


def _refusal(address: int, data: bytes) -> MailboxRefusedError:
    who = f"slave {address}" if address else "the master"
    try:
        detail = MailboxErrorReply.decode(data).detail
    except CodecError:
        return MailboxRefusedError(f"{who}: mailbox error without a reason", detail=0)
    return MailboxRefusedError(
        f"{who}: mailbox error {MailboxError.text_of(detail)}", detail=detail
    )
