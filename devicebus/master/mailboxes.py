"""Mailbox of one slave: one request at a time, for all requesters, with counters (ETG.1000.4).

:mod:`queues` queues conversations and matches replies; :class:`MailboxPort` writes and
reads sync managers 0 and 1.  A message whose write frame was lost is written again with the same
counter, by which the slave drops the repetition.  A message whose read frame was lost is requested
again by the repeat bit.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import NamedTuple, TypeAlias, TypeVar

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
from devicebus.mailbox.conversation import (
    Conversation,
    CounterCheck,
    MailboxMessage,
    MailboxRequest,
    is_unsolicited,
    next_counter,
)
from devicebus.mailbox.protocol import MINIMUM_SIZE, MailboxSizes
from devicebus.master.link import MAX_DATA
from devicebus.master.procedure import Procedure, Runner, Sleep, Task, read, write
from devicebus.master.queues import (
    FORWARD_LIMIT_NS,
    ConversationQueue,
    ForwardedMessage,
    ForwardQueue,
    QueuedConversation,
)
from devicebus.wire.datagram import fprd, fpwr
from devicebus.wire.register import Register, SmStatus, SyncManager
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_message,
    encode_message,
)
from eap.errors import CodecError, EapError

REPEAT_TIMEOUT_NS = 100_000_000
"""Time-out for the repeat acknowledge; after it the message is lost."""
POLL_NS = 200_000

FIRST_MEMORY = 0x1000
"""First address of the process data memory, behind the registers."""
_IN = Register.SYNC_MANAGER + SyncManager.SIZE
STATUS = _IN + 5
_ACTIVATE = _IN + 6
_PDI_CONTROL = _IN + 7


class MailboxArea(NamedTuple):
    """Addresses and sizes in bytes of a slave's mailboxes; size 0 without a mailbox."""

    to_slave: int
    to_slave_size: int
    to_master: int
    to_master_size: int

    @property
    def is_there(self) -> bool:
        """True if the slave has a mailbox."""
        return min(self.to_slave_size, self.to_master_size) >= MINIMUM_SIZE

    def check(self, station: int) -> None:
        """Raise BusError if an area exceeds a frame, or overlaps the registers."""
        for start, size in (self[:2], self[2:]):
            if size > MAX_DATA or not FIRST_MEMORY <= start <= 0x1_0000 - size:
                raise BusError(
                    f"slave {station}: its mailbox of {size} bytes at 0x{start:04X} cannot be,"
                    f" expected at most {MAX_DATA} bytes from 0x{FIRST_MEMORY:04X} on"
                )

    def sync_managers(self) -> tuple[SyncManager, SyncManager]:
        """Return the registers of sync managers 0 and 1."""
        return (
            SyncManager(self.to_slave, self.to_slave_size, 2, 1, pdi_interrupt=1, enable=1),
            SyncManager(self.to_master, self.to_master_size, 2, 0, pdi_interrupt=1, enable=1),
        )


class WriteResult(NamedTuple):
    """Result of writing a message."""

    is_accepted: bool
    """False: the mailbox is still full."""
    is_ambiguous: bool
    """True if a frame was lost, so that the slave may have received the message all the same."""


class MailboxPort:
    """Access to the mailboxes of one slave.

    Attributes:
        repeats: Number of repeat requests.
    """

    def __init__(self, station: int, area: MailboxArea) -> None:
        self.station = station
        self.area = area
        self.repeats = 0
        self._repeat = 0
        self._needs_repeat = False

    def write_message(self, message: bytes) -> Procedure[WriteResult]:
        """Write a message; a full mailbox refuses it.

        Raises:
            FrameLostError: no frame comes back.
        """
        # The mailbox becomes full when its last byte is written, so the whole area is sent.
        padded = message.ljust(self.area.to_slave_size, b"\0")
        (reply,), _ = yield [fpwr(self.station, self.area.to_slave, padded)]
        return WriteResult(reply.wkc == 1, reply.tries > 1)

    def is_full(self) -> Procedure[bool]:
        """Return true if the slave has a message; request a repetition first if one was lost.

        Raises:
            FrameLostError: no frame comes back.
            WorkingCounterError: the slave does not answer.
        """
        if self._needs_repeat:
            yield from self._request_repeat()
        (status,) = yield from read(self.station, STATUS, 1, "mailbox status")
        return bool(status & SmStatus.MAILBOX_FULL)

    def read_message(self) -> Procedure[bytes | None]:
        """Read the slave's message; return None without a message or if the frame is lost.

        A lost read frame has emptied the mailbox: :meth:`is_full` requests the repetition.
        """
        area = self.area
        try:
            # Sent once: a lost read has emptied the mailbox, a second read would only fail.
            (reply,), _ = yield [fprd(self.station, area.to_master, area.to_master_size, tries=1)]
        except FrameLostError:
            self._needs_repeat = True
            self._repeat ^= 1
            self.repeats += 1
            return None
        return reply.data if reply.wkc else None

    def _request_repeat(self) -> Procedure[None]:
        """Toggle the repeat bit of SM 1 (0x080E bit 1) and wait for its copy (0x080F bit 1)."""
        octet = bytes((1 | self._repeat << 1,))
        yield from write(self.station, _ACTIVATE, octet, "repeat request")
        _, now_ns = yield Sleep(0)
        deadline_ns = now_ns + REPEAT_TIMEOUT_NS
        while now_ns < deadline_ns:
            (copied,) = yield from read(self.station, _PDI_CONTROL, 1, "repeat acknowledge")
            if copied >> 1 & 1 == self._repeat:
                break
            _, now_ns = yield Sleep(POLL_NS)
        self._needs_repeat = False


def configure(station: int, area: MailboxArea) -> Procedure[None]:
    """Write sync managers 0 and 1; the slave must be in INIT.

    Raises WorkingCounterError if the slave does not answer.
    """
    octets = b"".join(each.encode() for each in area.sync_managers())
    # A sync manager is reconfigured while it is disabled.
    yield from write(station, Register.SYNC_MANAGER, bytes(len(octets)), "sync managers")
    yield from write(station, Register.SYNC_MANAGER, octets, "sync managers")


T = TypeVar("T")

FIRST_PAUSE_NS = 50_000
MAX_PAUSE_NS = 1_000_000
"""Maximum pause between two polls for a reply; the pause doubles from FIRST_PAUSE_NS."""
MAX_UNSOLICITED = 16
"""Limit for unsolicited messages read in one poll."""


class Unsolicited(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Unsolicited message of a slave: emergency, notification, Ethernet fragment."""

    station: int
    type: MailboxType
    data: bytes
    """Message without mailbox header."""


Report: TypeAlias = Callable[[Unsolicited], None]
Forward: TypeAlias = Callable[[int, int, MailboxType, bytes, int], bool | None]
"""Forwards a message: source, address, type, data, time; None if it is for no other slave."""


class MailboxStats(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of a slave's mailbox; times in nanoseconds."""

    sent: int
    received: int
    timeouts: int
    unanswered: int
    """Requests without a reply since the last reset: time-outs without those of listening."""
    unanswered_ns: int | None
    """Time of the last of them."""
    errors: int
    """Requests that ended in another error than a time-out."""
    last_error: str
    repeats: int
    """Repeat requests, each after a lost reply."""
    duplicates: int
    """Messages dropped because their counter is that of the message before."""
    gaps: int
    """Gaps in the slave's counter."""
    late: int
    """Messages without a request, because the request had timed out."""
    unsolicited: int
    malformed: int
    forwarded: int
    """Messages of this slave that went to other slaves."""
    forward_dropped: int
    """Messages from or to this slave that could not be forwarded."""
    latency_ns: int
    """Latency of the last request, from its start to its reply."""
    mean_latency_ns: int
    max_latency_ns: int


class RequestCounters:
    """Counters of requests and messages, without those of MailboxPort."""

    __slots__ = (
        "answered",
        "errors",
        "forward_dropped",
        "forwarded",
        "last_error",
        "last_ns",
        "late",
        "malformed",
        "max_ns",
        "received",
        "sent",
        "timeouts",
        "total_ns",
        "unanswered",
        "unanswered_ns",
        "unsolicited",
    )  # fmt: skip

    def __init__(self) -> None:
        self.sent = self.received = self.timeouts = self.errors = 0
        self.late = self.unsolicited = self.malformed = 0
        self.forwarded = self.forward_dropped = 0
        self.answered = self.last_ns = self.max_ns = self.total_ns = 0
        self.last_error = ""
        self.unanswered = 0
        self.unanswered_ns: int | None = None

    def forget_unanswered(self) -> None:
        """Reset the requests without a reply, and the late replies."""
        self.unanswered = self.late = 0
        self.unanswered_ns = None

    def miss(self, now_ns: int) -> None:
        """Count a request without a reply."""
        self.unanswered += 1
        self.unanswered_ns = now_ns

    def answer(self, latency_ns: int) -> None:
        """Count an answered request."""
        self.answered += 1
        self.last_ns = latency_ns
        self.total_ns += latency_ns
        self.max_ns = max(self.max_ns, latency_ns)

    def fail(self, error: EapError) -> None:
        """Count a failed request."""
        if isinstance(error, MailboxTimeoutError):
            self.timeouts += 1
        else:
            self.errors += 1
        self.last_error = str(error)

    def stats(self, *, repeats: int, duplicates: int, gaps: int) -> MailboxStats:
        """Return a snapshot, with the counters of the port."""
        return MailboxStats(
            sent=self.sent,
            received=self.received,
            timeouts=self.timeouts,
            unanswered=self.unanswered,
            unanswered_ns=self.unanswered_ns,
            errors=self.errors,
            last_error=self.last_error,
            repeats=repeats,
            duplicates=duplicates,
            gaps=gaps,
            late=self.late,
            unsolicited=self.unsolicited,
            malformed=self.malformed,
            forwarded=self.forwarded,
            forward_dropped=self.forward_dropped,
            latency_ns=self.last_ns,
            mean_latency_ns=self.total_ns // self.answered if self.answered else 0,
            max_latency_ns=self.max_ns,
        )


class Mailbox:
    """Open mailbox of a slave in PREOP, SAFEOP, OP or BOOT.

    Args:
        station: Station address of the slave.
        area: Addresses and sizes of its mailbox sync managers.
        runner: Runner of its procedures.
        report: Called with unsolicited messages.
        forward: Called with messages to other stations.
    """

    def __init__(
        self,
        station: int,
        area: MailboxArea,
        runner: Runner,
        report: Report,
        forward: Forward = lambda *_: None,
    ) -> None:
        self.station = station
        self.sizes = MailboxSizes(area.to_slave_size, area.to_master_size)
        self._port = MailboxPort(station, area)
        self._runner = runner
        self._report = report
        self._queue = ConversationQueue()
        self._forward = forward
        self._forwards = ForwardQueue()
        self._watch = CounterCheck()
        self._counter = 0
        self._work: Task[None] | None = None
        self._is_busy = False
        self._is_open = True
        self._counters = RequestCounters()

    def converse(
        self,
        conversation: Conversation[T],
        now_ns: int,
        *,
        name: str = "a request",
        requester: Hashable = None,
        timeout_ns: int | None = None,
    ) -> Task[T]:
        """Start a conversation; requesters of the same protocol alternate.

        *timeout_ns* replaces the time-outs of its requests.
        """
        task: Task[T]
        try:
            step = next(conversation)
        except (StopIteration, EapError) as end:
            task = Task(name, conversation.close)
            if isinstance(end, EapError):
                task.fail(end)
            else:
                task.finish(end.value)
            return task
        where = f"slave {self.station}: {name}"
        job = QueuedConversation(conversation, step, where, requester, timeout_ns)
        problem = self._check_step(step, job.task.name)
        if problem is not None:
            conversation.close()
            job.task.fail(problem)
            return job.task
        job.ready_ns = now_ns + step.delay_ns
        self._queue.add(job)
        self._begin(self._serve(), now_ns)
        return job.task

    def post(self, source: int, kind: MailboxType, data: bytes, now_ns: int) -> bool:
        """Write a message of another slave as soon as this one takes it; False if it cannot be."""
        message = ForwardedMessage(source, kind, data, now_ns + FORWARD_LIMIT_NS)
        fits = MailboxHeader.SIZE + len(data) <= self.sizes.to_slave
        if not (self._is_open and fits and self._forwards.add(message)):
            return False
        self._begin(self._serve(), now_ns)
        return True

    @property
    def is_busy(self) -> bool:
        """True while a request or a poll runs."""
        return self._is_busy

    def poll(self, now_ns: int) -> None:
        """Read unsolicited messages, unless a request or a poll runs."""
        if self._is_open:
            self._begin(self._poll(), now_ns)

    def close(self) -> None:
        """Close the mailbox; its conversations fail."""
        self._is_open = False
        if self._work is not None:
            self._work.cancel()
        self._queue.fail_all("the slave's mailbox was closed, for it is set up anew")

    def forget_unanswered(self) -> None:
        """Reset the requests without a reply, and the late replies."""
        self._counters.forget_unanswered()

    def stats(self) -> MailboxStats:
        """Return a snapshot of the counters."""
        return self._counters.stats(
            repeats=self._port.repeats, duplicates=self._watch.repeated, gaps=self._watch.gaps
        )

    def _check_step(self, step: MailboxRequest, name: str) -> BusError | None:
        """Return the error of a request that cannot be sent, or None."""
        if not self._is_open:
            return MailboxClosedError(f"{name}: the slave's mailbox is closed")
        size = MailboxHeader.SIZE + len(step.request)
        if step.listen or size <= self.sizes.to_slave:
            return None
        return MailboxSizeError(
            f"{name}: a message of {size} bytes, the slave's mailbox holds {self.sizes.to_slave}"
        )

    def _begin(self, work: Procedure[None], now_ns: int) -> None:
        if not self._is_busy:
            self._is_busy = True
            self._work = self._runner.start(work, now_ns, f"slave {self.station}: its mailbox")

    def _serve(self) -> Procedure[None]:
        """Serve conversations and forwarded messages until none is left."""
        try:
            _, now_ns = yield Sleep(0)
            while (ready_ns := self._next_ready(now_ns)) is not None:
                yield from self._deliver()
                job = self._queue.next_job(now_ns)
                if job is None:
                    _, now_ns = yield Sleep(min(ready_ns - now_ns, MAX_PAUSE_NS))
                else:
                    now_ns = yield from self._serve_one(job)
        finally:
            self._is_busy = False

    def _next_ready(self, now_ns: int) -> int | None:
        """Return the time of the next work; None without any."""
        if self._forwards.first is not None:
            return now_ns + MAX_PAUSE_NS
        return self._queue.next_ready()

    def _deliver(self) -> Procedure[None]:
        """Write the messages of other slaves that wait, as far as the slave takes them."""
        while self._forwards.first is not None:
            if not (yield from self._write_first()):
                # A slave whose mailbox is full may not read requests: empty it first.
                with suppress(EapError):
                    if (yield from self._port.is_full()):
                        yield from self._receive(None)
                return

    def _write_first(self) -> Procedure[bool]:
        """Write the first message of another slave; return False if it has to wait."""
        message = self._forwards.first
        if message is None:
            return True
        self._counter = next_counter(self._counter)
        header = MailboxHeader(0, message.source, type=message.type, counter=self._counter)
        octets = encode_message(header, message.data)
        is_written = False
        with suppress(EapError):  # counted when its time is over
            written = yield from self._write_message(octets, message.deadline_ns)
            is_written = written.is_accepted or written.is_ambiguous
        _, now_ns = yield Sleep(0)
        if not is_written and now_ns < message.deadline_ns:
            return False
        self._forwards.end_first(is_written=is_written)
        self._counters.forward_dropped += not is_written
        return True

    def _poll(self) -> Procedure[None]:
        """Read waiting messages, then serve conversations that were started meanwhile."""
        with suppress(EapError):  # the next request to a lost slave reports the error
            for _ in range(MAX_UNSOLICITED):
                if not (yield from self._port.is_full()):
                    break
                yield from self._receive(None)
        yield from self._serve()

    def _serve_one(self, job: QueuedConversation) -> Procedure[int]:
        """Execute one step of a conversation and resume it; return the time."""
        step = job.step
        if job.timeout_ns is not None:
            step = replace(step, timeout_ns=job.timeout_ns)
        _, start_ns = yield Sleep(0)
        error: EapError | None = None
        message = MailboxMessage(step.type, b"")
        try:
            message = yield from self._exchange(step, start_ns + step.timeout_ns)
        except EapError as exc:
            # The text of a lost frame names a register, and no slave.
            is_lost = isinstance(exc, FrameLostError)
            error = FrameLostError(f"slave {self.station}: {exc}") if is_lost else exc
            self._counters.fail(error)
            if isinstance(exc, MailboxTimeoutError) and not step.listen:
                self._queue.matcher(step.type).expire(step)
                _, now_ns = yield Sleep(0)
                self._counters.miss(now_ns)
        _, now_ns = yield Sleep(0)
        if error is None:
            self._counters.answer(now_ns - start_ns)
            answer = replace(message, at_ns=now_ns)
            _resume(job, lambda: job.conversation.send(answer), now_ns)
        else:
            reason = error
            _resume(job, lambda: job.conversation.throw(reason), now_ns)
        return now_ns

    def _exchange(self, step: MailboxRequest, deadline_ns: int) -> Procedure[MailboxMessage]:
        problem = self._check_step(step, f"slave {self.station}")
        if problem is not None:
            raise problem
        if step.listen:
            stored = self._queue.matcher(step.type).take_stored(step)
            if stored is not None:
                return MailboxMessage(step.type, stored)
        else:
            early = yield from self._send(step, deadline_ns)
            if early is not None:
                return early
            if not step.expects_reply:
                self._queue.matcher(step.type).note_part(step.request)
                return MailboxMessage(step.type, b"")
        pause_ns = FIRST_PAUSE_NS
        is_full = True  # a quick slave has answered already: read before the first poll
        while True:
            reply = (yield from self._receive(step)) if is_full else None
            if reply is not None:
                return reply
            _, now_ns = yield Sleep(pause_ns)
            if now_ns >= deadline_ns:
                raise self._timeout(step, "")
            pause_ns = min(2 * pause_ns, MAX_PAUSE_NS)
            if self._forwards.first is not None:  # the slave may need it for its reply
                yield from self._write_first()
            is_full = yield from self._is_full(deadline_ns)

    def _send(self, step: MailboxRequest, deadline_ns: int) -> Procedure[MailboxMessage | None]:
        """Write a request; return its reply if it came during a repetition of the write."""
        # The counter stays the same for all attempts: the slave drops a repeated one, so that a
        # request is executed once although its frame was lost.
        self._counter = next_counter(self._counter)
        address = self._queue.matcher(step.type).next_address()
        header = MailboxHeader(0, address, type=step.type, counter=self._counter)
        message = encode_message(header, step.request)
        maybe_there = False
        while True:
            written = yield from self._write_message(message, deadline_ns)
            if written.is_accepted:
                self._counters.sent += 1
                return None
            maybe_there = maybe_there or written.is_ambiguous
            # A slave whose reply mailbox is full may not read requests: empty it first.
            if (yield from self._is_full(deadline_ns)):
                reply = yield from self._receive(step if maybe_there else None)
                if reply is not None:
                    return reply
            _, now_ns = yield Sleep(MAX_PAUSE_NS)
            if now_ns >= deadline_ns:
                raise self._timeout(step, ": its mailbox is still full, the slave does not read it")

    def _timeout(self, step: MailboxRequest, why: str) -> MailboxTimeoutError:
        limit_ms = step.timeout_ns // 1_000_000
        return MailboxTimeoutError(
            f"slave {self.station}: no {step.type.name} reply within {limit_ms} ms{why}"
        )

    def _write_message(self, message: bytes, deadline_ns: int) -> Procedure[WriteResult]:
        """Write a request; retry while no frame comes back."""
        was_silent = False
        while True:
            try:
                written = yield from self._port.write_message(message)
            except FrameLostError:
                was_silent = True
                _, now_ns = yield Sleep(MAX_PAUSE_NS)
                if now_ns >= deadline_ns:
                    raise
            else:
                return written._replace(is_ambiguous=written.is_ambiguous or was_silent)

    def _is_full(self, deadline_ns: int) -> Procedure[bool]:
        """Return true if the slave has a message; retry while no frame comes back."""
        while True:
            try:
                return (yield from self._port.is_full())
            except FrameLostError:
                _, now_ns = yield Sleep(MAX_PAUSE_NS)
                if now_ns >= deadline_ns:
                    raise

    def _receive(self, step: MailboxRequest | None) -> Procedure[MailboxMessage | None]:
        """Read one message; return it if it is the reply to *step*."""
        octets = yield from self._port.read_message()
        if octets is None:
            return None
        self._counters.received += 1
        try:
            header, body = decode_message(octets)
        except CodecError:
            self._counters.malformed += 1
            return None
        data = bytes(body)
        # After a repeat request the slave may send a message that has arrived all the same.
        if not self._watch.is_new(header.counter) or (
            header.address and (yield from self._forward_to(header.address, header.type, data))
        ):
            return None
        if step is not None and self._queue.matcher(step.type).answers(header, data, step):
            if header.type == MailboxType.ERR:
                raise self._mailbox_error(data)
            self._queue.matcher(step.type).note_part(data)
            return MailboxMessage(header.type, data, counter=header.counter)
        if not self._queue.matcher(header.type).store(data):
            yield from self._handle_other(header.type, data)
        return None

    def _handle_other(self, kind: MailboxType, data: bytes) -> Procedure[None]:
        """Handle a message that answers no request of the master."""
        source = self._forwards.take_source(kind, data)
        if source is not None and (yield from self._forward_to(source, kind, data)):
            return
        if is_unsolicited(kind, data):
            self._counters.unsolicited += 1
            self._report(Unsolicited(self.station, kind, data))
        else:
            self._counters.late += 1

    def _forward_to(self, address: int, kind: MailboxType, data: bytes) -> Procedure[bool]:
        """Forward a message to another slave; return False if the address is that of none."""
        _, now_ns = yield Sleep(0)
        is_forwarded = self._forward(self.station, address, kind, data, now_ns)
        if is_forwarded is None:
            return False
        self._counters.forwarded += is_forwarded
        self._counters.forward_dropped += not is_forwarded
        if is_forwarded:
            self._forwards.take_source(kind, data)  # a reply with the address echoed
        return True

    def _mailbox_error(self, data: bytes) -> EapError:
        try:
            detail = MailboxErrorReply.decode(data).detail
        except CodecError:
            return MailboxProtocolError(
                f"slave {self.station}: a mailbox error of {len(data)} bytes, expected 4"
            )
        return MailboxRefusedError(
            f"slave {self.station}: mailbox error {MailboxError.text_of(detail)}", detail=detail
        )


def _resume(job: QueuedConversation, action: Callable[[], MailboxRequest], now_ns: int) -> None:
    """Resume a conversation, unless it was cancelled meanwhile."""
    if job.task.is_done:
        return
    try:
        job.step = action()
    except StopIteration as end:
        job.task.finish(end.value)
    except EapError as error:
        job.task.fail(error)
    except OSError as exc:  # raised by the file that the conversation reads or writes
        job.task.fail(BusError(f"{job.task.name}: {exc}"))
    else:
        job.ready_ns = now_ns + job.step.delay_ns
