"""Conversation: a client's side of a mailbox protocol, written as a generator.

    def read_twice() -> Conversation[bytes]:
        first = yield MailboxRequest(MailboxType.COE, request)
        more = yield MailboxRequest(MailboxType.COE, request, listen=True)  # nothing is sent
        return first.data + more.data

The driver (:mod:`devicebus.drive`, or a master's mailbox) sends the request, waits, and resumes the
generator with the reply.  It throws MailboxTimeoutError when no reply comes and MailboxRefusedError
when the slave answers with a mailbox error, and closes the generator to cancel it.

The records travel as they are, in MessagePack, between the processes that share a master.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import TypeAlias, TypeVar

import msgspec

from devicebus.errors import MailboxProtocolError
from eap.codec import foe
from eap.codec.coe import encode_abort
from eap.codec.mailbox import MailboxType
from eap.errors import CodecError
from eap.od.abort import AbortCode

T = TypeVar("T")

RESPONSE_TIMEOUT_NS = 2_000_000_000
"""Default time-out for the answer of a slave (default of ESI files)."""


class MailboxRequest(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One step of a conversation; :func:`devicebus.mailbox.match.answers` identifies its reply."""

    type: MailboxType
    request: bytes
    """Message to send, without the mailbox header."""
    listen: bool = False
    """Send nothing; wait for one more message that answers *request*."""
    timeout_ns: int = RESPONSE_TIMEOUT_NS
    delay_ns: int = 0
    """Pause before sending, as after a busy reply."""
    expects_reply: bool = True
    """If false, the conversation is resumed after sending, with a message without data."""


class MailboxMessage(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A mailbox message without its header."""

    type: MailboxType
    data: bytes
    at_ns: int = 0
    """Time of arrival; 0 without a clock, where a count of messages is the only limit."""
    counter: int = 0
    """Counter of its mailbox header: the slave's own sequence, unrelated to the request."""


Conversation: TypeAlias = Generator[MailboxRequest, MailboxMessage, T]


RATE_WINDOW_NS = 2_000_000_000
"""Averaging window of Progress.rate()."""


class Progress:
    """Progress of a transfer, readable at any time.

    Attributes:
        done: Bytes transferred.
        total: Total size in bytes, None where the protocol does not carry it.
    """

    __slots__ = ("_seen", "done", "total")

    def __init__(self, total: int | None = None) -> None:
        self.done = 0
        self.total = total
        self._seen: deque[tuple[int, int]] = deque()

    def rate(self, now_ns: int) -> float:
        """Return bytes per second over the last two seconds, 0 at the first call.

        Intended for one caller, a few times a second.
        """
        seen = self._seen
        while len(seen) > 1 and seen[1][0] <= now_ns - RATE_WINDOW_NS:
            seen.popleft()
        seen.append((now_ns, self.done))
        first_ns, first = seen[0]
        return (self.done - first) * 1e9 / (now_ns - first_ns) if now_ns > first_ns else 0.0


@contextmanager
def reading(what: str) -> Iterator[None]:
    """Convert CodecError, raised while a slave's message is decoded, to MailboxProtocolError."""
    try:
        yield
    except CodecError as exc:
        raise MailboxProtocolError(f"{what}: {exc}") from None


# Short: a slave that accepts no messages must not delay other clients by this one.
_ABORT_TIMEOUT_NS = 50_000_000
# Other protocols have no transfers that stay open. A slave without a transfer ignores the message,
# so it is safe to send it whenever the slave's state is unknown.
ABORT_MESSAGES = {
    MailboxType.COE: MailboxRequest(
        MailboxType.COE,
        encode_abort(0, 0, AbortCode.GENERAL),
        timeout_ns=_ABORT_TIMEOUT_NS,
        expects_reply=False,
    ),
    MailboxType.FOE: MailboxRequest(
        MailboxType.FOE,
        foe.encode_message(foe.FoeOpcode.ERROR, foe.FoeErrorCode.NOT_DEFINED),
        timeout_ns=_ABORT_TIMEOUT_NS,
        expects_reply=False,
    ),
}
"""Messages that end an abandoned transfer, by protocol."""
