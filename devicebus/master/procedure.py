"""Procedure: an action of the master, written as a generator; :mod:`runner` runs it.

    def read_twice(station: int) -> Procedure[bytes]:
        first = yield from read(station, Register.TYPE, 1)
        yield Sleep(1_000_000)
        (reply,), now_ns = yield [fprd(station, Register.TYPE, 1)]
        return first + reply.data

A procedure yields accesses that are answered together, or a Sleep.  It has FrameLostError thrown
in when frames do not come back, and is closed to cancel it.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import Generic, NamedTuple, TypeAlias, TypeVar

from devicebus.errors import FrameLostError, WorkingCounterError
from devicebus.master.access import AS_SET, DatagramReply, DatagramRequest, fprd, fpwr
from eap.errors import EapError

T = TypeVar("T")


class Sleep(NamedTuple):
    """Resume after this long."""

    duration_ns: int


class StepReplies(NamedTuple):
    """Value that a procedure is resumed with: one reply for each access, and the time."""

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
        FrameLostError: nothing came back.
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
    """Run procedures in step, so that their accesses share frames.

    Returns what each returned, or the error that ended it.

    Raises:
        FrameLostError: nothing comes back, which says nothing about any slave.
    """
    _, now_ns = yield Sleep(0)
    children = [_Child(procedure, now_ns) for procedure in procedures]
    try:
        while running := [child for child in children if child.is_running]:
            asking = [child for child in running if child.accesses]
            if asking:
                now_ns = yield from _ask_for(asking)
            else:
                pause_ns = min(child.wake_ns for child in running) - now_ns
                _, now_ns = yield Sleep(pause_ns)
            for child in running:
                if not child.accesses and child.is_running and child.wake_ns <= now_ns:
                    child.resume(StepReplies((), now_ns))
    finally:
        for child in children:
            child.procedure.close()
    return [child.result for child in children]


class _Child(Generic[T]):
    """One of several procedures that run in step."""

    def __init__(self, procedure: Procedure[T], now_ns: int) -> None:
        self.procedure = procedure
        self.is_running = True
        self.result: T | EapError
        self.accesses: Sequence[DatagramRequest] = ()
        self.wake_ns = 0
        self._advance(lambda: next(procedure), now_ns)

    def resume(self, answer: StepReplies) -> None:
        self._advance(lambda: self.procedure.send(answer), answer.now_ns)

    def _advance(self, action: Callable[[], Step], now_ns: int) -> None:
        self.accesses = ()
        try:
            step = action()
        except StopIteration as end:
            self.is_running, self.result = False, end.value
        except FrameLostError:
            self.is_running = False
            raise
        except EapError as error:
            self.is_running, self.result = False, error
        else:
            if isinstance(step, Sleep):
                self.wake_ns = now_ns + step.duration_ns
            else:
                self.accesses = step


def _ask_for(asking: Sequence[_Child[T]]) -> Procedure[int]:
    """Send what the children want and tell them what came back; return the time."""
    replies, now_ns = yield [access for child in asking for access in child.accesses]
    start = 0
    for child in asking:
        end = start + len(child.accesses)
        child.resume(StepReplies(replies[start:end], now_ns))
        start = end
    return now_ns
