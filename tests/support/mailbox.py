"""A master's mailbox in miniature: runs conversations against a slave's, over a bad line.

It keeps the rules of a real master: a request whose confirmation was lost goes out again with the
same counter, a reply that was lost is fetched by a repeat, and the reply to a cancelled request is
waited for before the next request.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from enum import Enum, auto
from typing import TypeVar

import pytest

from devicebus.errors import MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox.conversation import (
    Conversation,
    CounterCheck,
    MailboxMessage,
    MailboxRequest,
    answers,
    drive,
    next_counter,
)
from devicebus.mailbox.protocol import MailboxSizes, ProtocolServer
from devicebus.mailbox.server import MailboxServer
from eap.codec.mailbox import (
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_message,
    encode_message,
)

T = TypeVar("T")
STEP_NS = 1_000_000


class Fault(Enum):
    """Fate of one message."""

    NONE = auto()
    LOST = auto()
    """The frame does not arrive, and is sent again."""
    CONFIRMATION_LOST = auto()
    """The frame arrives, but comes not back: sent again, or fetched by a repeat."""
    TWICE = auto()
    """A reply comes, and once more."""
    LATE = auto()
    """Nothing arrives for a while."""


class Line:
    """The master's end.

    Args:
        server: The slave's end.
        choose: What happens to the next message.
    """

    def __init__(
        self, server: MailboxServer, choose: Callable[[], Fault] = lambda: Fault.NONE
    ) -> None:
        self.server = server
        self.choose = choose
        self.now_ns = 0
        self.others: list[MailboxMessage] = []
        """Messages that no conversation waited for."""
        self.sent: list[bytes] = []
        self._counter = 0
        self._watch = CounterCheck()

    def run(self, talk: Conversation[T]) -> T:
        """Run a conversation to its end."""
        return drive(talk, self.exchange)

    def run_partly(self, talk: Conversation[object], steps: int) -> None:
        """Cancel a conversation after so many exchanges, or let it end before."""
        try:
            ask = next(talk)
            for _ in range(steps):
                ask = talk.send(self.exchange(ask))
        except StopIteration:
            return
        self._send(ask)
        talk.close()
        if ask.expects_reply:
            self._receive(ask)

    def fetch(self) -> list[MailboxMessage]:
        """Fetch what the slave sends unasked."""
        while (message := self._fetch()) is not None:
            self.others.append(message)
        return self.others

    def exchange(self, ask: MailboxRequest) -> MailboxMessage:
        """Do one step of a conversation."""
        if not ask.listen:
            self.now_ns += ask.delay_ns
            self._send(ask)
        return (
            self._receive(ask) if ask.expects_reply else MailboxMessage(ask.type, b"", self.now_ns)
        )

    def _send(self, ask: MailboxRequest) -> None:
        if ask.listen:
            return
        self.sent.append(ask.request)
        self._counter = next_counter(self._counter)
        message = encode_message(
            MailboxHeader(0, type=ask.type, counter=self._counter), ask.request
        ).ljust(self.server.sizes.to_slave, b"\xee")
        while (fault := self.choose()) is not Fault.NONE:
            if fault is Fault.CONFIRMATION_LOST:
                self.server.receive_message(message, self.now_ns)
            self.now_ns += STEP_NS
        self.server.receive_message(message, self.now_ns)

    def _receive(self, ask: MailboxRequest) -> MailboxMessage:
        deadline_ns = self.now_ns + ask.timeout_ns
        while self.now_ns <= deadline_ns:
            message = self._fetch()
            if message is None:
                self.now_ns += STEP_NS
            elif message.type is MailboxType.ERR:
                detail = MailboxErrorReply.decode(message.data).detail
                raise MailboxRefusedError("refused", detail=detail)
            elif message.type is ask.type and answers(ask.type, ask.request, message.data):
                return message
            else:
                self.others.append(message)
        raise MailboxTimeoutError("no answer")

    def _fetch(self) -> MailboxMessage | None:
        fault = self.choose()
        if fault in {Fault.LOST, Fault.LATE}:
            self.now_ns += STEP_NS
        octets = self.server.next_message(self.now_ns)
        if octets is None:
            return None
        self.server.handle_read()
        if fault is Fault.CONFIRMATION_LOST:
            assert self.server.repeat_message() == octets
            self.server.handle_read()
        header, data = decode_message(octets)
        assert self._watch.is_new(header.counter)
        if fault is Fault.TWICE:
            again = self.server.repeat_message()
            self.server.handle_read()
            assert again == octets
            assert not self._watch.is_new(decode_message(again)[0].counter)
        return MailboxMessage(header.type, bytes(data), self.now_ns)


def open_line(
    kind: MailboxType,
    server: ProtocolServer,
    sizes: MailboxSizes,
    choose: Callable[[], Fault] = lambda: Fault.NONE,
) -> Line:
    """Connect a line to a slave that has one protocol."""
    return Line(MailboxServer({kind: server}, sizes), choose)


class Answers:
    """A slave that answers with what it is told, whatever it is asked."""

    def __init__(self, answers: Iterable[bytes]) -> None:
        self._answers = iter(answers)
        self.asked: list[bytes] = []

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        self.asked.append(data)
        return []

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        return [data for data in [next(self._answers, None)] if data is not None]

    def reset(self) -> None:
        pytest.fail("nobody resets this")


def talk_to(kind: MailboxType, talk: Conversation[T], *answers: bytes | str) -> T:
    """Run a conversation with a slave that answers with these octets, one after the other."""
    return run_with(kind, talk, answers)[0]


def run_with(
    kind: MailboxType, talk: Conversation[T], answers: Iterable[bytes | str]
) -> tuple[T, list[bytes]]:
    """As talk_to(); also return what the slave was asked."""
    octets = (bytes.fromhex(item) if isinstance(item, str) else item for item in answers)
    slave = Answers(octets)
    result = open_line(kind, slave, MailboxSizes(1024, 1024)).run(talk)
    return result, slave.asked
