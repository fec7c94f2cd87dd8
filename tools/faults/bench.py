"""A master and a simulated segment in one process, on a clock that is only a number.

Nothing here waits or looks at a clock, so every run gives the same to the nanosecond.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count
from typing import TypeVar

import msgspec

from devicebus.master.bus import Event, MasterSettings
from devicebus.master.master import Master
from devicebus.master.procedure import Task
from devicebus.sim.devices.build import build_segment
from devicebus.sim.fault import FaultySegment
from devicebus.sim.spec import BusSpec, FaultSpec
from devicebus.wire.alstatus import AlState

T = TypeVar("T")

US, MS = 1_000, 1_000_000
CYCLE_NS = MS
TRIP_NS = 20 * US
"""Delay of a frame on the line."""
WATCHDOG_MS = 100
STATIONS = (1001, 1002, 1003, 1004)
_STEP_NS = 10 * US
"""The shortest step of the clock."""
_UP_WITHIN_NS = 5_000 * MS
_SETTLED_NS = 200 * MS

BUS = {
    "bus": "faults",
    "slaves": [
        {"name": "coupler", "kind": "coupler"},
        {"name": "island", "kind": "digital",
         "inputs": [{"name": "limit"}], "outputs": [{"name": "valve"}]},
        {"name": "drive", "kind": "drive", "clock": {"drift_ppm": 20},
         "mailbox": {"size": 256, "foe": True, "soe": True}, "files": [{"name": "firmware.bin"}]},
        {"name": "plain", "kind": "digital", "mailbox": None,
         "inputs": [{"name": "in"}], "outputs": [{"name": "out"}]},
    ],
}  # fmt: skip


class Bench:
    """Four slaves in a line, and a master that runs a cycle every millisecond.

    Attributes:
        now_ns: The time.
        events: What the master has told, oldest first.
    """

    def __init__(self) -> None:
        self.segment = FaultySegment(build_segment(msgspec.convert(BUS, BusSpec)))
        self.master = Master(MasterSettings(watchdog_ms=WATCHDOG_MS, clocks=True))
        self.now_ns = self._next_cycle_ns = 1_000 * MS
        self.events: list[Event] = []
        self._inbox: list[tuple[int, int, bytearray]] = []
        self._order = count()
        self.wait(self.master.bring_up(self.now_ns), _UP_WITHIN_NS)
        self.run_until(self.now_ns + _SETTLED_NS)
        self._whole_wkc = self._expected_wkc()

    @property
    def is_well(self) -> bool:
        """True if every slave is in OP, known to the master and exchanging process data."""
        return (
            all(slave.state is AlState.OP for slave in self.segment.segment.slaves)
            and all(unit.missing_since_ns is None for unit in self.master.slaves.values())
            and self._expected_wkc() == self._whole_wkc
        )

    def _expected_wkc(self) -> int:
        cycle = self.master.cycle
        return cycle.stats().expected_wkc if cycle is not None else -1

    def begin(self, fault: FaultSpec) -> None:
        """Let a fault begin."""
        self.segment.begin(fault, self.now_ns)

    def wait(self, task: Task[T], limit_ns: int) -> T:
        """Run until *task* is done; return its result or raise its error.

        Raises:
            TimeoutError: it is not done after *limit_ns*.
        """
        self.run_until(self.now_ns + limit_ns, lambda: task.is_done)
        if not task.is_done:
            raise TimeoutError(f"{task.name} still runs after {limit_ns // MS} ms")
        return task.result()

    def run_until(self, end_ns: int, is_over: Callable[[], bool] = lambda: False) -> None:
        """Run until *end_ns*, or until *is_over*."""
        while self.now_ns < end_ns and not is_over():
            self._step(end_ns)

    def _step(self, end_ns: int) -> None:
        """Do what is due now, then let the time pass to what comes next."""
        master, now_ns = self.master, self.now_ns
        while self._inbox and self._inbox[0][0] <= now_ns:
            master.receive_frame(heapq.heappop(self._inbox)[2], now_ns)
        master.handle_timeout(now_ns)
        if now_ns >= self._next_cycle_ns:
            self._next_cycle_ns += CYCLE_NS
            master.start_cycle(now_ns)
        for frame in master.frames_to_send(now_ns):
            self.segment.receive_frame(bytearray(frame), now_ns)
        self.segment.handle_timeout(now_ns)
        for back in self.segment.frames_to_send(now_ns):
            heapq.heappush(self._inbox, (now_ns + TRIP_NS, next(self._order), back.frame))
        self.events += iter(master.next_event, None)
        times = [self._next_cycle_ns, end_ns]
        times += [entry[0] for entry in self._inbox[:1]]
        times += [
            at for at in (master.next_timeout(), self.segment.next_timeout()) if at is not None
        ]
        self.now_ns = max(now_ns + _STEP_NS, min(times))
