"""Runs procedures side by side over one link."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count
from typing import Any, TypeVar

from devicebus.errors import FrameLostError
from devicebus.master.access import DatagramReply
from devicebus.master.link import Exchange, Link
from devicebus.master.procedure import Procedure, Sleep, Step, StepReplies
from devicebus.master.task import Task
from eap.errors import EapError

T = TypeVar("T")


class Runner:
    """Starts procedures, hands them what the link brings, and wakes them in time."""

    def __init__(self, link: Link) -> None:
        self._link = link
        self._sleeping: list[tuple[int, int, _Run]] = []
        self._number = count()

    def start(self, procedure: Procedure[T], now_ns: int, name: str = "a procedure") -> Task[T]:
        """Run a procedure; its first accesses are queued at once."""
        run = _Run(procedure, self)
        run.task = Task(name, run.stop)
        run.advance(lambda: next(procedure), now_ns)
        return run.task

    def next_timeout(self) -> int | None:
        """Return the time at which the next sleeper wakes."""
        while self._sleeping and self._sleeping[0][2].task.is_done:
            heapq.heappop(self._sleeping)
        return self._sleeping[0][0] if self._sleeping else None

    def handle_timeout(self, now_ns: int) -> None:
        """Resume sleepers that are due."""
        while self._sleeping and self._sleeping[0][0] <= now_ns:
            _, _, run = heapq.heappop(self._sleeping)
            if not run.task.is_done:
                run.resume(StepReplies((), now_ns))

    def take_step(self, run: _Run, step: Step, now_ns: int) -> None:
        """Queue the next step of a procedure."""
        if isinstance(step, Sleep):
            entry = (now_ns + step.duration_ns, next(self._number), run)
            heapq.heappush(self._sleeping, entry)
        else:
            run.exchange = self._link.submit(step, run.take)


class _Run:
    """One procedure that runs."""

    __slots__ = ("_procedure", "_runner", "exchange", "task")

    def __init__(self, procedure: Procedure[Any], runner: Runner) -> None:
        self.task: Task[Any]
        self.exchange: Exchange | None = None
        self._procedure = procedure
        self._runner = runner

    def take(self, outcome: list[DatagramReply] | FrameLostError, now_ns: int) -> None:
        """The link has answered."""
        self.exchange = None
        if isinstance(outcome, FrameLostError):
            error = outcome
            self.advance(lambda: self._procedure.throw(error), now_ns)
        else:
            self.resume(StepReplies(outcome, now_ns))

    def resume(self, answer: StepReplies) -> None:
        """Resume the procedure with the result of its step."""
        self.advance(lambda: self._procedure.send(answer), answer.now_ns)

    def advance(self, action: Callable[[], Step], now_ns: int) -> None:
        """Run it up to its next step, or to its end; sleeps of no length are none."""
        try:
            step = action()
            while isinstance(step, Sleep) and step.duration_ns <= 0:
                step = self._procedure.send(StepReplies((), now_ns))
        except StopIteration as end:
            self.task.finish(end.value)
        except EapError as error:
            self.task.fail(error)
        else:
            self._runner.take_step(self, step, now_ns)

    def stop(self) -> None:
        """Close the procedure and drop its step."""
        if self.exchange is not None:
            self.exchange.cancel()
        self._procedure.close()
