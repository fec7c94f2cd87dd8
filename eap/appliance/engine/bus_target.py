"""Bringing one slave, or all of a bus, to a state while the bus runs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

from devicebus.errors import BusError
from devicebus.master.bus import Unit
from devicebus.master.findings import join_errors
from devicebus.master.master import Master
from devicebus.master.task import Task
from devicebus.wire.alstatus import AlState
from eap.errors import EapError

_WITH_PROCESS_DATA = frozenset((AlState.SAFEOP, AlState.OP))


def bring_one(master: Master, station: int, target: AlState, now_ns: int) -> Task[None]:
    """Bring one slave to *target*, where it is kept.

    Raises:
        BusError: there is no such slave, it is on its way somewhere, or the bus has no process
            data yet.
    """
    if target in _WITH_PROCESS_DATA and master.cycle is None and station in master.units:
        raise BusError(
            f"slave {station}: the process data of this bus is not laid out, for its slaves never"
            f" were beyond PREOP: bring all of them to {target.name} at once"
        )
    return master.request_state(station, target, now_ns)


def bring_all(master: Master, target: AlState, now_ns: int) -> Task[None]:
    """Bring all slaves to *target*, where they are kept; done when the last one is.

    Raises BusError if no slaves are known.
    """
    units = list(master.units.values())
    if not units:
        raise BusError("the bus is not up: no slave is known")
    if target in _WITH_PROCESS_DATA and master.cycle is None:
        return master.bring_up(now_ns, target)
    return _Together(master, units, target, now_ns).task


class _Together:
    """Waits for all slaves of a bus."""

    def __init__(self, master: Master, units: Sequence[Unit], target: AlState, now_ns: int) -> None:
        self.task: Task[None] = Task(f"bringing all slaves to {target.name}", self._stop)
        self._missing = len(units)
        self._errors: list[tuple[str, EapError]] = []
        self._tasks: list[Task[None]] = []
        for unit in units:
            try:
                task = master.request_state(unit.station, target, now_ns)
            except BusError as exc:
                self._end(f"{unit.name} ({unit.station})", exc)
            else:
                self._tasks.append(task)
                task.watch(partial(self._take, f"{unit.name} ({unit.station})"))

    def _take(self, name: str, task: Task[None]) -> None:
        self._end(name, task.error)

    def _end(self, name: str, error: EapError | None) -> None:
        self._missing -= 1
        if error is not None:
            self._errors.append((name, error))
        if self._missing or self.task.is_done:
            return
        if not self._errors:
            self.task.finish(None)
        else:
            self.task.fail(join_errors(self._errors))

    def _stop(self) -> None:
        for task in self._tasks:
            task.cancel()
