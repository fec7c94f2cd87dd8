"""One bus port in the engine: a master, its wire, and the station's variables.

Nothing that a bus does may stop the cycles of the stations: what goes wrong is kept as a text for
whoever asks, and tried again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from devicebus.errors import BusError, FrameLostError
from devicebus.master.bus import MasterSettings
from devicebus.master.master import Master
from devicebus.master.task import Task
from devicebus.wire.alstatus import AlState
from eap.appliance.engine.bus_faults import SlaveFaults
from eap.appliance.engine.bus_ties import BusTies
from eap.errors import EnvironmentalError
from eap.net.busport import BusPort
from eap.pd.image import Image
from eap.pd.spec import BusPortSpec, PortSpec, Writer

RETRY_NS = 2_000_000_000
"""Between two attempts to bring a bus up."""
SILENT_RETRY_NS = 100_000_000
"""The same while nothing comes back at all: nobody is disturbed then."""
BATCH = 16
"""Frames taken in one go; the rest waits until the cycles have had their turn."""
_LONG_CYCLE_NS = 20_000_000
_MOST_STALE = 4096


class EngineBus:
    """Runs one bus; fits :class:`eap.pd.link.CyclicBus`.

    Args:
        spec: The port.
        settings: Of its master.
        cycle_ns: Between two exchanges.
        image: Of the station.
        memory_of: Returns where a station reads what a writer writes.
        port: The wire.

    Attributes:
        is_up: Whether the bus has been brought up, wherever its slaves are now.
        tasks: What somebody has asked for and waits for.
    """

    def __init__(
        self,
        spec: PortSpec,
        settings: MasterSettings,
        cycle_ns: int,
        image: Image,
        memory_of: Callable[[Writer], memoryview],
        port: BusPort,
    ) -> None:
        self.spec = spec.bus or BusPortSpec()
        self.master = Master(settings)
        self.faults = SlaveFaults()
        self.is_up = False
        self.tasks: set[Task[Any]] = set()
        self._settings = settings
        self._is_slow = cycle_ns > _LONG_CYCLE_NS
        self._ties = BusTies(spec, image, memory_of)
        self._port = port
        self._starting: Task[None] | None = None
        self._start_fault = "it is being brought up"
        self._wire_fault = ""
        self._retry_ns: int | None = None
        self._due_ns: int | None = None

    @property
    def fault(self) -> str:
        """Why the bus is not wholly as it should be, empty if it is."""
        faults = (self._wire_fault, self._start_fault, *self._ties.missing)
        return "\n".join(filter(None, faults))

    @property
    def revision(self) -> tuple[object, ...]:
        """Value that changes with anything that a description of the bus shows."""
        return self.master, self.master.changes, self.is_up, self.fault

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when a frame waits."""
        return self._port.fileno()

    def close(self) -> None:
        """Let go of the wire."""
        self._port.close()

    def start(self, now_ns: int) -> None:
        """Begin to bring the bus up."""
        for _ in range(_MOST_STALE):
            if self._take_frame() is None:
                break  # the rest was for an engine that has died
        self._guarded(self._start, now_ns)

    def shut_down(self, now_ns: int) -> Task[None]:
        """Begin to bring all slaves to INIT."""
        self._starting = self._retry_ns = None
        task = self.master.shut_down(now_ns)
        self.keep(task, now_ns)
        return task

    def keep(self, task: Task[Any], now_ns: int) -> None:
        """Send what *task* wants, and hurry until it is done."""
        if not task.is_done:
            self.tasks.add(task)
            task.watch(self.tasks.discard)
        self._guarded(self._send, now_ns)

    def forget_past(self) -> None:
        """Forget faults that are over, and when errors of ports were counted."""
        self.faults.forget_past()
        self.master.port_errors.clear()

    def prepare_ties(
        self, port: PortSpec, image: Image, memory_of: Callable[[Writer], memoryview]
    ) -> BusTies:
        """Return what ties it to another *image* of its station, for :meth:`tie`."""
        ties = BusTies(port, image, memory_of)
        ties.lay_out(self.master.image)
        return ties

    def tie(self, ties: BusTies) -> None:
        """Belong to another image from now on; it holds what the one before held."""
        self._ties = ties

    def take_inputs(self) -> None:
        """Copy what the last exchange brought into the image, and where the slaves are."""
        self._ties.take_inputs(self.master)

    def exchange(self, now_ns: int) -> None:
        """Copy the outputs out of the image and send them; do what is due."""
        self._guarded(self._exchange, now_ns)

    def next_timeout(self) -> int | None:
        """When :meth:`handle_timeout` must be called; None if the next cycle is soon enough."""
        return self._due_ns

    def handle_timeout(self, now_ns: int) -> None:
        """Time passed."""
        self._guarded(self._handle_timeout, now_ns)

    def receive(self, now_ns: int) -> None:
        """Take frames that came back, at most a batch, if any are under way."""
        if self.master.is_waiting:
            self._guarded(self._receive, now_ns)

    def drain(self, now_ns: int) -> None:
        """Take frames that are there, at most a batch, whether anybody waits for them or not."""
        self._guarded(self._receive, now_ns)

    def _guarded(self, action: Callable[[int], None], now_ns: int) -> None:
        try:
            action(now_ns)
            if self._starting is not None and self._starting.is_done:
                self._end_start(self._starting, now_ns)
        except Exception as exc:  # noqa: BLE001  a bus must not stop the stations
            self._begin_anew(exc, now_ns)
        self._due_ns = self.master.next_timeout() if self._is_busy() else None

    def _start(self, now_ns: int) -> None:
        self._retry_ns = None
        self._starting = self.master.bring_up(now_ns, AlState[self.spec.target])
        self._send(now_ns)

    def _end_start(self, task: Task[None], now_ns: int) -> None:
        """The bus is up, maybe without some slaves that are seen to; or it is not."""
        self._starting = None
        self.is_up = task.error is None or self.master.cycle is not None
        self._start_fault = "" if self.is_up else str(task.error)
        if not self.is_up:
            is_silent = isinstance(task.error, FrameLostError)
            self._retry_ns = now_ns + (SILENT_RETRY_NS if is_silent else RETRY_NS)

    def _begin_anew(self, exc: Exception, now_ns: int) -> None:
        """The master cannot go on: replace it."""
        self.faults.take_events(self.master)
        self.faults.end_all(now_ns)
        self.master = Master(self._settings)
        self._ties.lay_out(None)
        self._starting = None
        self.is_up = False
        self._start_fault = f"the master has failed: {type(exc).__name__}: {exc}"
        self._retry_ns = now_ns + RETRY_NS
        for task in list(self.tasks):
            task.fail(BusError(f"{task.name}: {self._start_fault}"))

    def _exchange(self, now_ns: int) -> None:
        self.master.handle_timeout(now_ns)
        if self._retry_ns is not None and now_ns >= self._retry_ns:
            self._start(now_ns)
        if self.master.image is not self._ties.bus_image:
            self._ties.lay_out(self.master.image)
            self._ties.keep_inputs()
        self._ties.put_outputs()
        self.master.start_cycle(now_ns)
        self._send(now_ns)
        self.faults.take_events(self.master)

    def _handle_timeout(self, now_ns: int) -> None:
        self._take_frames(now_ns)
        self.master.handle_timeout(now_ns)
        self._send(now_ns)

    def _receive(self, now_ns: int) -> None:
        self._take_frames(now_ns)
        self._send(now_ns)

    def _take_frames(self, now_ns: int) -> None:
        """Take a batch of what is there: a frame that waits to be taken is not overdue."""
        for _ in range(BATCH):
            frame = self._take_frame()
            if frame is None:
                break
            self.master.receive_frame(frame, now_ns)

    def _take_frame(self) -> bytes | None:
        try:
            return self._port.receive()
        except EnvironmentalError as exc:
            self._wire_fault = str(exc)
            return None

    def _send(self, now_ns: int) -> None:
        for frame in self.master.frames_to_send(now_ns):
            try:
                self._port.send(frame)
                self._wire_fault = ""
            except EnvironmentalError as exc:
                self._wire_fault = str(exc)

    def _is_busy(self) -> bool:
        """Whether something is under way that should not wait for the next cycle."""
        if self._is_slow or self._starting is not None or self.tasks:
            return True
        return any(unit.is_busy for unit in self.master.units.values())
