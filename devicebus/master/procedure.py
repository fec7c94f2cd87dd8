"""Procedure: action of the master, written as a generator; :class:`Runner` runs it as a Task.

    def read_twice(station: int) -> Procedure[bytes]:
        first = yield from read(station, Register.TYPE, 1)
        yield Sleep(1_000_000)
        (reply,), now_ns = yield [fprd(station, Register.TYPE, 1)]
        return first + reply.data

A procedure yields datagrams, whose replies come together, or a Sleep.  FrameLostError is thrown
into it when frames do not come back; closing the generator cancels it.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable, Generator, Sequence
from functools import partial
from itertools import count
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

from devicebus.errors import BusError, FrameLostError, WorkingCounterError
from devicebus.master.link import Exchange, Link
from devicebus.wire.datagram import AS_SET, DatagramReply, DatagramRequest, fprd, fpwr
from eap.errors import EapError

T = TypeVar("T")


def _do_nothing() -> None:
    """Stop function of a task that has ended."""


class Task(Generic[T]):
    """Running procedure or conversation.

    Args:
        name: Name for messages.
        stop: Stops the procedure or conversation, for :meth:`cancel`.
    """

    def __init__(self, name: str, stop: Callable[[], None]) -> None:
        self.name = name
        self.error: EapError | None = None
        self._stop = stop
        self._value: list[T] = []
        self._watchers: list[Callable[[Task[T]], None]] = []

    @property
    def is_done(self) -> bool:
        """True once there is a result or an error."""
        return bool(self._value) or self.error is not None

    def result(self) -> T:
        """Return the result, or raise the error of the task.

        Raises:
            BusError: the task still runs, or was cancelled.
        """
        if self.error is not None:
            raise self.error
        if not self._value:
            raise BusError(f"{self.name} is not done yet")
        return self._value[0]

    def watch(self, callback: Callable[[Task[T]], None]) -> None:
        """Call *callback* at the end of the task, at once if it has ended."""
        if self.is_done:
            callback(self)
        else:
            self._watchers.append(callback)

    def cancel(self) -> None:
        """Cancel the task: nothing more is sent for it.  No effect on an ended task."""
        if not self.is_done:
            self._stop()
            self.fail(BusError(f"{self.name} was cancelled"))

    def finish(self, value: T) -> None:
        """Set the result; called by the runner."""
        self._value.append(value)
        self._notify_watchers()

    def fail(self, error: EapError) -> None:
        """Set the error; called by the runner."""
        self.error = error
        self._notify_watchers()

    def _notify_watchers(self) -> None:
        self._stop = _do_nothing  # breaks the reference cycle between the task and its procedure
        watchers, self._watchers = self._watchers, []
        for callback in watchers:
            callback(self)


class Alarm:
    """Ends a pause before its time."""

    def __init__(self) -> None:
        self._hasten: Callable[[int], None] | None = None

    def arm(self, hasten: Callable[[int], None]) -> None:
        """Call *hasten* with the new end of the pause from now on; called by the runner."""
        self._hasten = hasten

    def ring(self, at_ns: int) -> None:
        """End the pause at *at_ns*, unless it ends before."""
        if self._hasten is not None:
            self._hasten(at_ns)


class Sleep(NamedTuple):
    """Pause of a procedure, which *alarm* may shorten."""

    duration_ns: int
    alarm: Alarm | None = None


class StepReplies(NamedTuple):
    """Result of a step: one reply for each datagram, and the time."""

    replies: Sequence[DatagramReply]
    now_ns: int


Step: TypeAlias = Sequence[DatagramRequest] | Sleep
Procedure: TypeAlias = Generator[Step, StepReplies, T]


def read(
    station: int, ado: int, size: int, what: str = "", *, tries: int = AS_SET
) -> Procedure[bytes]:
    """Read registers or memory of one slave.

    Raises:
        WorkingCounterError: the slave did not answer.
        FrameLostError: no frame came back.
    """
    (reply,), _ = yield [fprd(station, ado, size, tries=tries)]
    if reply.wkc != 1:
        raise not_answered(f"slave {station}: reading {what or hex(ado)}", reply)
    return reply.data


def write(
    station: int, ado: int, data: bytes, what: str = "", *, tries: int = AS_SET
) -> Procedure[None]:
    """Write registers or memory of one slave; raises as :func:`read` does."""
    (reply,), _ = yield [fpwr(station, ado, data, tries=tries)]
    if reply.wkc != 1:
        raise not_answered(f"slave {station}: writing {what or hex(ado)}", reply)


def not_answered(what: str, reply: DatagramReply) -> WorkingCounterError:
    """Return the error of a datagram that exactly one slave should have answered."""
    text = f"{what}: working counter {reply.wkc}, expected 1"
    return WorkingCounterError(text, expected=1, received=reply.wkc)


def together(procedures: Sequence[Procedure[T]]) -> Procedure[list[T | EapError]]:
    """Run procedures in lockstep, so that their datagrams share frames.

    Returns the result of each procedure, or the error that ended it.

    Raises:
        FrameLostError: no frame comes back, which gives no information about any slave.
    """
    _, now_ns = yield Sleep(0)
    children = [_Child(procedure, now_ns) for procedure in procedures]
    try:
        while running := [child for child in children if child.is_running]:
            waiting = [child for child in running if child.datagrams]
            # Datagrams go first: a pause would delay the procedures that only wait for a reply.
            if waiting:
                now_ns = yield from _exchange_step(waiting)
            else:
                pause_ns = min(child.wake_ns for child in running) - now_ns
                _, now_ns = yield Sleep(pause_ns)
            for child in running:
                if not child.datagrams and child.is_running and child.wake_ns <= now_ns:
                    child.resume(StepReplies((), now_ns))
    finally:
        for child in children:
            child.procedure.close()
    return [child.result for child in children]


class _Child(Generic[T]):
    """One of several procedures that run in lockstep."""

    def __init__(self, procedure: Procedure[T], now_ns: int) -> None:
        self.procedure = procedure
        self.is_running = True
        self.result: T | EapError
        self.datagrams: Sequence[DatagramRequest] = ()
        self.wake_ns = 0
        self._advance(lambda: next(procedure), now_ns)

    def resume(self, answer: StepReplies) -> None:
        self._advance(lambda: self.procedure.send(answer), answer.now_ns)

    def _advance(self, action: Callable[[], Step], now_ns: int) -> None:
        self.datagrams = ()
        try:
            step = action()
        except StopIteration as end:
            self.is_running, self.result = False, end.value
        except FrameLostError:
            # A lost frame says nothing about one slave: it ends all children.
            self.is_running = False
            raise
        except EapError as error:
            self.is_running, self.result = False, error
        else:
            if isinstance(step, Sleep):
                self.wake_ns = now_ns + step.duration_ns
            else:
                self.datagrams = step


def _exchange_step(waiting: Sequence[_Child[T]]) -> Procedure[int]:
    """Send the datagrams of the children and resume them with the replies; return the time."""
    replies, now_ns = yield [datagram for child in waiting for datagram in child.datagrams]
    start = 0
    for child in waiting:
        end = start + len(child.datagrams)
        child.resume(StepReplies(replies[start:end], now_ns))
        start = end
    return now_ns


class Runner:
    """Runner of concurrent procedures over one link."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._sleeping: list[tuple[int, int, _Run, int]] = []
        """End, order, and number of the pause of a run; an earlier pause of it has ended."""
        self._number = count()

    def start(self, procedure: Procedure[T], now_ns: int, name: str = "a procedure") -> Task[T]:
        """Start a procedure; its first datagrams are queued at once."""
        run = _Run(procedure, self)
        run.task = Task(name, run.stop)
        run.advance(lambda: next(procedure), now_ns)
        return run.task

    def next_timeout(self) -> int | None:
        """Return the end of the next pause."""
        sleeping = self._sleeping
        while sleeping and not sleeping[0][2].is_pausing(sleeping[0][3]):
            heapq.heappop(sleeping)
        return sleeping[0][0] if sleeping else None

    def handle_timeout(self, now_ns: int) -> None:
        """Resume the procedures whose pause has ended."""
        while self._sleeping and self._sleeping[0][0] <= now_ns:
            _, _, run, pause = heapq.heappop(self._sleeping)
            if run.is_pausing(pause):
                run.resume(StepReplies((), now_ns))

    def queue_step(self, run: _Run, step: Step, now_ns: int) -> None:
        """Queue the next step of a procedure."""
        if isinstance(step, Sleep):
            run.pause += 1
            self._pause(run, run.pause, now_ns + step.duration_ns)
            if step.alarm is not None:
                step.alarm.arm(partial(self._pause, run, run.pause))
        else:
            run.exchange = self._link.submit(step, run.handle_replies)

    def _pause(self, run: _Run, pause: int, until_ns: int) -> None:
        """Resume *run* at *until_ns*, unless its pause has ended before."""
        self._link.end_quiet()  # the quiet time may not last until then
        heapq.heappush(self._sleeping, (until_ns, next(self._number), run, pause))


class _Run:
    """Running procedure with its pending step.

    Attributes:
        pause: Number of its last pause.
    """

    __slots__ = ("_procedure", "_runner", "exchange", "pause", "task")

    def __init__(self, procedure: Procedure[Any], runner: Runner) -> None:
        self.task: Task[Any]
        self.exchange: Exchange | None = None
        self.pause = 0
        self._procedure = procedure
        self._runner = runner

    def handle_replies(self, outcome: list[DatagramReply] | FrameLostError, now_ns: int) -> None:
        """Resume the procedure with the replies of the link, or with its error."""
        self.exchange = None
        if isinstance(outcome, FrameLostError):
            error = outcome
            self.advance(lambda: self._procedure.throw(error), now_ns)
        else:
            self.resume(StepReplies(outcome, now_ns))

    def is_pausing(self, pause: int) -> bool:
        """Return whether the pause with this number lasts."""
        return pause == self.pause and not self.task.is_done

    def resume(self, answer: StepReplies) -> None:
        """Resume the procedure with the result of its step."""
        self.pause += 1  # an alarm may have left another end of the same pause
        self.advance(lambda: self._procedure.send(answer), answer.now_ns)

    def advance(self, action: Callable[[], Step], now_ns: int) -> None:
        """Run the procedure to its next step or its end; a Sleep of 0 resumes it at once."""
        try:
            step = action()
            while isinstance(step, Sleep) and step.duration_ns <= 0:
                step = self._procedure.send(StepReplies((), now_ns))
        except StopIteration as end:
            self.task.finish(end.value)
        except EapError as error:
            self.task.fail(error)
        else:
            self._runner.queue_step(self, step, now_ns)

    def stop(self) -> None:
        """Close the procedure and drop its step."""
        if self.exchange is not None:
            self.exchange.cancel()
        self._procedure.close()
