"""One bus port in the engine: a master, its wire, and the station's variables.

Nothing that a bus does may stop the cycles of the stations: a failure is kept as a text for the
report of the bus, and tried again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

from devicebus.errors import BusError, FrameLostError, IdentityError
from devicebus.master.bus import (
    BusBack,
    BusLost,
    Event,
    MasterSettings,
    SlaveAbsent,
    SlaveBack,
    SlaveFailed,
    SlaveLeft,
    SlaveLost,
)
from devicebus.master.emergencies import EmergencyLog
from devicebus.master.findings import NO_ANSWER
from devicebus.master.mailboxes import Unsolicited
from devicebus.master.master import Master
from devicebus.master.procedure import Task
from devicebus.master.ring import RingEnd
from devicebus.master.scan import FoundSlave
from devicebus.wire.alstatus import AlState, name_of, state_name
from eap.engine.bus_mapping import BusMapping
from eap.errors import EnvironmentalError
from eap.net.busport import BusPort
from eap.pd.image import Image
from eap.pd.spec import BusPortSpec, PortSpec, Writer

WHOLE_BUS = 0
"""In place of a station address: no frame comes back."""
RETRY_NS = 2_000_000_000
"""Between two attempts to bring a bus up."""
SILENT_RETRY_NS = 100_000_000
"""The same while nothing comes back at all: no slave is disturbed then."""
BATCH = 16
"""Frames taken in one go; the rest waits until the cycles have had their turn."""
_LONG_CYCLE_NS = 20_000_000
_MAX_STALE = 4096


class FaultCounts(NamedTuple):
    """Faults of a slave since the engine started."""

    losses: int = 0
    """Times that it stopped answering."""
    departures: int = 0
    """Times that it left its state by itself."""
    al_code: int = 0
    """AL status code when it last did."""


class SlaveFault(NamedTuple):
    """Reason why a slave is, or was, not in its target state; *until_ns* is None if it is."""

    text: str = ""
    since_ns: int = 0
    until_ns: int | None = None


class SlaveFaults:
    """Faults by station address: those that last, the last one that is over, and their numbers.

    Attributes:
        on_unsolicited: Called with each message that a slave sent unasked.
        emergencies: Emergencies of the slaves.
        now_ns: Time of the present or last cycle.
    """

    def __init__(self) -> None:
        self.on_unsolicited: list[Callable[[Unsolicited], None]] = []
        self.emergencies = EmergencyLog()
        self.now_ns = 0
        self._faults: dict[int, SlaveFault] = {}
        self._counts: dict[int, FaultCounts] = {}

    def of(self, station: int) -> str:
        """Return the reason why a slave is not in its target state, empty if it is."""
        fault = self.last(station)
        return fault.text if fault.until_ns is None else ""

    def last(self, station: int) -> SlaveFault:
        """Return the last fault of a slave, which may be over."""
        return self._faults.get(station, SlaveFault())

    def counts(self, station: int) -> FaultCounts:
        """Return the numbers of faults of a slave."""
        return self._counts.get(station, FaultCounts())

    def forget_past(self) -> None:
        """Forget the faults and emergencies that are over; the numbers of faults stay."""
        self.emergencies.clear()
        self._faults = {at: each for at, each in self._faults.items() if each.until_ns is None}

    def forget_others(self, kept: Collection[int]) -> None:
        """Forget all slaves but those with station addresses in *kept*."""
        self.emergencies.forget_others(kept)
        stations = {WHOLE_BUS, *kept}
        self._faults = {at: each for at, each in self._faults.items() if at in stations}
        self._counts = {at: each for at, each in self._counts.items() if at in stations}

    def end_all(self, now_ns: int) -> None:
        """End the faults that last: a master that is replaced reports no end of them."""
        for station, each in self._faults.items():
            if each.until_ns is None:
                self._end(station, now_ns)

    def handle_events(self, master: Master) -> None:
        """Take the events of the master."""
        while (event := master.next_event()) is not None:
            self._remember(event)
            if isinstance(event, BusLost):
                self._begin(WHOLE_BUS, "no frame comes back", event.at_ns)
            elif isinstance(event, BusBack):
                self._end(WHOLE_BUS, event.at_ns)
            elif isinstance(event, SlaveLost):
                self._begin(event.station, NO_ANSWER, event.at_ns)
            elif isinstance(event, SlaveFailed):
                self._begin(event.station, event.reason, event.at_ns)
            elif isinstance(event, SlaveLeft):
                code = f": AL status code 0x{event.code:04X}, {name_of(event.code)}"
                text = (
                    f"it went to {state_name(event.status)} by itself{code if event.code else ''}"
                )
                self._begin(event.station, text, event.at_ns)
            elif isinstance(event, SlaveBack | SlaveAbsent):
                self._end(event.station, event.at_ns)
            elif isinstance(event, Unsolicited):
                self.emergencies.take(event, self.now_ns)
                for call in self.on_unsolicited:
                    call(event)

    def _begin(self, station: int, text: str, at_ns: int) -> None:
        """Note a fault; one that follows another began with it, except silence: that is news."""
        before = self.last(station)
        lasts = bool(before.text) and before.until_ns is None
        if text == NO_ANSWER:
            lasts = lasts and before.text == NO_ANSWER
        self._faults[station] = SlaveFault(text, before.since_ns if lasts else at_ns)

    def _end(self, station: int, at_ns: int) -> None:
        fault = self._faults.get(station)
        if fault is not None:
            self._faults[station] = fault._replace(until_ns=at_ns)

    def _remember(self, event: Event) -> None:
        if isinstance(event, SlaveLost):
            past = self.counts(event.station)
            self._counts[event.station] = past._replace(losses=past.losses + 1)
        elif isinstance(event, SlaveLeft):
            past = self.counts(event.station)
            self._counts[event.station] = past._replace(
                departures=past.departures + 1, al_code=event.code or past.al_code
            )


class BusSuccessor(NamedTuple):
    """Parts of a bus that restarts with other settings."""

    spec: BusPortSpec
    settings: MasterSettings
    master: Master
    mapping: BusMapping


class EngineBus:
    """Runs one bus; fits :class:`eap.pd.link.CyclicBus`.

    Args:
        spec: The port.
        settings: Of its master.
        cycle_ns: Between two exchanges.
        image: Of the station.
        memory_of: Returns where a station reads what a writer writes.
        port: The wire.
        second: Second line to a ring of slaves, None on a bus with one line.
        set_step: Sets the distance to the next cycle of the station in ns, for a bus whose
            reference clock it follows.

    Attributes:
        is_simulated: Whether its slaves are a process of this appliance.
        is_up: Whether the bus has been brought up, in any state of its slaves.
        listen: Called with whether frames that arrive are to be drained at once; in quiet cycles
            the next cycle takes them, which saves a wake-up for each.
        refused: Slaves that were found, but are not as configured; empty without that fault.
        tasks: Requests that are under way.
    """

    def __init__(
        self,
        spec: PortSpec,
        settings: MasterSettings,
        cycle_ns: int,
        image: Image,
        memory_of: Callable[[Writer], memoryview],
        port: BusPort,
        second: BusPort | None = None,
        set_step: Callable[[int], None] | None = None,
    ) -> None:
        self.spec = spec.bus or BusPortSpec()
        self.is_simulated = spec.interface.scheme == "sim"
        self.master = Master(settings)
        self.faults = SlaveFaults()
        self.is_up = False
        self.refused: Sequence[FoundSlave] = ()
        self.tasks: set[Task[Any]] = set()
        self.listen: Callable[[bool], None] | None = None
        self._is_listening = True
        self._settings = settings
        self._is_slow = cycle_ns > _LONG_CYCLE_NS
        self._mapping = BusMapping(spec, image, memory_of)
        self._port = port
        self._second = second
        self._set_step = set_step
        self._starting: Task[None] | None = None
        self._start_fault = "it is being brought up"
        self._wire_faults = {port: "" for port in (port, second) if port is not None}
        self._retry_ns: int | None = None
        self._due_ns: int | None = None

    @property
    def fault(self) -> str:
        """Faults of the bus as a whole, one line each; empty if there is none."""
        faults = (
            *self._line_faults(),
            self._start_fault,
            *self.master.strangers,
            *self._mapping.missing,
        )
        return "\n".join(filter(None, faults))

    def _line_faults(self) -> list[str]:
        """Return the fault of each line; one line of a ring is named."""
        faults = list(self._wire_faults.values())
        if self._second is None:
            return faults
        names = ("first line", "second line")
        return [f"{name}: {each}" for name, each in zip(names, faults, strict=True) if each]

    @property
    def revision(self) -> tuple[object, ...]:
        """Value that changes with anything that a description of the bus shows."""
        return self.master, self.master.changes, self.is_up, self.fault

    def filenos(self) -> list[int]:
        """Return the descriptor of each line, which becomes readable when a frame waits."""
        return [each.fileno() for each in self.lines]

    @property
    def lines(self) -> list[BusPort]:
        """The ports of all lines."""
        return [each for each in (self._port, self._second) if each is not None]

    def close(self) -> None:
        """Close the ports of all lines."""
        self._port.close()
        if self._second is not None:
            self._second.close()

    def start(self, now_ns: int) -> None:
        """Begin to bring the bus up."""
        for port in (self._port, self._second):
            for _ in range(_MAX_STALE):
                if port is None or self._receive_frame(port) is None:
                    break  # the rest was for an engine that has died
        self._guarded(self._start, now_ns)

    def fail_tasks(self, reason: str) -> None:
        """Fail all requests that are under way."""
        for task in list(self.tasks):
            task.fail(BusError(f"{task.name}: {reason}"))

    def shut_down(self, now_ns: int) -> Task[None]:
        """Begin to bring all slaves to INIT."""
        self._starting = self._retry_ns = None
        task = self.master.shut_down(now_ns)
        self.keep(task, now_ns)
        return task

    def keep(self, task: Task[Any], now_ns: int) -> None:
        """Send the frames of *task*, and run the bus between cycles until it is done."""
        if not task.is_done:
            self.tasks.add(task)
            task.watch(self.tasks.discard)
        self._guarded(self._send, now_ns)

    def forget_past(self) -> None:
        """Forget faults that are over, times of port errors, and mailbox time-outs."""
        self.faults.forget_past()
        self.master.forget_past()
        self.master.port_errors.clear()

    def prepare_mapping(
        self, port: PortSpec, image: Image, memory_of: Callable[[Writer], memoryview]
    ) -> BusMapping:
        """Return the mapping to another *image* of its station, for :meth:`swap_mapping`."""
        mapping = BusMapping(port, image, memory_of)
        mapping.lay_out(self.master.image)
        return mapping

    def swap_mapping(self, mapping: BusMapping) -> None:
        """Use another image from now on; it holds what the one before held."""
        self._mapping = mapping

    def prepare_restart(
        self,
        port: PortSpec,
        settings: MasterSettings,
        image: Image,
        memory_of: Callable[[Writer], memoryview],
    ) -> BusSuccessor:
        """Return the parts for :meth:`restart`: all slow work is done here."""
        mapping = BusMapping(port, image, memory_of)
        return BusSuccessor(port.bus or BusPortSpec(), settings, Master(settings), mapping)

    def restart(self, successor: BusSuccessor, now_ns: int) -> Master:
        """Take the bus down, and bring it up with other settings and another image.

        Its requests fail.  Slaves that keep station address and name keep their faults.

        Returns:
            The master before, for the caller to free: that takes long.
        """
        master = self.master
        names = {slave.station: slave.name for slave in self.spec.slaves}
        self.spec, self._settings = successor.spec, successor.settings
        self._is_slow = successor.settings.cycle_ns > _LONG_CYCLE_NS
        self._mapping = successor.mapping
        self._replace_master(successor.master, "it restarts with other settings", now_ns)
        self.faults.forget_others(
            {each.station for each in self.spec.slaves if names.get(each.station) == each.name}
        )
        # Bringing up begins with INIT for all slaves.
        self._guarded(self._start, now_ns)
        return master

    def copy_inputs(self) -> None:
        """Copy the inputs of the last exchange and the states of the slaves into the image."""
        self._mapping.copy_inputs(self.master)

    def exchange(self, now_ns: int) -> None:
        """Run due timers, copy the outputs out of the image and send them."""
        self._guarded(self._exchange, now_ns)

    def next_timeout(self) -> int | None:
        """Return the time for :meth:`handle_timeout`; None if the next cycle is soon enough."""
        return self._due_ns

    def handle_timeout(self, now_ns: int) -> None:
        """Run due timers."""
        self._guarded(self._handle_timeout, now_ns)

    def receive(self, now_ns: int) -> None:
        """Receive frames that came back, at most a batch, if any are under way."""
        # Spares a system call in each cycle for a bus on which nothing is under way.
        if self.master.is_waiting:
            self._guarded(self._receive, now_ns)

    def drain(self, now_ns: int) -> None:
        """Receive waiting frames, at most a batch, also unexpected ones."""
        self._guarded(self._receive, now_ns)

    def _guarded(self, action: Callable[[int], None], now_ns: int) -> None:
        try:
            action(now_ns)
            if self._starting is not None and self._starting.is_done:
                self._end_start(self._starting, now_ns)
        except Exception as exc:  # noqa: BLE001  a bus must not stop the stations
            self._restart_master(exc, now_ns)
        self._due_ns = self.master.next_timeout() if self._is_busy() else None

    def _start(self, now_ns: int) -> None:
        self._retry_ns = None
        self._starting = self.master.bring_up(now_ns, AlState[self.spec.target])
        self._send(now_ns)

    def _end_start(self, task: Task[None], now_ns: int) -> None:
        """Note the outcome of a start; the bus may be up without some of its slaves."""
        self._starting = None
        self.is_up = task.error is None or self.master.cycle is not None
        self._start_fault = "" if self.is_up else str(task.error)
        self.refused = self.master.found if isinstance(task.error, IdentityError) else ()
        if not self.is_up:
            is_silent = isinstance(task.error, FrameLostError)
            self._retry_ns = now_ns + (SILENT_RETRY_NS if is_silent else RETRY_NS)

    def _restart_master(self, exc: Exception, now_ns: int) -> None:
        """Replace a master that has failed."""
        reason = f"the master has failed: {type(exc).__name__}: {exc}"
        self._replace_master(Master(self._settings), reason, now_ns)
        self._mapping.lay_out(None)
        # Not at once: a fault that returns with each start would keep the slaves in transitions.
        self._retry_ns = now_ns + RETRY_NS

    def _replace_master(self, master: Master, reason: str, now_ns: int) -> None:
        """Use *master* from now on, and fail all requests for *reason*."""
        self.faults.handle_events(self.master)
        self.faults.end_all(now_ns)
        self.master = master
        self._starting = None
        self.is_up = False
        self.refused = ()
        self._start_fault = reason
        self.fail_tasks(reason)

    def _exchange(self, now_ns: int) -> None:
        is_quiet = not self._is_busy() and self.master.is_quiet(now_ns)
        if not is_quiet:
            self.master.handle_timeout(now_ns)
            if self._retry_ns is not None and now_ns >= self._retry_ns:
                self._start(now_ns)
        if self.master.image is not self._mapping.bus_image:
            self._mapping.lay_out(self.master.image)
            # A new bus image starts with zeros, which would reach the variables before the first
            # exchange.
            self._mapping.keep_inputs()
        # The outputs of this cycle leave at its end; the inputs they cause come in the next one.
        self._mapping.put_outputs()
        frame = self.master.quiet_frame(now_ns) if is_quiet else None
        if frame is not None:
            self._send_frame(self._port, frame)
            # A recording has the time at which a frame is taken, so it is taken at once.
            self._set_listening(is_on=self._port.tap is not None)
        else:
            self.master.start_cycle(now_ns)
            self._send(now_ns)
        if self._set_step is not None and self.master.lock is not None:
            self._set_step(self.master.lock.take_step())
        self.faults.now_ns = now_ns
        self.faults.handle_events(self.master)

    def _handle_timeout(self, now_ns: int) -> None:
        self._receive_frames(now_ns)
        self.master.handle_timeout(now_ns)
        self._send(now_ns)

    def _receive(self, now_ns: int) -> None:
        self._receive_frames(now_ns)
        self._send(now_ns)

    def _receive_frames(self, now_ns: int) -> None:
        """Receive a batch of frames first: a frame that waits in the socket is not overdue."""
        self._receive_line(self._port, RingEnd.FIRST, now_ns)
        if self._second is not None:
            self._receive_line(self._second, RingEnd.SECOND, now_ns)
            self.master.merge_overdue(now_ns)

    def _receive_line(self, port: BusPort, line: RingEnd, now_ns: int) -> None:
        for _ in range(BATCH):
            if self._is_listening:
                frame = self._receive_frame(port)
            else:
                # It has waited for this cycle: its round trip ended when it arrived.
                frame, now_ns = self._receive_stamped(port, now_ns)
            if frame is None:
                break
            self.master.receive_frame(frame, now_ns, line)
            # Spares a system call for the usual case of one frame; a ring has its copy, too.
            if self._second is None and not self.master.is_waiting:
                break

    def _receive_frame(self, port: BusPort) -> bytes | None:
        try:
            return port.receive()
        except EnvironmentalError as exc:
            self._wire_faults[port] = str(exc)
            return None

    def _receive_stamped(self, port: BusPort, now_ns: int) -> tuple[bytes | None, int]:
        try:
            return port.receive_stamped() or (None, now_ns)
        except EnvironmentalError as exc:
            self._wire_faults[port] = str(exc)
            return None, now_ns

    def _set_listening(self, *, is_on: bool) -> None:
        if is_on is not self._is_listening and self.listen is not None:
            self._is_listening = is_on
            self.listen(is_on)

    def _send(self, now_ns: int) -> None:
        frames = self.master.frames_to_send(now_ns)
        if frames:
            self._set_listening(is_on=True)
        for frame in frames:
            self._send_frame(self._port, frame)
        if self._second is not None:
            for frame in self.master.take_copies():
                self._send_frame(self._second, frame)

    def _send_frame(self, port: BusPort, frame: bytes) -> None:
        try:
            port.send(frame)
            self._wire_faults[port] = ""
        except EnvironmentalError as exc:
            self._wire_faults[port] = str(exc)

    def _is_busy(self) -> bool:
        """Return whether something is under way that should not wait for the next cycle."""
        if self._is_slow or self._starting is not None or self.tasks:
            return True
        return self.master.is_busy
