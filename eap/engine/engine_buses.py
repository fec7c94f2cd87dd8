"""Buses of an engine, by their numbers in requests; they come and go while stations run.

Services passes the lines of a bus before a station is to use it.  The thread that rebuilds the
station makes the bus; the thread of the cycles then enters it, and removes those that are gone.
The slaves of a removed bus are brought to INIT beside the cycles.
"""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple, Protocol

from devicebus.master.procedure import Task
from eap.engine.bus_requests import BusRequestHandler
from eap.engine.bus_settings import epoch_offset_ns, master_settings
from eap.engine.engine_bus import EngineBus
from eap.errors import EngineRefusedError
from eap.ids import InterfaceUri
from eap.net.busport import BusPort
from eap.pd.engine import Engine
from eap.pd.spec import PortSpec
from eap.pd.station import Station
from eap.runtime.handover import BusSocket
from eap.runtime.passing import PassedLine
from eap.runtime.socket_plan import bus_of

REST_NS = 300_000_000
"""Limit for bringing slaves to INIT when their bus, or the engine, ends."""


class _Lines:
    """Sockets of a bus that no station uses yet."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.sockets: dict[bool, socket.socket] = {}
        """The second line under True."""

    def close(self) -> None:
        for sock in self.sockets.values():
            sock.close()


class _RunningBus(NamedTuple):
    """A bus that a station uses."""

    number: int
    key: BusSocket
    bus: EngineBus


class _LeavingBus(NamedTuple):
    """A bus that no station uses any more, whose slaves are brought to INIT."""

    task: Task[None]
    end_ns: int
    row: _RunningBus


class StationBuses(Protocol):
    """A station of the engine with its buses."""

    station: Station
    buses: dict[str, EngineBus]
    """By port."""

    def set_step(self, step_ns: int) -> None:
        """Set the distance from the present cycle to the next."""


class EngineBuses:
    """The buses of an engine.

    Args:
        arrivals: Callbacks for readable descriptors; those of the buses come and go in it.
        engine: Runs the timers of buses between cycles.

    Attributes:
        requests: Takes requests of services; None in a test without services.
        on_change: Called when descriptors have come or are about to be closed.
    """

    def __init__(self, arrivals: dict[int, Callable[[int], object]], engine: Engine) -> None:
        self.requests: BusRequestHandler | None = None
        self.on_change: list[Callable[[], object]] = []
        self._arrivals = arrivals
        self._engine = engine
        self._lines: dict[BusSocket, _Lines] = {}
        self._running: dict[EngineBus, _RunningBus] = {}
        self._leaving: list[_LeavingBus] = []
        self._waiting: list[_RunningBus] = []
        """Buses that start when one at the same port has left."""

    def serve(self, requests: BusRequestHandler) -> None:
        """Have *requests* reach the buses."""
        self.requests = requests
        self._arrivals[requests.fileno()] = requests.serve
        for row in self._running.values():
            requests.add(row.number, row.bus)

    def add_line(self, sock: socket.socket, passed: PassedLine) -> None:
        """Keep the socket of a bus that comes later; one that is here already is closed."""
        number, key = passed.bus.number, passed.bus.key
        if any(each.number == number for each in self._running.values()):
            sock.close()
            return
        lines = self._lines.get(key)
        if lines is None or lines.number != number:
            if lines is not None:
                lines.close()  # the supervisor has closed that bus meanwhile
            lines = self._lines[key] = _Lines(number)
        if passed.is_second in lines.sockets:
            sock.close()
        else:
            lines.sockets[passed.is_second] = sock

    def key_of(self, bus: EngineBus) -> BusSocket:
        """Return the key of a bus that a station uses."""
        return self._running[bus].key

    def make(self, entry: StationBuses, station: Station, port: PortSpec) -> EngineBus:
        """Return the bus at *port* of *station*, the next one of *entry*.

        It is in effect once it is entered.

        Raises:
            EngineRefusedError: services has passed no socket for it.
        """
        spec = station.spec
        lines = self._lines.get(bus_of(spec.name, port))
        wanted = [False, True] if port.bus is not None and port.bus.redundant else [False]
        if lines is None or any(each not in lines.sockets for each in wanted):
            raise EngineRefusedError(f"port {port.name}: the socket of its bus is missing")
        first = BusPort(lines.sockets[False], interface=port.interface.host)
        second = None
        if True in lines.sockets and port.bus is not None:
            redundant = InterfaceUri.parse(port.bus.redundant)
            second = BusPort(lines.sockets[True], interface=redundant.host, source=first.source)
        return EngineBus(
            port,
            master_settings(port, spec.cycle_us, epoch_offset_ns()),
            station.cycle_ns,
            station.image,
            station.memory_of,
            first,
            second,
            entry.set_step,
        )

    def open_all(self, entry: StationBuses) -> None:
        """Make and enter the buses of a station that has not started yet."""
        station = entry.station
        for port in station.spec.ports:
            if port.bus is not None:
                bus = self.make(entry, station, port)
                station.connect_bus(bus)
                self._enter(entry, port.name, bus)

    def start(self, now_ns: int) -> None:
        """Announce a new engine to services, and begin to bring all buses up."""
        if self.requests is not None:
            self.requests.announce()
        for bus in self._running:
            bus.start(now_ns)

    def exchange(
        self,
        entry: StationBuses,
        gone: Sequence[EngineBus],
        added: Mapping[str, EngineBus],
        now_ns: int,
    ) -> None:
        """Take the buses that are *gone* out of a station, and enter those that are *added*."""
        for bus in gone:
            self._remove(entry, bus, now_ns)
        for port, bus in added.items():
            row = self._enter(entry, port, bus)
            if any(each.row.key.owner == row.key.owner for each in self._leaving):
                self._waiting.append(row)  # two masters would disturb each other
            else:
                bus.start(now_ns)
        self._notify()

    def close_unused(self, station: str) -> None:
        """Close the lines for *station* that it does not use: a change was refused."""
        for key in [each for each in self._lines if each.owner.station == station]:
            self._lines.pop(key).close()

    def publish(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """Send the changes on the buses to services; close buses that have left."""
        if self.requests is not None:
            self.requests.publish()
        if self._leaving:
            self._end_leaving(clock())

    def rest(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """Bring all slaves to INIT, or as far as they get in REST_NS."""
        now_ns = clock()
        # Slaves that do not answer must not delay the end: their watchdogs stop the outputs too.
        end_ns = now_ns + REST_NS
        tasks = {bus: bus.shut_down(now_ns) for bus in self._running}
        while (now_ns := clock()) < end_ns:
            waiting = [bus for bus, task in tasks.items() if not task.is_done]
            if not waiting:
                return
            times = [end_ns, *(at for bus in waiting if (at := bus.next_timeout()) is not None)]
            lines = [fd for bus in waiting for fd in bus.filenos()]
            select.select(lines, [], [], max(0, min(times) - now_ns) / 1e9)
            for bus in waiting:
                bus.drain(clock())
                bus.handle_timeout(clock())

    def close(self) -> None:
        """Close all sockets."""
        for bus in (*self._running, *(each.row.bus for each in self._leaving)):
            bus.close()
        for lines in self._lines.values():
            lines.close()
        if self.requests is not None:
            self.requests.close()

    def _enter(self, entry: StationBuses, port: str, bus: EngineBus) -> _RunningBus:
        spec = entry.station.spec
        key = bus_of(spec.name, next(each for each in spec.ports if each.name == port))
        row = _RunningBus(self._lines.pop(key).number, key, bus)
        self._running[bus] = row
        entry.buses[port] = bus
        self._arrivals.update((fd, bus.drain) for fd in bus.filenos())
        bus.listen = partial(self._listen, bus)
        if self.requests is not None:
            self.requests.add(row.number, bus)
        return row

    def _listen(self, bus: EngineBus, is_on: bool) -> None:
        for fd in bus.filenos():
            if is_on:
                self._arrivals[fd] = bus.drain
            else:
                self._arrivals.pop(fd, None)
        self._notify()

    def _remove(self, entry: StationBuses, bus: EngineBus, now_ns: int) -> None:
        row = self._running.pop(bus)
        for port in [name for name, each in entry.buses.items() if each is bus]:
            del entry.buses[port]
        if self.requests is not None:
            self.requests.remove(row.number)
        bus.fail_tasks("the bus was removed from the plant")
        self._waiting = [each for each in self._waiting if each is not row]
        task = bus.shut_down(now_ns)
        self._leaving.append(_LeavingBus(task, now_ns + REST_NS, row))
        self._engine.run_also([each.row.bus for each in self._leaving])

    def _end_leaving(self, now_ns: int) -> None:
        """Close the buses whose slaves are in INIT, or whose time is over; start their heirs."""
        left = [each for each in self._leaving if each.task.is_done or now_ns >= each.end_ns]
        if not left:
            return
        self._leaving = [each for each in self._leaving if each not in left]
        self._engine.run_also([each.row.bus for each in self._leaving])
        for each in left:
            for fd in each.row.bus.filenos():
                self._arrivals.pop(fd, None)
        self._notify()
        for each in left:
            each.row.bus.close()
        owners = {each.row.key.owner for each in self._leaving}
        ready = [row for row in self._waiting if row.key.owner not in owners]
        self._waiting = [row for row in self._waiting if row.key.owner in owners]
        for row in ready:
            row.bus.start(now_ns)

    def _notify(self) -> None:
        for notify in self.on_change:
            notify()
