"""Who may talk to a slave next.

Conversations of one protocol run one after the other, for a server knows only one transfer;
requesters take turns.  Protocols take turns message by message, so that a long file transfer does
not hold up an SDO.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Iterator
from typing import Any

from devicebus.errors import MailboxClosedError
from devicebus.mailbox.conversation import Conversation, MailboxRequest
from devicebus.master.late import ReplyJudge
from devicebus.master.task import Task
from eap.codec.mailbox import MailboxType


class Job:
    """A conversation that somebody started.

    Attributes:
        ask: What it wants next.
        ready_ns: Not before then.
    """

    __slots__ = ("ask", "conversation", "ready_ns", "requester", "task")

    def __init__(
        self, conversation: Conversation[Any], ask: MailboxRequest, name: str, requester: Hashable
    ) -> None:
        self.conversation = conversation
        self.ask = ask
        self.ready_ns = 0
        self.requester = requester
        self.task: Task[Any] = Task(name, conversation.close)


class Lane:
    """The conversations of one protocol with one slave; *judge* knows their replies."""

    def __init__(self, kind: MailboxType) -> None:
        self.judge = ReplyJudge(kind)
        self.active: Job | None = None
        self._waiting: dict[Hashable, deque[Job]] = {}

    def add(self, job: Job) -> None:
        """Let it wait for its turn."""
        self._waiting.setdefault(job.requester, deque()).append(job)
        self.advance()

    def advance(self) -> None:
        """Begin the next conversation if the last one is over: that of the next requester."""
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

    def __iter__(self) -> Iterator[Job]:
        if self.active is not None:
            yield self.active
        for jobs in self._waiting.values():
            yield from jobs


class Lanes:
    """All conversations with one slave."""

    def __init__(self) -> None:
        self._lanes: dict[MailboxType, Lane] = {}

    def add(self, job: Job) -> None:
        """Let it wait for its turn."""
        self._lane(job.ask.type).add(job)

    def judge(self, kind: MailboxType) -> ReplyJudge:
        """Return who knows the replies of a protocol."""
        return self._lane(kind).judge

    def _lane(self, kind: MailboxType) -> Lane:
        return self._lanes.setdefault(kind, Lane(kind))

    def take(self, now_ns: int) -> Job | None:
        """Return whose turn it is, if anybody may go on now.

        One that only listens goes first: nobody else would know its message.
        """
        ready = []
        for lane in self._lanes.values():
            lane.advance()
            if lane.active is not None and lane.active.ready_ns <= now_ns:
                ready.append(lane.active)
        if not ready:
            return None
        job = next((each for each in ready if each.ask.listen), ready[0])
        self._lanes[job.ask.type] = self._lanes.pop(job.ask.type)
        return job

    def next_ready(self) -> int | None:
        """When somebody may send who may not yet."""
        times = [lane.active.ready_ns for lane in self._lanes.values() if lane.active is not None]
        return min(times, default=None)

    def fail_all(self, reason: str) -> None:
        """End every conversation."""
        for lane in self._lanes.values():
            for job in list(lane):
                if not job.task.is_done:
                    job.conversation.close()
                    job.task.fail(MailboxClosedError(f"{job.task.name}: {reason}"))
