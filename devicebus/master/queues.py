"""Queues of one slave's mailbox: its conversations, and messages of other slaves.

Conversations of one protocol run one after the other, because a server has only one transfer;
requesters alternate.  Protocols alternate message by message, so that a long file transfer does not
delay an SDO.

The counter of a reply is unrelated to its request.  After a time-out requests therefore carry a tag
in the address field, which slaves echo.  Some slaves do not echo it: then the first reply that fits
the request that timed out counts as late.  A slave may send the next fragment of an answer before
the master listens for it; such a fragment is stored.

The master forwards messages between slaves of one bus (ETG.1000.4).  A slave addresses another one
by the station address in the mailbox header.  The master writes the message to that slave with the
address of the sender instead, which is echoed in the reply, so the reply goes back by the same
rule.  Some slaves write address 0 into replies: such a message goes back to the slave whose request
it answers, if the master has no request of that kind itself.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator
from typing import Any, NamedTuple

from devicebus.errors import MailboxClosedError
from devicebus.mailbox.conversation import (
    Conversation,
    MailboxRequest,
    answers,
    has_more,
    is_unsolicited,
)
from devicebus.master.procedure import Task
from eap.codec.mailbox import MailboxHeader, MailboxType

# Masters send address 0; the gateways of KickCAT and libethercat mark their requests on the bus by
# bit 15 as well.
_TAG = 0x8000
_TAGS = 0x3FFF
MAX_STORED = 64
"""Limit for stored fragments."""
MAX_WAITING = 16
"""Limit for messages that wait for one slave, and for requests to it without a reply yet."""
FORWARD_LIMIT_NS = 1_000_000_000
"""Time within which a slave has to take a message."""


class ReplyMatcher:
    """Tags of the requests of one protocol to one slave, and the matching of its replies."""

    def __init__(self, kind: MailboxType) -> None:
        self._kind = kind
        self._stored: deque[bytes] = deque()
        self._has_more = False
        self._tag = 0
        self._echoes = False
        self._expired: list[MailboxRequest] = []
        self._suspected = False

    def next_address(self) -> int:
        """Return the address field of the next request: 0 before the first time-out."""
        self._suspected = self._has_more = False
        self._stored.clear()
        if self._tag:
            self._tag = _TAG | (self._tag + 1 & _TAGS)
        return self._tag

    def expire(self, step: MailboxRequest) -> None:
        """Note a request that has timed out, whose reply may still come."""
        if not self._suspected:
            self._expired.append(step)
        self._tag = self._tag or _TAG

    def note_part(self, data: bytes) -> None:
        """Note a part that was sent or received; further fragments of it may follow."""
        self._has_more = has_more(self._kind, data)

    def store(self, data: bytes) -> bool:
        """Store a fragment that no conversation listens for yet; return false for no fragment."""
        is_next = self._has_more and not is_unsolicited(self._kind, data)
        if not is_next or len(self._stored) >= MAX_STORED:
            return False
        self._stored.append(data)
        self._has_more = has_more(self._kind, data)
        return True

    def take_stored(self, step: MailboxRequest) -> bytes | None:
        """Return the stored fragment that *step* listens for, or None."""
        while self._stored:
            data = self._stored.popleft()
            if answers(step.type, step.request, data):
                return data
        return None

    def answers(self, header: MailboxHeader, data: bytes, step: MailboxRequest) -> bool:
        """Return true if a message is the reply to *step*."""
        if header.type == MailboxType.ERR or _fits(header, data, step):
            return not self._is_late(header, data)
        self._drop_expired(header, data)
        return False

    def _is_late(self, header: MailboxHeader, data: bytes) -> bool:
        if not self._tag:
            return False
        if header.address == self._tag:
            self._echoes = True
            self._expired.clear()
            return False
        # Some slave stacks write address 0 in replies: the tag is only checked for a slave that
        # has echoed one.
        if self._echoes or header.address & _TAG:
            return True
        self._suspected = self._drop_expired(header, data)
        return self._suspected

    def _drop_expired(self, header: MailboxHeader, data: bytes) -> bool:
        """Remove the expired request that this message answers; return false if there is none."""
        for step in self._expired:
            if header.type == MailboxType.ERR or _fits(header, data, step):
                self._expired.remove(step)
                return True
        return False


def _fits(header: MailboxHeader, data: bytes, step: MailboxRequest) -> bool:
    return header.type == step.type and answers(step.type, step.request, data)


class QueuedConversation:
    """Started conversation.

    Attributes:
        step: Its next request.
        ready_ns: Earliest time of this request.
        timeout_ns: Time-out of each request, instead of its own; None for its own.
    """

    __slots__ = ("conversation", "ready_ns", "requester", "step", "task", "timeout_ns")

    def __init__(
        self,
        conversation: Conversation[Any],
        step: MailboxRequest,
        name: str,
        requester: Hashable,
        timeout_ns: int | None = None,
    ) -> None:
        self.conversation = conversation
        self.step = step
        self.ready_ns = 0
        self.requester = requester
        self.timeout_ns = timeout_ns
        self.task: Task[Any] = Task(name, conversation.close)


class ProtocolQueue:
    """Conversations of one protocol with one slave; *matcher* matches their replies."""

    def __init__(self, kind: MailboxType) -> None:
        self.matcher = ReplyMatcher(kind)
        self.active: QueuedConversation | None = None
        self._waiting: dict[Hashable, deque[QueuedConversation]] = {}

    def add(self, job: QueuedConversation) -> None:
        """Queue a conversation."""
        self._waiting.setdefault(job.requester, deque()).append(job)
        self.advance()

    def advance(self) -> None:
        """Activate the conversation of the next requester if the active one has ended."""
        if self.active is not None and not self.active.task.is_done:
            return
        self.active = None
        while self._waiting and self.active is None:
            requester = next(iter(self._waiting))
            jobs = self._waiting.pop(requester)
            job = jobs.popleft()
            if jobs:
                self._waiting[requester] = jobs
            if not job.task.is_done:
                self.active = job

    def __iter__(self) -> Iterator[QueuedConversation]:
        if self.active is not None:
            yield self.active
        for jobs in self._waiting.values():
            yield from jobs


class ConversationQueue:
    """Conversations of all protocols with one slave."""

    def __init__(self) -> None:
        self._queues: dict[MailboxType, ProtocolQueue] = {}

    def add(self, job: QueuedConversation) -> None:
        """Queue a conversation."""
        self._queue(job.step.type).add(job)

    def matcher(self, kind: MailboxType) -> ReplyMatcher:
        """Return the matcher for the replies of a protocol."""
        return self._queue(kind).matcher

    def _queue(self, kind: MailboxType) -> ProtocolQueue:
        return self._queues.setdefault(kind, ProtocolQueue(kind))

    def next_job(self, now_ns: int) -> QueuedConversation | None:
        """Return the conversation to continue now, or None."""
        ready = []
        for queue in self._queues.values():
            queue.advance()
            if queue.active is not None and queue.active.ready_ns <= now_ns:
                ready.append(queue.active)
        if not ready:
            return None
        # A conversation that only listens has priority: no other can match its message.
        job = next((each for each in ready if each.step.listen), ready[0])
        # Moved to the end: protocols alternate message by message.
        self._queues[job.step.type] = self._queues.pop(job.step.type)
        return job

    def next_ready(self) -> int | None:
        """Return the time at which the next conversation is ready."""
        times = [
            queue.active.ready_ns for queue in self._queues.values() if queue.active is not None
        ]
        return min(times, default=None)

    def fail_all(self, reason: str) -> None:
        """Fail every conversation with MailboxClosedError."""
        for queue in self._queues.values():
            for job in list(queue):
                if not job.task.is_done:
                    job.conversation.close()
                    job.task.fail(MailboxClosedError(f"{job.task.name}: {reason}"))


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
