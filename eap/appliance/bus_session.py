"""A master on a bus for as long as one command takes: procedures run to their end, one by one.

    with open_bus(InterfaceUri.parse("udp://127.0.1.1")) as bus:
        for unit in bus.scan(): ...
        bus.converse(unit, lambda sizes: coe_client.upload(0x1018, 1))

Slaves stay as they are found: a mailbox that works is used as it is set up.  Only a slave in INIT,
which has none, is brought to PREOP to be talked to.
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeAlias, TypeVar

from devicebus.errors import BusError
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.attach import attach
from devicebus.master.bring import bring, read_process_data
from devicebus.master.bus import Bus, MasterSettings, Unit
from devicebus.master.link import LinkStats
from devicebus.master.procedure import Procedure, together
from devicebus.master.scan import scan
from devicebus.master.startup import set_up_cycle
from devicebus.master.task import Task
from devicebus.wire.alstatus import AlState
from eap.errors import EapError
from eap.ids import InterfaceUri
from eap.net.busport import BusPort, open_bus_port

T = TypeVar("T")
Begin: TypeAlias = Callable[[MailboxSizes], Conversation[T]]

FRAME_TIMEOUT_NS = 20_000_000
"""Longer than a master's with a cycle: nobody waits for these frames but a person."""
CYCLE_NS = 2_000_000
LOOK_NS = 100_000_000
"""How often *meanwhile* is called while something runs."""

_WITH_PROCESS_DATA = frozenset((AlState.SAFEOP, AlState.OP))
_WITH_MAILBOX = _WITH_PROCESS_DATA | {AlState.PREOP}


class BusSession:
    """One master on one bus.

    Args:
        port: Where the bus is.
        clock: The time in nanoseconds.
    """

    def __init__(self, port: BusPort, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._port = port
        self._clock = clock
        self._bus = Bus(MasterSettings(frame_timeout_ns=FRAME_TIMEOUT_NS))
        self._cycle_ns = 0

    def scan(self) -> Sequence[Unit]:
        """Find all slaves and give them their station addresses; raises as the scan does."""
        found = self.run(scan(), "scanning the bus")
        self._bus.units = {each.station: Unit(each, each.name) for each in found}
        for unit in self._bus.units.values():
            status = unit.found.al_status
            unit.state = AlState(status.state) if status.state in set(AlState) else AlState.INIT
        return list(self._bus.units.values())

    def find(self, name: str) -> Unit:
        """Return the slave with a station address or a name, after a scan if there was none.

        Raises:
            BusError: there is none, or several have that name.
        """
        units = list(self._bus.units.values()) or self.scan()
        if name.isdecimal() or name.lower().startswith("0x"):
            fitting = [unit for unit in units if unit.station == int(name, 0)]
        else:
            fitting = [unit for unit in units if unit.name == name]
        if len(fitting) == 1:
            return fitting[0]
        if fitting:
            stations = ", ".join(str(unit.station) for unit in fitting)
            raise BusError(f"{len(fitting)} slaves are called {name!r}: say which of {stations}")
        known = ", ".join(f"{unit.station} ({unit.name})" for unit in units) or "none"
        raise BusError(f"there is no slave {name!r}; there are {known}")

    def converse(
        self, unit: Unit, begin: Begin[T], name: str, meanwhile: Callable[[], None] | None = None
    ) -> T:
        """Talk to a slave's mailbox until the conversation ends; return its result.

        Raises:
            BusError: the slave has no mailbox, or does not answer.
            SdoAbortError, SoeError, FoeError: it refuses.
        """
        mailbox = unit.mailbox or self.run(attach(self._bus, unit), f"slave {unit.station}")
        task = mailbox.converse(begin(mailbox.sizes), self._clock(), name=name)
        return self._finish(task, meanwhile)

    def bring(self, units: Sequence[Unit], target: AlState) -> None:
        """Bring slaves to a state together; cycles run until they are there.

        Process data of those that are to get some is laid out anew, so that they begin in PREOP.

        Raises:
            AlStatusError, StateTimeoutError: one refuses, or takes too long.
            BusError: several do; the message has a line for each.
        """
        if target in _WITH_PROCESS_DATA:
            for unit in units:
                if unit.state in _WITH_MAILBOX and unit.found.sii.fixed.protocols:
                    self.run(attach(self._bus, unit))
            self._bring_all(units, AlState.PREOP)
            self._run_all(units, [read_process_data(self._bus, unit) for unit in units])
            set_up_cycle(self._bus)
        try:
            self._bring_all(units, target)
        finally:
            self._bus.cycle = None
            self._bus.link.stop_cycles()

    def run(self, procedure: Procedure[T], name: str = "a procedure") -> T:
        """Run a procedure to its end and return its result, or raise what went wrong."""
        return self._finish(self._bus.runner.start(procedure, self._clock(), name))

    def link_stats(self) -> LinkStats:
        """Return the counters of the frames of this session."""
        return self._bus.link.stats()

    def _bring_all(self, units: Sequence[Unit], target: AlState) -> None:
        self._run_all(units, [bring(self._bus, unit, target) for unit in units])

    def _run_all(self, units: Sequence[Unit], procedures: Sequence[Procedure[None]]) -> None:
        results = self.run(together(procedures))
        errors = [result for result in results if isinstance(result, EapError)]
        if len(errors) == 1:
            raise errors[0]
        if errors:
            lines = "; ".join(map(str, errors))
            raise BusError(f"{len(errors)} of {len(units)} slaves have failed: {lines}")

    def _finish(self, task: Task[T], meanwhile: Callable[[], None] | None = None) -> T:
        look_ns = 0
        try:
            while not task.is_done:
                now_ns = self._step()
                if meanwhile is not None and now_ns >= look_ns:
                    meanwhile()
                    look_ns = now_ns + LOOK_NS
        finally:
            task.cancel()
        for frame in self._bus.link.frames_to_send(self._clock()):
            self._port.send(frame)
        return task.result()

    def _step(self) -> int:
        """Send what is due, wait for what comes next, take it; return the time."""
        bus, port = self._bus, self._port
        now_ns = self._clock()
        if bus.cycle is not None and now_ns >= self._cycle_ns:
            self._cycle_ns = now_ns + CYCLE_NS
            bus.cycle.start(now_ns)
        for frame in bus.link.frames_to_send(now_ns):
            port.send(frame)
        times = [bus.link.next_timeout(), bus.runner.next_timeout(), now_ns + LOOK_NS]
        if bus.cycle is not None:
            times.append(self._cycle_ns)
        due_ns = min(at_ns for at_ns in times if at_ns is not None)
        select.select([port], [], [], max(0, due_ns - now_ns) / 1e9)
        now_ns = self._clock()
        while (data := port.receive()) is not None:
            bus.link.receive_frame(data, now_ns)
        bus.link.handle_timeout(now_ns)
        bus.runner.handle_timeout(now_ns)
        return now_ns


@contextmanager
def open_bus(interface: InterfaceUri) -> Iterator[BusSession]:
    """Open a bus for the length of a block.

    Raises:
        EnvironmentalError: *interface* cannot be opened.
    """
    port = open_bus_port(interface)
    try:
        yield BusSession(port)
    finally:
        port.close()
