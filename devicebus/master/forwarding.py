"""Mailbox messages between slaves of one bus, which the master forwards (ETG.1000.4).

A slave addresses another one by the station address in the mailbox header.  The master writes the
message to that slave with the address of the sender instead, which is echoed in the reply, so the
reply goes back by the same rule.  Some slaves write address 0 into replies: such a message goes
back to the slave whose request it answers, if the master has no request of that kind itself.

All is bounded: messages that wait, their time, and requests whose reply is awaited.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from devicebus.mailbox.conversation import answers
from eap.codec.mailbox import MailboxType

MAX_WAITING = 16
"""Limit for messages that wait for one slave, and for requests to it without a reply yet."""
LIMIT_NS = 1_000_000_000
"""Time within which a slave has to take a message."""


class ForwardedMessage(NamedTuple):
    """Message from one slave to another, without mailbox header."""

    source: int
    """Station address of the sender."""
    type: MailboxType
    data: bytes
    deadline_ns: int


class ForwardQueue:
    """Messages of other slaves for one slave."""

    def __init__(self) -> None:
        self._waiting: deque[ForwardedMessage] = deque()
        self._asked: deque[ForwardedMessage] = deque(maxlen=MAX_WAITING)

    @property
    def first(self) -> ForwardedMessage | None:
        """The next message to write, None without one."""
        return self._waiting[0] if self._waiting else None

    def add(self, message: ForwardedMessage) -> bool:
        """Queue a message; return False if too many wait."""
        if len(self._waiting) >= MAX_WAITING:
            return False
        self._waiting.append(message)
        return True

    def end_first(self, *, is_written: bool) -> None:
        """Remove the first message; the slave may reply to one that was written."""
        message = self._waiting.popleft()
        if is_written:
            self._asked.append(message)

    def take_source(self, kind: MailboxType, data: bytes) -> int | None:
        """Return the slave whose request a message answers, once; None if there is none."""
        for message in self._asked:
            if message.type is kind and answers(kind, message.data, data):
                self._asked.remove(message)
                return message.source
        return None
