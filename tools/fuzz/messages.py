"""Octets cut into mailbox messages, and conversations that get them for answers."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TypeVar

from devicebus.errors import MailboxTimeoutError
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxMessage,
    MailboxRequest,
    answers,
    drive,
)
from eap.codec.mailbox import MailboxType

T = TypeVar("T")


def cut(data: bytes) -> Iterator[bytes]:
    """Cut *data* into messages: a length of up to 47 octets, and as many octets."""
    at = 0
    while at < len(data):
        size = data[at] % 48
        yield data[at + 1 : at + 1 + size]
        at += 1 + size


def _next_answer(ask: MailboxRequest, rest: Iterator[bytes]) -> bytes | None:
    for n, data in enumerate(rest):
        if n % 2 or answers(ask.type, ask.request, data):
            return data
    return None


def answer_with(talk: Conversation[T], kind: MailboxType, answers: Iterable[bytes]) -> T:
    """Run a conversation to its end; when no answer is left it gets a time-out.

    Every other answer is accepted whatever the conversation says, as if it were expected.
    """
    rest = iter(answers)

    def exchange(ask: MailboxRequest) -> MailboxMessage:
        if not ask.expects_reply:
            return MailboxMessage(kind, b"")
        found = _next_answer(ask, rest)
        if found is None:
            raise MailboxTimeoutError("no answer is left")
        return MailboxMessage(kind, found)

    return drive(talk, exchange)
