"""Reconfiguration of a running station: built in a thread, swapped in between two cycles.

The thread exists only while something is built.  It has a lower priority than the cycles: they get
the interpreter within SWITCH_S of asking for it, and its processor at once.  All that takes time is
done in the thread, which only reads from the running cycles.  The cycle's thread then takes over
the result, which copies numbers and little else.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path

from devicebus.master.master import Master
from eap.engine.bus_mapping import BusMapping
from eap.engine.bus_settings import epoch_offset_ns, master_settings
from eap.engine.engine_bus import BusSuccessor, EngineBus
from eap.errors import EapError, EngineRefusedError
from eap.ids import Destination, DestinationKind
from eap.net import realtime
from eap.net.image_file import ImageFile, prepare_image
from eap.net.tcpport import TcpPort
from eap.pd.device import DeviceState
from eap.pd.engine import Engine
from eap.pd.handover import ImageHandover, needs_new_start, restarting_buses
from eap.pd.layout import plan_layout
from eap.pd.link import FrameChannel
from eap.pd.spec import REQUESTER, PortSpec, StationSpec, record_from_lines
from eap.pd.station import Station
from eap.runtime.engine_messages import Configure, SetState, StationRequest


def sends_to(spec: StationSpec, port: str) -> set[str]:
    """Return the destinations to which frames of *port* go by TCP."""
    destinations = {frame.destination for frame in spec.frames if frame.port == port} - {REQUESTER}
    return {each for each in destinations if Destination.parse(each).kind is DestinationKind.TCP}


def has_tcp(spec: StationSpec, port: PortSpec) -> bool:
    """Return whether *port* sends or receives by TCP."""
    return port.tcp or port.interface.scheme == "tcp" or bool(sends_to(spec, port.name))


def open_tcp_port(spec: PortSpec, datagrams: FrameChannel | None) -> TcpPort:
    """Return the channel of a port with TCP, beside its *datagrams* if it has any."""
    return TcpPort(spec.interface.host, datagrams)


def follow_station(port: TcpPort, station: Station, name: str) -> None:
    """Configure *port* for the frames of *station* at its port *name*."""
    spec = station.spec
    asks = any(pd.poll_request and pd.port == name for pd in spec.subscriptions)
    port.follow(sends_to(spec, name), [station.handlers[name]] if asks else [])


class EngineStation:
    """A station of the engine and its image; both are replaced together."""

    def __init__(self, station: Station, file: ImageFile) -> None:
        self.station = station
        self.file = file
        self.buses: dict[str, EngineBus] = {}
        """By port."""
        self.tcp_ports: dict[str, TcpPort] = {}

    def set_step(self, step_ns: int) -> None:
        """Set the distance from the present cycle to the next, as a clock of a bus wants it."""
        self.station.step_ns = step_ns

    def update_tcp(self) -> None:
        """Keep connections only to the present destinations of the station."""
        for name, port in self.tcp_ports.items():
            follow_station(port, self.station, name)

    def close(self) -> None:
        """Release the image and of all connections."""
        self.file.close()
        for port in self.tcp_ports.values():
            port.close()


class StationReplacement:
    """Replacement of a station with another specification, built in a thread.

    Raises:
        EngineRefusedError: this cannot be done without a new start.
        EapError, ValueError, LookupError: the specification is not that of a station.
    """

    def __init__(self, entry: EngineStation, spec: StationSpec) -> None:
        before = entry.station
        if reasons := needs_new_start(before.spec, spec):
            raise EngineRefusedError("\n".join(reasons))
        self._entry = entry
        self._file = prepare_image(entry.file.path, plan_layout(spec), entry.file.generation + 1)
        try:
            image = self._file.image
            self._images = ImageHandover(before.image, image)
            # Before Station(): its subscribers read from the words which trackers they share.
            self._images.carry_words()
            self._images.carry_values(before.inputs.memory)
            self._station = Station(spec, image, self._file.wake_waiters)
            self._tcp_ports = _new_tcp_ports(entry, spec)
            self._station.prepare_handover(before, self._tcp_ports)
            self._images.commit()
            memory_of = self._station.memory_of
            self._mappings: list[tuple[EngineBus, BusMapping]] = []
            self._restarts: list[tuple[EngineBus, BusSuccessor]] = []
            self._old_masters: list[Master] = []
            restarting = restarting_buses(before.spec, spec)
            for port in spec.ports:
                bus = entry.buses.get(port.name)
                if bus is None:
                    continue
                if port.name in restarting:
                    settings = master_settings(port, spec.cycle_us, epoch_offset_ns())
                    successor = bus.prepare_restart(port, settings, image, memory_of)
                    self._restarts.append((bus, successor))
                else:
                    self._mappings.append((bus, bus.prepare_mapping(port, image, memory_of)))
        except BaseException:
            self.discard()
            raise

    @property
    def is_current(self) -> bool:
        """True if it still fits the station that it replaces."""
        return self._images.is_current

    def take_over(self, engine: Engine, now_ns: int) -> Station:
        """Replace the station between two cycles; return the replaced one.

        Raises:
            EnvironmentalError: the image cannot be put in its place; nothing has changed.
        """
        entry, station = self._entry, self._station
        before = entry.station
        self._images.carry_words()
        self._images.carry_values(before.inputs.memory)
        # The last step that can fail: nothing of the running station has changed before it.
        self._file.move_to(entry.file.path)
        entry.file.retire()
        # Who writes from now on sees that the image is retired, and writes in the new one again.
        if before.inputs.refresh():
            self._images.carry_values(before.inputs.memory)
        station.follow(before, now_ns)
        for bus, mapping in self._mappings:
            bus.swap_mapping(mapping)
        self._old_masters = [bus.restart(parts, now_ns) for bus, parts in self._restarts]
        engine.replace(before, station, now_ns)
        self._file.release()
        entry.file.wake_waiters()
        entry.file.close()
        entry.file, entry.station = self._file, station
        entry.tcp_ports.update(self._tcp_ports)
        return before

    def discard(self) -> None:
        """Abandon the replacement and remove its image."""
        self._file.discard()


def _new_tcp_ports(entry: EngineStation, spec: StationSpec) -> dict[str, TcpPort]:
    """Return the channels of ports that have not had any TCP so far."""
    return {
        port.name: open_tcp_port(port, entry.station.channel(port.name))
        for port in spec.ports
        if port.name not in entry.tcp_ports and has_tcp(spec, port)
    }


SWITCH_S = 1e-4
"""Wait of a cycle for the interpreter, each time that it releases it in a system call.

It wakes as often as that to ask again.  Where it shares a processor with the thread that builds, as
with ``--cpu``, an interval as short as such a wake-up takes (5 us were tried) leaves that thread no
time to release the interpreter, and both hang.
"""
MAX_WAITING = 64
_LOOK_S = 0.01
_SWAP_NS = 1_000_000
"""A swap begins so long before a cycle, or right after it."""

Reply = Callable[[EapError | None], None]


class _Job:
    """One request that is being served.

    Attributes:
        successor: The replacement that was built, if any.
        error: Reason that nothing was built, or that the swap failed.
        is_built: Whether the thread has made one of them.
        is_stale: Whether it has to be built again.
    """

    def __init__(self, entry: EngineStation, request: Configure, reply: Reply) -> None:
        self.entry = entry
        self.request = request
        self.reply = reply
        self.successor: StationReplacement | None = None
        self.error: EapError | None = None
        self.is_built = False
        self.is_stale = False
        self._before: Station | None = None
        self._taken = threading.Lock()

    def work(self, notify: Callable[[], object]) -> None:
        """Build and notify; then clean up after the take-over, and notify again."""
        self._taken = threading.Lock()
        self._taken.acquire()
        self._build()
        self.is_built = True
        notify()
        self._taken.acquire()
        self.successor = None
        if self._before is not None:
            # Here and not in the cycle's thread: freeing thousands of objects takes milliseconds.
            self._before.release()
            self._before = None
        notify()

    def finish(self, engine: Engine, now_ns: int) -> None:
        """Swap in the replacement, if there is one; note whether it has to be built again."""
        self.is_built = False
        successor = self.successor
        if successor is not None:
            self.is_stale = not successor.is_current
            if self.is_stale:
                successor.discard()  # PDs that shared an account have parted meanwhile
            else:
                self._put(successor, engine, now_ns)
        self.entry.update_tcp()
        self._taken.release()

    def abandon(self) -> None:
        """Abandon the job without a swap."""
        if self.is_built and self.successor is not None:
            self.successor.discard()
        if self._taken.locked():
            self._taken.release()

    def _build(self) -> None:
        self.is_stale = False
        try:
            spec = _read(self.request)
            if spec != self.entry.station.spec:
                self.successor = StationReplacement(self.entry, spec)
        except EngineRefusedError as exc:
            self.error = exc
        except Exception as exc:  # noqa: BLE001  no specification may end the engine
            text = str(exc) if isinstance(exc, EapError) else f"{type(exc).__name__}: {exc}"
            self.error = EngineRefusedError(f"station {self.request.station}: {text}")

    def _put(self, successor: StationReplacement, engine: Engine, now_ns: int) -> None:
        try:
            self._before = successor.take_over(engine, now_ns)
        except EapError as exc:
            successor.discard()
            self.error = exc


class StationRebuilder:
    """Reconfigures the *stations* of *engine* as services requests, one change after the other."""

    def __init__(self, engine: Engine, stations: dict[str, EngineStation]) -> None:
        self._engine = engine
        self._stations = stations
        self._waiting: deque[_Job] = deque()
        self._job: _Job | None = None
        self._thread: threading.Thread | None = None
        self._done = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self.is_ready = False
        """True if :meth:`swap` should be called after the next cycle."""

    @property
    def is_building(self) -> bool:
        """True if the thread runs."""
        return self._thread is not None

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the thread has made progress."""
        return self._done

    def close(self) -> None:
        """Wait for the thread, and abandon its result."""
        if self._job is not None and self._thread is not None:
            # Polled: the thread waits for `_taken` behind its build, so a join alone would hang.
            while not self._job.is_built and self._thread.is_alive():
                self._thread.join(_LOOK_S)
            self._job.abandon()
            self._thread.join()
        os.close(self._done)

    def serve(self, request: StationRequest, now_ns: int, reply: Reply) -> None:
        """Begin with *request*; *reply* is called when it is done, or could not be."""
        entry = self._stations.get(request.station)
        if entry is None:
            reply(EngineRefusedError(f"there is no station {request.station}"))
        elif isinstance(request, SetState):
            reply(_set_state(entry.station, request.state, now_ns))
        elif len(self._waiting) >= MAX_WAITING:
            reply(EngineRefusedError(f"{MAX_WAITING} changes wait already"))
        else:
            self._waiting.append(_Job(entry, request, reply))
            if self._thread is None:
                self._begin(self._waiting.popleft())

    def collect(self, now_ns: int) -> None:
        """Handle progress of the thread: swap now, or after the next cycle if that is near."""
        os.eventfd_read(self._done)
        job, thread = self._job, self._thread
        if job is None or thread is None:
            return
        if job.is_built:
            self.is_ready = True
            if self._engine.next_timeout() - now_ns > _SWAP_NS:
                self.swap(now_ns)
            return
        thread.join()
        self._thread = None
        sys.setswitchinterval(_USUAL_SWITCH_S)
        if job.is_stale:
            self._begin(job)
        elif self._waiting:
            self._begin(self._waiting.popleft())

    def swap(self, now_ns: int) -> None:
        """Swap in the replacement that was built."""
        self.is_ready = False
        job = self._job
        assert job is not None  # noqa: S101  is_ready said so
        job.finish(self._engine, now_ns)
        # The new objects live as long as the station: the collector need not look through them.
        gc.freeze()
        if not job.is_stale:
            job.reply(job.error)

    def _begin(self, job: _Job) -> None:
        self._job = job
        gc.collect()  # what is left is frozen afterwards, and nothing of it may be garbage
        sys.setswitchinterval(SWITCH_S)
        self._thread = threading.Thread(target=self._work, args=(job,), name="build")
        self._thread.start()

    def _work(self, job: _Job) -> None:
        realtime.lower_thread_priority()
        job.work(lambda: os.eventfd_write(self._done, 1))


_USUAL_SWITCH_S = sys.getswitchinterval()


def _read(request: Configure) -> StationSpec:
    try:
        return record_from_lines(Path(request.path).read_bytes(), StationSpec)
    except (OSError, ValueError, LookupError) as exc:
        raise EngineRefusedError(f"{request.path}: {exc}") from None


def _set_state(station: Station, state: int, now_ns: int) -> EapError | None:
    try:
        station.go(DeviceState(state), now_ns)
    except ValueError:
        return EngineRefusedError(f"there is no state {state}, expected 2, 4 or 8")
    except EapError as exc:
        return exc
    return None
