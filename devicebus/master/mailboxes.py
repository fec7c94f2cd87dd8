"""The mailbox of one slave: one request at a time, whoever asks, and nothing mixed up.

Conversations are queued (:mod:`lane`), written and read (:mod:`mailboxport`), and their replies
told from late and unsolicited messages (:mod:`late`).
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import TypeAlias, TypeVar

import msgspec
from msgspec.structs import replace

from devicebus.errors import (
    BusError,
    FrameLostError,
    MailboxClosedError,
    MailboxProtocolError,
    MailboxRefusedError,
    MailboxSizeError,
    MailboxTimeoutError,
)
from devicebus.mailbox.conversation import Conversation, MailboxMessage, MailboxRequest
from devicebus.mailbox.counter import CounterWatch, next_counter
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.lane import Job, Lanes
from devicebus.master.late import is_unsolicited
from devicebus.master.mailboxport import MailboxArea, MailboxPort, Posted
from devicebus.master.mailstats import MailboxStats, Tally
from devicebus.master.procedure import Procedure, Sleep
from devicebus.master.runner import Runner
from devicebus.master.task import Task
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_message,
    encode_message,
)
from eap.errors import CodecError, EapError

T = TypeVar("T")

FIRST_PAUSE_NS = 50_000
MAX_PAUSE_NS = 1_000_000
"""Between two looks for a reply; doubled from the first to this."""
MAX_UNSOLICITED = 16
"""Messages taken in one go while nobody has asked for anything."""


class Unsolicited(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A message that a slave sent unasked: an emergency, a notification, an Ethernet fragment."""

    station: int
    type: MailboxType
    data: bytes
    """Without the mailbox header."""


Report: TypeAlias = Callable[[Unsolicited], None]


class Mailbox:
    """The mailbox of one slave that is in PREOP or above, or in BOOT.

    Args:
        station: Of the slave.
        area: As its sync managers are set up.
        runner: Runs what is sent and read.
        report: Takes unsolicited messages.
    """

    def __init__(self, station: int, area: MailboxArea, runner: Runner, report: Report) -> None:
        self.station = station
        self.sizes = MailboxSizes(area.to_slave_size, area.to_master_size)
        self._port = MailboxPort(station, area)
        self._runner = runner
        self._report = report
        self._lanes = Lanes()
        self._watch = CounterWatch()
        self._counter = 0
        self._work: Task[None] | None = None
        self._is_busy = False
        self._is_open = True
        self._tally = Tally()

    def converse(
        self,
        conversation: Conversation[T],
        now_ns: int,
        *,
        name: str = "a request",
        requester: Hashable = None,
    ) -> Task[T]:
        """Start a conversation; *requester* takes turns with others that use the same protocol."""
        task: Task[T]
        try:
            ask = next(conversation)
        except (StopIteration, EapError) as end:
            task = Task(name, conversation.close)
            if isinstance(end, EapError):
                task.fail(end)
            else:
                task.finish(end.value)
            return task
        job = Job(conversation, ask, f"slave {self.station}: {name}", requester)
        refusal = self._refusal_of(ask, job.task.name)
        if refusal is not None:
            conversation.close()
            job.task.fail(refusal)
            return job.task
        job.ready_ns = now_ns + ask.delay_ns
        self._lanes.add(job)
        self._begin(self._serve(), now_ns)
        return job.task

    @property
    def is_busy(self) -> bool:
        """Whether something is sent or read."""
        return self._is_busy

    def look(self, now_ns: int) -> None:
        """Read what the slave has sent unasked, if nothing else is going on."""
        if self._is_open:
            self._begin(self._listen(), now_ns)

    def close(self) -> None:
        """The slave has left the states with a mailbox: end everything."""
        self._is_open = False
        if self._work is not None:
            self._work.cancel()
        self._lanes.fail_all("the slave's mailbox was closed, for it is set up anew")

    def stats(self) -> MailboxStats:
        """Return a snapshot of the counters."""
        return self._tally.stats(
            repeats=self._port.repeats, duplicates=self._watch.repeated, gaps=self._watch.gaps
        )

    def _refusal_of(self, ask: MailboxRequest, who: str) -> BusError | None:
        """Why a request cannot be sent."""
        if not self._is_open:
            return MailboxClosedError(f"{who}: the slave's mailbox is closed")
        size = MailboxHeader.SIZE + len(ask.request)
        if ask.listen or size <= self.sizes.to_slave:
            return None
        return MailboxSizeError(
            f"{who}: a message of {size} octets, the slave's mailbox holds {self.sizes.to_slave}"
        )

    def _begin(self, work: Procedure[None], now_ns: int) -> None:
        if not self._is_busy:
            self._is_busy = True
            self._work = self._runner.start(work, now_ns, f"slave {self.station}: its mailbox")

    def _serve(self) -> Procedure[None]:
        """Serve conversations until none is left."""
        try:
            _, now_ns = yield Sleep(0)
            while (ready_ns := self._lanes.next_ready()) is not None:
                job = self._lanes.take(now_ns)
                if job is None:
                    _, now_ns = yield Sleep(min(ready_ns - now_ns, MAX_PAUSE_NS))
                else:
                    now_ns = yield from self._serve_one(job)
        finally:
            self._is_busy = False

    def _listen(self) -> Procedure[None]:
        """Take messages as long as there are some, and then serve who came meanwhile."""
        with suppress(EapError):  # a slave that is gone says so to whoever asks it for something
            for _ in range(MAX_UNSOLICITED):
                if not (yield from self._port.is_full()):
                    break
                yield from self._receive(None)
        yield from self._serve()

    def _serve_one(self, job: Job) -> Procedure[int]:
        """Do what a conversation asks for next and resume it; return the time."""
        ask = job.ask
        _, start_ns = yield Sleep(0)
        error: EapError | None = None
        message = MailboxMessage(ask.type, b"")
        try:
            message = yield from self._exchange(ask, start_ns + ask.timeout_ns)
        except EapError as exc:
            error = exc
            self._tally.fail(exc)
            if isinstance(exc, MailboxTimeoutError) and not ask.listen:
                self._lanes.judge(ask.type).expire(ask)
        _, now_ns = yield Sleep(0)
        if error is None:
            self._tally.answer(now_ns - start_ns)
            answer = replace(message, at_ns=now_ns)
            _resume(job, lambda: job.conversation.send(answer), now_ns)
        else:
            reason = error
            _resume(job, lambda: job.conversation.throw(reason), now_ns)
        return now_ns

    def _exchange(self, ask: MailboxRequest, deadline_ns: int) -> Procedure[MailboxMessage]:
        refusal = self._refusal_of(ask, f"slave {self.station}")
        if refusal is not None:
            raise refusal
        if ask.listen:
            kept = self._lanes.judge(ask.type).take_kept(ask)
            if kept is not None:
                return MailboxMessage(ask.type, kept)
        else:
            early = yield from self._send(ask, deadline_ns)
            if early is not None:
                return early
            if not ask.expects_reply:
                self._lanes.judge(ask.type).took(ask.request)
                return MailboxMessage(ask.type, b"")
        pause_ns = FIRST_PAUSE_NS
        is_full = True  # a quick slave has answered by now: look at once, and look only then
        while True:
            reply = (yield from self._receive(ask)) if is_full else None
            if reply is not None:
                return reply
            _, now_ns = yield Sleep(pause_ns)
            if now_ns >= deadline_ns:
                raise MailboxTimeoutError(
                    f"slave {self.station}: no {ask.type.name} reply within"
                    f" {ask.timeout_ns // 1_000_000} ms"
                )
            pause_ns = min(2 * pause_ns, MAX_PAUSE_NS)
            is_full = yield from self._is_full(deadline_ns)

    def _send(self, ask: MailboxRequest, deadline_ns: int) -> Procedure[MailboxMessage | None]:
        """Write a request; return its reply if that came while it was written again."""
        self._counter = next_counter(self._counter)
        address = self._lanes.judge(ask.type).next_address()
        header = MailboxHeader(0, address, type=ask.type, counter=self._counter)
        message = encode_message(header, ask.request)
        maybe_there = False
        while True:
            posted = yield from self._post(message, deadline_ns)
            if posted.is_taken:
                self._tally.sent += 1
                return None
            maybe_there = maybe_there or posted.is_ambiguous
            if (yield from self._is_full(deadline_ns)):
                reply = yield from self._receive(ask if maybe_there else None)
                if reply is not None:
                    return reply
            _, now_ns = yield Sleep(MAX_PAUSE_NS)
            if now_ns >= deadline_ns:
                raise MailboxTimeoutError(
                    f"slave {self.station}: its mailbox is still full, the slave does not take"
                    " messages"
                )

    def _post(self, message: bytes, deadline_ns: int) -> Procedure[Posted]:
        """Write a request, also after the bus was silent for a while."""
        was_silent = False
        while True:
            try:
                posted = yield from self._port.post(message)
            except FrameLostError:
                was_silent = True
                _, now_ns = yield Sleep(MAX_PAUSE_NS)
                if now_ns >= deadline_ns:
                    raise
            else:
                return posted._replace(is_ambiguous=posted.is_ambiguous or was_silent)

    def _is_full(self, deadline_ns: int) -> Procedure[bool]:
        """Return whether the slave has a message, also after the bus was silent for a while."""
        while True:
            try:
                return (yield from self._port.is_full())
            except FrameLostError:
                _, now_ns = yield Sleep(MAX_PAUSE_NS)
                if now_ns >= deadline_ns:
                    raise

    def _receive(self, ask: MailboxRequest | None) -> Procedure[MailboxMessage | None]:
        """Read one message; return it if it is the reply to *ask*."""
        octets = yield from self._port.fetch()
        if octets is None:
            return None
        self._tally.received += 1
        try:
            header, body = decode_message(octets)
        except CodecError:
            self._tally.malformed += 1
            return None
        data = bytes(body)
        if not self._watch.is_new(header.counter):
            return None
        if ask is not None and self._lanes.judge(ask.type).answers(header, data, ask):
            if header.type == MailboxType.ERR:
                raise self._refusal(data)
            self._lanes.judge(ask.type).took(data)
            return MailboxMessage(header.type, data, counter=header.counter)
        if self._lanes.judge(header.type).keep(data):
            return None
        if is_unsolicited(header.type, data):
            self._tally.unsolicited += 1
            self._report(Unsolicited(self.station, header.type, data))
        else:
            self._tally.late += 1
        return None

    def _refusal(self, data: bytes) -> EapError:
        try:
            detail = MailboxErrorReply.decode(data).detail
        except CodecError:
            return MailboxProtocolError(
                f"slave {self.station}: a mailbox error of {len(data)} octets, expected 4"
            )
        return MailboxRefusedError(
            f"slave {self.station}: mailbox error {MailboxError.text_of(detail)}", detail=detail
        )


def _resume(job: Job, action: Callable[[], MailboxRequest], now_ns: int) -> None:
    """Let a conversation go on, unless it was cancelled meanwhile."""
    if job.task.is_done:
        return
    try:
        job.ask = action()
    except StopIteration as end:
        job.task.finish(end.value)
    except EapError as error:
        job.task.fail(error)
    except OSError as exc:  # of a file that the conversation reads or writes
        job.task.fail(BusError(f"{job.task.name}: {exc}"))
    else:
        job.ready_ns = now_ns + job.ask.delay_ns
