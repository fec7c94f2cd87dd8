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
from eap.engine.channels import PortChannels, engine_sockets, has_tcp
from eap.engine.engine_bus import BusSuccessor, EngineBus
from eap.engine.engine_buses import EngineBuses
from eap.engine.key_files import KeyFile
from eap.errors import EapError, EngineRefusedError
from eap.net import realtime
from eap.net.image_file import ImageFile, prepare_image
from eap.net.tcpport import TcpPort
from eap.pd.device import DeviceState
from eap.pd.engine import Engine
from eap.pd.handover import (
    ImageHandover,
    PortChanges,
    needs_new_start,
    port_changes,
    restarting_buses,
)
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, StationSpec, record_from_lines
from eap.pd.station import Station
from eap.pd.words import StationWord
from eap.runtime.engine_messages import Configure, SetState, StationRequest
from eap.runtime.handover import PortName, SharedSocket
from eap.runtime.socket_plan import bus_of


class EngineStation:
    """A station of the engine and its image; both are replaced together."""

    def __init__(self, station: Station, file: ImageFile, channels: PortChannels) -> None:
        self.station = station
        self.file = file
        self.channels = channels
        self.buses: dict[str, EngineBus] = {}
        """By port."""
        self.key_file = KeyFile(station.spec.name, station.spec.pd_keys)
        self.follow_keys()

    def look_at_keys(self) -> None:
        """Follow the file of keys if it has changed, and the clock of the host."""
        self.key_file.look()
        self.follow_keys()

    def follow_keys(self) -> None:
        """Sign and check with the keys of the present file from now on."""
        ring = self.station.keys
        ring.keys = self.key_file.keys
        ring.epoch_offset_ns = epoch_offset_ns()
        self.file.image.words[StationWord.SIGNING_KEY] = ring.keys.signing

    def open_ports(self) -> None:
        """Open and connect all EAP ports, before the station starts."""
        station = self.station
        for port in station.spec.ports:
            if port.kind is PortKind.EAP:
                opened = self.channels.open(station.spec, port, station.handlers[port.name])
                station.connect(port.name, opened.channel, opened.groups)
                self.channels.enter(opened)
        self.channels.update_tcp(station)

    def set_step(self, step_ns: int) -> None:
        """Set the distance from the present cycle to the next, as a clock of a bus wants it."""
        self.station.step_ns = step_ns


class StationReplacement:
    """Replacement of a station with another specification, built in a thread.

    Raises:
        EngineRefusedError: this cannot be done without a new start.
        EapError, ValueError, LookupError: the specification is not that of a station.
    """

    def __init__(self, entry: EngineStation, spec: StationSpec, buses: EngineBuses) -> None:
        before = entry.station
        if reasons := needs_new_start(before.spec, spec):
            raise EngineRefusedError("\n".join(reasons))
        self._entry = entry
        self._buses = buses
        self._changes = port_changes(before.spec, spec)
        self._file = prepare_image(entry.file.path, plan_layout(spec), entry.file.generation + 1)
        try:
            image = self._file.image
            replaced = {port.name for port in self._changes.gone}
            self._images = ImageHandover(before.image, image, replaced)
            # Before Station(): its subscribers read from the words which trackers they share.
            self._images.carry_words()
            self._images.carry_values(before.inputs.memory)
            # The ring stays: its counter must rise over the change.
            keys = before.keys
            self._station = station = Station(spec, image, self._file.wake_waiters, keys)
            self._key_file = entry.key_file
            if spec.pd_keys != before.spec.pd_keys:
                self._key_file = KeyFile(spec.name, spec.pd_keys)
            self._opened = [
                entry.channels.open(spec, port, station.handlers[port.name])
                for port in self._changes.added
            ]
            self._tcp_ports = _new_tcp_ports(entry, spec, self._changes)
            added = {each.name.port: (each.channel, each.groups) for each in self._opened}
            self._prepare_buses()
            station.prepare_handover(before, added, self._tcp_ports, self._connected)
            self._images.commit()
        except BaseException:
            self.discard()
            raise

    def _prepare_buses(self) -> None:
        """Make the buses that are new, and the other parts of those that stay."""
        entry, station = self._entry, self._station
        spec, image = station.spec, station.image
        self._connected: list[EngineBus] = []
        self._added_buses: dict[str, EngineBus] = {}
        self._mappings: list[tuple[EngineBus, BusMapping]] = []
        self._restarts: list[tuple[EngineBus, BusSuccessor]] = []
        self._old_masters: list[Master] = []
        restarting = restarting_buses(entry.station.spec, spec)
        for port in spec.ports:
            if port.bus is None:
                continue
            bus = entry.buses.get(port.name)
            if bus is None or self._buses.key_of(bus) != bus_of(spec.name, port):
                bus = self._added_buses[port.name] = self._buses.make(entry, station, port)
            elif port.name in restarting:
                settings = master_settings(port, spec.cycle_us, epoch_offset_ns())
                successor = bus.prepare_restart(port, settings, image, station.memory_of)
                self._restarts.append((bus, successor))
            else:
                self._mappings.append((bus, bus.prepare_mapping(port, image, station.memory_of)))
            self._connected.append(bus)

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
        channels, name = entry.channels, station.spec.name
        # Recordings take the new ports up by themselves.
        before.untap([port.name for port in self._changes.gone])
        station.follow(before, now_ns)
        channels.exchange([PortName(name, port.name) for port in self._changes.gone], self._opened)
        for port_name, tcp in self._tcp_ports.items():
            channels.enter_tcp(PortName(name, port_name), tcp)
        for bus, mapping in self._mappings:
            bus.swap_mapping(mapping)
        self._old_masters = [bus.restart(parts, now_ns) for bus, parts in self._restarts]
        engine.replace(before, station, now_ns)
        self._file.release()
        entry.file.wake_waiters()
        entry.file.close()
        entry.file, entry.station, entry.key_file = self._file, station, self._key_file
        entry.follow_keys()
        gone = [bus for bus in entry.buses.values() if bus not in self._connected]
        if gone or self._added_buses:
            self._buses.exchange(entry, gone, self._added_buses, now_ns)
        return before

    def discard(self) -> None:
        """Abandon the replacement and remove its image."""
        self._file.discard()


def _new_tcp_ports(
    entry: EngineStation, spec: StationSpec, changes: PortChanges
) -> dict[str, TcpPort]:
    """Return the channels of ports that stay and have not had any TCP so far."""
    return {
        port.name: TcpPort(port.interface.host, entry.station.channel(port.name))
        for port in spec.ports
        if port not in changes.added
        and not entry.channels.has_tcp(PortName(spec.name, port.name))
        and has_tcp(spec, port)
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
        sockets: Those that the ports of the requested specification need.
        unused: Those without a port when it began.
    """

    def __init__(
        self, entry: EngineStation, request: Configure, reply: Reply, buses: EngineBuses
    ) -> None:
        self.entry = entry
        self.request = request
        self.reply = reply
        self.successor: StationReplacement | None = None
        self.error: EapError | None = None
        self.is_built = False
        self.is_stale = False
        self.sockets: list[SharedSocket] = []
        self.unused: tuple[SharedSocket, ...] = ()
        self._buses = buses
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
        try:
            if successor is not None:
                self.is_stale = not successor.is_current
                if self.is_stale:
                    successor.discard()  # PDs that shared an account have parted meanwhile
                else:
                    self._put(successor, engine, now_ns)
            self.entry.channels.update_tcp(self.entry.station)
        finally:
            self._taken.release()  # an engine that fails here would wait for its thread forever

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
            self.sockets = engine_sockets(spec)
            if spec != self.entry.station.spec:
                self.successor = StationReplacement(self.entry, spec, self._buses)
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
    """Reconfigures the *stations* of *engine* as services requests, one change after the other.

    Attributes:
        on_swap: Called when the ports of a station may have changed.
        receive_sockets: Takes all sockets that services has passed, before a request that may need
            them.
    """

    def __init__(
        self,
        engine: Engine,
        stations: dict[str, EngineStation],
        channels: PortChannels,
        buses: EngineBuses,
    ) -> None:
        self._buses = buses
        self._engine = engine
        self._stations = stations
        self._channels = channels
        self.on_swap: list[Callable[[], object]] = []
        self.receive_sockets: Callable[[], object] = int
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
            self.receive_sockets()
            self._waiting.append(_Job(entry, request, reply, self._buses))
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
            self._channels.close_unused(job.sockets)
            if not self._waiting:
                # Passed for a request that never came, because services or an engine was killed.
                self._channels.close_unused(job.unused)
            self._buses.close_unused(job.entry.station.spec.name)
            for notify in self.on_swap:
                notify()
            job.reply(job.error)

    def _begin(self, job: _Job) -> None:
        self._job = job
        job.unused = self._channels.unused
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
