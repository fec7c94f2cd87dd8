"""Trying one fault: what the master tells, and how long until all is well again."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from devicebus.master.clocks import read_difference
from devicebus.master.diagnosis import clear_counters, diagnose
from devicebus.master.link import LINGER_NS
from devicebus.master.procedure import Task
from devicebus.sim.devices.build import build_slave
from devicebus.sim.spec import BusSpec, FaultKind
from eap.errors import EapError
from tools.faults.bench import BUS, MS, STATIONS, Bench
from tools.faults.case import Case
from tools.faults.wording import after, counters, describe_diagnosis, describe_events

_DIAGNOSE_BEFORE_NS = 30 * MS
"""Time before the end of the fault at which the master locates it."""
_QUANTUM_NS = 100_000
_BACK_WITHIN_NS = 10_000 * MS
_STAYS_NS = 150 * MS
"""So long everything has to stay well."""
_OTHER_PRODUCT = 0x0BAD
_OUT_NS = 200 * MS
_SWAPPED_NS = 1_200 * MS
"""Time for which the wrong device is connected."""


class Row(msgspec.Struct, frozen=True):
    """Row of the table for one fault; each of *events*, *counters*, … may be empty."""

    kind: str
    what: str
    events: Sequence[str]
    counters: str
    request: str
    diagnosis: str
    again: str
    """Time from its end until all slaves were in OP with complete process data."""


class Trial:
    """One fault on a bench of its own."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._bench = Bench()
        self._names = {at: unit.name for at, unit in self._bench.master.slaves.items()}
        self._start_ns = 0
        self._unwell_ns: int | None = None
        self._task: Task[object] | None = None
        self._answer = ""
        self._diagnosis = ""

    def run(self) -> Row:
        """Let it happen, and wait until all is well.

        Raises:
            TimeoutError: it does not get well.
        """
        bench, case = self._bench, self._case
        bench.wait(bench.master.run(clear_counters(STATIONS), bench.now_ns), 100 * MS)
        before = bench.master.stats()
        self._start_ns = bench.now_ns
        end_ns = self._swap() if case.swapped else self._happen()
        while not bench.is_well or bench.now_ns < (self._unwell_ns or end_ns) + _STAYS_NS:
            if bench.now_ns > end_ns + _BACK_WITHIN_NS:
                raise TimeoutError(f"{case.what}: not well 10 s after its end")
            self._go_on(1 * MS)
        if self._task is not None:
            bench.run_until(end_ns + _BACK_WITHIN_NS, lambda: bool(self._answer))
        # A frame that does not come back counts as lost after a while.
        bench.run_until(bench.now_ns + 2 * LINGER_NS, lambda: not bench.master.is_waiting)
        changes = counters(before, bench.master.stats())
        again = "never left"
        if self._unwell_ns is not None:
            again = after(max(0, self._unwell_ns - end_ns))
        return Row(
            case.kind.value,
            case.what,
            describe_events(bench.events, self._names, self._start_ns),
            changes,
            self._answer,
            self._diagnosis,
            again,
        )

    def _happen(self) -> int:
        """Let the faults of the case happen; return when they are over."""
        for fault in self._case.faults:
            self._bench.begin(fault)
        # The next cycle may notice the fault, and a mailbox is closed then.
        self._send_requests()
        self._go_on(1 * MS)
        return self._last(self._start_ns + self._case.duration_ms * MS)

    def _swap(self) -> int:
        """Plug in another product, and then the right one; return when that is there."""
        bench, (fault,) = self._bench, self._case.faults
        number = list(self._names.values()).index(self._case.swapped)
        controller = bench.segment.segment.slaves[number].esc
        right = controller.image
        spec = msgspec.convert(BUS, BusSpec).slaves[number]
        other = build_slave(msgspec.structs.replace(spec, product=_OTHER_PRODUCT)).esc.image
        fault = msgspec.structs.replace(fault, for_ms=None)
        for image, stays_ns in ((other, _SWAPPED_NS), (right, 0)):
            bench.begin(fault)
            self._go_on(_OUT_NS)
            controller.image = image
            bench.segment.end(fault, bench.now_ns)
            if stays_ns:
                self._last(bench.now_ns + stays_ns)
        return bench.now_ns

    def _last(self, end_ns: int) -> int:
        """Run to the end of the fault, with a diagnosis shortly before; return when that is."""
        self._go_on(max(0, end_ns - _DIAGNOSE_BEFORE_NS - self._bench.now_ns))
        self._diagnose()
        self._go_on(max(0, end_ns - self._bench.now_ns))
        return end_ns

    def _go_on(self, duration_ns: int) -> None:
        """Run for that long, and note until when something was not as it should be."""
        bench = self._bench
        end_ns = bench.now_ns + duration_ns
        while bench.now_ns < end_ns:
            bench.run_until(end_ns, lambda: not bench.is_well)
            if not bench.is_well:
                bench.run_until(end_ns, lambda: bench.is_well)
                self._unwell_ns = bench.now_ns

    def _send_requests(self) -> None:
        request, bench = self._case.request, self._bench
        if request is None:
            return
        mailbox = bench.master.slaves[request.station].mailbox
        if mailbox is None:
            raise RuntimeError(f"{self._names[request.station]} has no mailbox")
        begin_ns = bench.now_ns
        what = f"{request.what} at `{self._names[request.station]}`"

        def done(task: Task[object]) -> None:
            outcome = "done" if task.error is None else str(task.error)
            self._answer = f"{what}: {outcome} ({after(bench.now_ns - begin_ns)})"

        conversation = request.begin(mailbox.sizes)
        self._task = bench.master.converse(
            request.station, conversation, begin_ns, name=request.what
        )
        self._task.watch(done)

    def _diagnose(self) -> None:
        bench = self._bench
        task = bench.master.run(diagnose(STATIONS), bench.now_ns, "diagnosis")
        clocks = bench.master.run(read_difference(STATIONS[2]), bench.now_ns, "clock")
        while not (task.is_done and clocks.is_done):
            self._go_on(_QUANTUM_NS)
        ahead_ns = None
        if self._case.kind is FaultKind.DRIFT:
            ahead_ns = clocks.result()
        try:
            self._diagnosis = describe_diagnosis(task.result(), self._names, ahead_ns)
        except EapError as error:
            self._diagnosis = str(error)
