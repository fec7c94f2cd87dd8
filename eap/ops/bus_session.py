"""Buses as commands use them, and a master on a bus for the length of one command.

    with open_bus(InterfaceUri.parse("udp://127.0.1.1")) as bus:
        for unit in bus.scan(): ...
        bus.converse(unit, lambda sizes: coe_client.upload(0x1018, 1))

A :class:`SlaveBus` is a ``BusSession``, a master of its own, a ``RunningBus`` (bus_running.py),
which uses that of a running station, or a ``GatewayBus`` (bus_gateway.py).  Slaves keep their
states.  Only a slave in INIT, which has no mailbox, is brought to PREOP for a conversation.
"""

from __future__ import annotations

import select
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import NamedTuple, TypeAlias, TypeVar

import msgspec

from devicebus.errors import BusError, NoMailboxError
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.master.attach import attach
from devicebus.master.bring import bring
from devicebus.master.bus import BusSlave, BusState, MasterSettings
from devicebus.master.configuration import read_process_data
from devicebus.master.findings import History, join_errors
from devicebus.master.procedure import Procedure, Task, together
from devicebus.master.scan import FoundSlave, scan
from devicebus.master.startup import set_up_cycle
from devicebus.wire.alstatus import WITH_MAILBOX, WITH_PROCESS_DATA, AlState
from devicebus.wire.register import AlStatus
from eap.errors import EapError
from eap.ids import InterfaceUri
from eap.net.busport import BusPort, open_bus_port
from eap.runtime.bus_status import FrameCounts, count_frames
from eap.runtime.engine_messages import EoeReport, LockState, SlaveReport

T = TypeVar("T")

CYCLE_NS = 2_000_000
SPIN_NS = 200_000
"""Duration of the busy wait for the answer to a frame."""
REPORT_NS = 100_000_000
"""Interval of calls of *meanwhile*."""


class SlaveBus(ABC):
    """A bus with a master."""

    @abstractmethod
    def scan(self) -> Sequence[Slave]:
        """Return all slaves in the order of the line."""

    def find(self, name: str) -> Slave:
        """Return the slave with a station address or a name; raise BusError if that is not one."""
        return choose(self.scan(), name)

    def known(self) -> Sequence[Slave]:
        """Return all slaves in the order of the line, without a new scan if they are known."""
        return self.scan()

    def require_mailbox(self, slave: Slave) -> None:
        """Read the mailbox size of *slave*, which files need; raise BusError without one.

        A master knows the mailboxes of its slaves already.
        """
        del slave

    @abstractmethod
    def converse(
        self,
        slave: Slave,
        begin: Begin[T],
        name: str,
        meanwhile: Callable[[], None] | None = None,
    ) -> T:
        """Run a conversation with a slave's mailbox and return its result.

        Raises:
            BusError: the slave has no mailbox, or does not answer.
            SdoAbortError, SoeError, FoeError: it refuses.
            ControlError: the appliance ended, or other clients occupy the mailbox.
        """

    @abstractmethod
    def bring(self, slaves: Sequence[Slave], target: AlState) -> None:
        """Bring slaves to a state together.

        Raises:
            AlStatusError, StateTimeoutError: a slave refuses, or exceeds its time limit.
            BusError: several do; the message has a line for each.
        """

    @abstractmethod
    def run(self, procedure: Procedure[T], name: str = "a procedure") -> T:
        """Run a procedure to its end and return its result, or raise its error."""

    @abstractmethod
    def frame_counts(self) -> FrameCounts:
        """Return the counters of the master's frames."""

    # Only the master of a running station has a record of its bus.

    def lock_state(self) -> LockState | None:
        """Return the lock of the cycle to the clocks of the bus; None if it runs free."""
        return None

    def reports(self) -> Mapping[int, SlaveReport]:
        """Return the reports of a running master by station address; else nothing."""
        return {}

    def eoe_report(self) -> EoeReport | None:
        """Return the state of the Ethernet switch; None without one."""
        return None

    def mismatch(self) -> BusMismatch | None:
        """Return found and expected slaves of a bus that is not as configured, else None."""
        return None

    def history(self) -> History | None:
        """Return the times of faults; None without a record."""
        return None

    def forget(self) -> None:
        """Clear past faults."""
        return


class BusSession(SlaveBus):
    """One master on one bus.

    Args:
        port: Where the bus is.
        clock: The time in nanoseconds.
    """

    def __init__(self, port: BusPort, clock: Callable[[], int] = time.monotonic_ns) -> None:
        self._port = port
        self._clock = clock
        self._bus = BusState(MasterSettings())
        self._cycle_ns = 0
        self._slaves: Sequence[Slave] = ()

    def scan(self) -> Sequence[Slave]:
        """Find all slaves and assign their station addresses; raises as the scan does."""
        found = self.run(scan(), "scanning the bus")
        self._bus.slaves = {each.station: BusSlave(each, each.name) for each in found}
        for bus_slave in self._bus.slaves.values():
            status = bus_slave.found.al_status
            bus_slave.state = (
                AlState(status.state) if status.state in set(AlState) else AlState.INIT
            )
        self._slaves = [_slave(each) for each in found]
        return self._slaves

    def find(self, name: str) -> Slave:
        """Return the slave with a station address or a name, after a scan if there was none.

        Raises:
            BusError: there is none, or several have that name.
        """
        return choose(self._slaves or self.scan(), name)

    def converse(
        self,
        slave: Slave,
        begin: Begin[T],
        name: str,
        meanwhile: Callable[[], None] | None = None,
    ) -> T:
        """Run a conversation with a slave's mailbox and return its result.

        Raises:
            BusError: the slave has no mailbox, or does not answer.
            SdoAbortError, SoeError, FoeError: it refuses.
        """
        bus_slave = self._bus.slaves[slave.station]
        mailbox = bus_slave.mailbox or self.run(
            attach(self._bus, bus_slave), f"slave {bus_slave.station}"
        )
        task = mailbox.converse(begin(mailbox.sizes), self._clock(), name=name)
        return self._finish(task, meanwhile)

    def bring(self, slaves: Sequence[Slave], target: AlState) -> None:
        """Bring slaves to a state together; cycles run until all have reached it.

        For SAFEOP and OP the process data is laid out anew, starting from PREOP.

        Raises:
            AlStatusError, StateTimeoutError: a slave refuses, or exceeds its time limit.
            BusError: several do; the message has a line for each.
        """
        bus_slaves = [self._bus.slaves[slave.station] for slave in slaves]
        # A slave accepts its process data layout in PREOP only: slaves go through PREOP first.
        if target in WITH_PROCESS_DATA:
            for bus_slave in bus_slaves:
                if bus_slave.state in WITH_MAILBOX and bus_slave.found.sii.fixed.protocols:
                    self.run(attach(self._bus, bus_slave))
            self._bring_all(bus_slaves, AlState.PREOP)
            self._run_all(
                bus_slaves, [read_process_data(self._bus, bus_slave) for bus_slave in bus_slaves]
            )
            set_up_cycle(self._bus)
        try:
            self._bring_all(bus_slaves, target)
        finally:
            self._bus.cycle = None
            # Cycles end with the command; a slave in OP then falls back by its watchdog.
            self._bus.link.stop_cycles()

    def run(self, procedure: Procedure[T], name: str = "a procedure") -> T:
        """Run a procedure to its end and return its result, or raise its error."""
        return self._finish(self._bus.runner.start(procedure, self._clock(), name))

    def frame_counts(self) -> FrameCounts:
        """Return the counters of the frames of this session."""
        return count_frames(self._bus.link.stats())

    def known(self) -> Sequence[Slave]:
        """Return the slaves of the last scan, or scan."""
        return self._slaves or self.scan()

    def _bring_all(self, bus_slaves: Sequence[BusSlave], target: AlState) -> None:
        self._run_all(bus_slaves, [bring(self._bus, bus_slave, target) for bus_slave in bus_slaves])

    def _run_all(
        self, bus_slaves: Sequence[BusSlave], procedures: Sequence[Procedure[None]]
    ) -> None:
        results = self.run(together(procedures))
        errors = [
            (f"{bus_slave.name} ({bus_slave.station})", result)
            for bus_slave, result in zip(bus_slaves, results, strict=True)
            if isinstance(result, EapError)
        ]
        if errors:
            raise join_errors(errors)

    def _finish(self, task: Task[T], meanwhile: Callable[[], None] | None = None) -> T:
        report_ns = 0
        try:
            while not task.is_done:
                now_ns = self._step()
                if meanwhile is not None and now_ns >= report_ns:
                    meanwhile()
                    report_ns = now_ns + REPORT_NS
        finally:
            # After an exception too: a conversation that stays open would occupy the slave's
            # mailbox.
            task.cancel()
        # The end of a conversation may have left a last message, such as an abort, to be sent.
        for frame in self._bus.link.frames_to_send(self._clock()):
            self._port.send(frame)
        return task.result()

    def _step(self) -> int:
        """Send the due frames, wait for the next frame, process it; return the time."""
        bus, port = self._bus, self._port
        now_ns = self._clock()
        if bus.cycle is not None and now_ns >= self._cycle_ns:
            self._cycle_ns = now_ns + CYCLE_NS
            bus.cycle.start(now_ns)
        frames = bus.link.frames_to_send(now_ns)
        for frame in frames:
            port.send(frame)
        times = [bus.link.next_timeout(), bus.runner.next_timeout(), now_ns + REPORT_NS]
        if bus.cycle is not None:
            times.append(self._cycle_ns)
        due_ns = min(at_ns for at_ns in times if at_ns is not None)
        # Only a frame of this step can return at once; otherwise a busy wait would only cost time.
        data = self._spin(now_ns) if frames else None
        if data is None:
            select.select([port], [], [], max(0, due_ns - now_ns) / 1e9)
            data = port.receive()
        now_ns = self._clock()
        while data is not None:
            bus.link.receive_frame(data, now_ns)
            data = port.receive()
        bus.link.handle_timeout(now_ns)
        bus.runner.handle_timeout(now_ns)
        return now_ns

    def _spin(self, now_ns: int) -> bytes | None:
        """Return a frame if one arrives soon: waking up takes longer than its round trip."""
        end_ns = now_ns + SPIN_NS
        while (data := self._port.receive()) is None and self._clock() < end_ns:
            pass
        return data


def _slave(found: FoundSlave) -> Slave:
    identity = found.identity
    return Slave(
        station=found.station,
        name=found.name,
        vendor=identity.vendor,
        product=identity.product,
        revision=identity.revision,
        serial=identity.serial,
        alias=found.alias,
        status=found.al_status,
        protocols=found.sii.fixed.protocols,
        parent=found.node.parent,
        ports=found.node.ports,
        parent_port=found.node.parent_port,
        fault=found.fault,
    )


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


Begin: TypeAlias = Callable[[MailboxSizes], Conversation[T]]


class Slave(msgspec.Struct, frozen=True, kw_only=True):
    """One slave as it was found."""

    station: int
    name: str
    vendor: int
    product: int
    revision: int
    serial: int
    alias: int
    status: AlStatus
    protocols: int | None
    """As in its EEPROM; None where it is not known."""
    parent: int | None
    """Position of the slave that it is wired to; None for the master."""
    ports: tuple[int, ...]
    """Open ports."""
    parent_port: int = 1
    """Port of the parent that it is wired to."""
    fault: str = ""
    """Reason why its description is incomplete or its position is wrong."""
    target: int = 0
    """AL state where the master of a running station keeps it."""
    since_ns: int | None = None
    """Age of *fault* in nanoseconds, if it is known."""
    mailbox_timeouts: int = 0
    """Mailbox requests without a reply, as the master of a running station counts them."""
    is_absent: bool = False
    """True while it is optional and not plugged in."""
    mailbox_late: int = 0
    """Replies that came after their request had timed out."""


class BusMismatch(NamedTuple):
    """Bus of a running station that is not as configured."""

    fault: str
    """The differences, a line for each."""
    found: Sequence[Slave]
    expected: Sequence[Slave]


def choose(slaves: Sequence[Slave], name: str) -> Slave:
    """Return the slave with a station address or a name.

    Raises:
        BusError: there is none, or several have that name.
    """
    if name.isdecimal() or name.lower().startswith("0x"):
        fitting = [slave for slave in slaves if slave.station == slave_number(name)]
    else:
        fitting = [slave for slave in slaves if slave.name == name]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        stations = ", ".join(str(slave.station) for slave in fitting)
        raise BusError(
            f"{len(fitting)} slaves are called {name!r}: use a station address ({stations})"
        )
    known = ", ".join(f"{slave.station} ({slave.name})" for slave in slaves) or "none"
    raise BusError(f"unknown slave {name!r}; known slaves: {known}")


def no_mailbox(slave: Slave, state: str) -> BusError:
    """Return the error of a slave without a mailbox in *state*."""
    return NoMailboxError(
        f"slave {slave.station} ({slave.name}) has no mailbox in {state}: only its state,"
        " EEPROM and registers are accessible"
    )


def slave_number(text: str) -> int:
    """Return the number that names a slave; -1 for what is none."""
    try:
        return int(text, 0)
    except ValueError:
        return -1
