"""Construction of an engine from specifications and descriptors: stations, channels and buses."""

from __future__ import annotations

import os
import select
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from eap.engine.bus_requests import BusRequestHandler, ServeStation
from eap.engine.bus_settings import epoch_offset_ns, master_settings
from eap.engine.channels import PortChannels
from eap.engine.engine_bus import EngineBus
from eap.engine.frame_taps import FrameRecording
from eap.engine.rebuild import EngineStation, StationRebuilder
from eap.ids import InterfaceUri
from eap.net.busport import BusPort
from eap.net.framering_file import FrameRingFile
from eap.net.image_file import create_image
from eap.pd.engine import Engine
from eap.pd.image import Image
from eap.pd.layout import plan_layout
from eap.pd.link import FrameHandler
from eap.pd.station import Station
from eap.pd.words import StationWord
from eap.runtime.drop_counters import DropCounters
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import (
    NO_DESCRIPTOR,
    BusSocket,
    Handover,
    PortName,
)
from eap.runtime.passing import PassedConnection, PassedDescriptor
from eap.runtime.startup import Step, no_step

REST_NS = 300_000_000
"""Limit for bringing slaves to INIT when the engine ends."""


class EngineBuses:
    """The buses of *stations*.

    Attributes:
        buses: By their numbers in requests.
        requests: Takes requests of services; None in a test without services.
        arrivals: Callbacks for readable descriptors.
    """

    def __init__(
        self,
        handover: Handover,
        stations: Mapping[str, EngineStation],
        serve_station: ServeStation,
    ) -> None:
        self._handover = handover
        self.buses = {
            given.number: self._make(given, stations[given.owner.station])
            for given in handover.buses
        }
        self.requests: BusRequestHandler | None = None
        self.arrivals: dict[int, Callable[[int], None]] = {
            fd: bus.drain for bus in self.buses.values() for fd in bus.filenos()
        }
        if handover.bus_fd != NO_DESCRIPTOR:
            self.requests = BusRequestHandler(socket.socket(fileno=handover.bus_fd), serve_station)
            self.arrivals[self.requests.fileno()] = self.requests.serve
            for number, bus in self.buses.items():
                self.requests.add(number, bus)

    def start(self, now_ns: int) -> None:
        """Begin to bring all buses up."""
        if self.requests is not None:
            self.requests.announce()
        for bus in self.buses.values():
            bus.start(now_ns)

    def publish(self) -> None:
        """Send the changes on the buses to services."""
        if self.requests is not None:
            self.requests.publish()

    def rest(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """Bring all slaves to INIT, or as far as they get in REST_NS."""
        now_ns = clock()
        # Slaves that do not answer must not delay the end: their watchdogs stop the outputs too.
        end_ns = now_ns + REST_NS
        tasks = {bus: bus.shut_down(now_ns) for bus in self.buses.values()}
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
        for bus in self.buses.values():
            bus.close()
        if self.requests is not None:
            self.requests.close()

    def _make(self, given: BusSocket, entry: EngineStation) -> EngineBus:
        port = self._handover.port(given.owner)
        station = entry.station
        first = BusPort(socket.socket(fileno=given.engine_fd), interface=port.interface.host)
        second = None
        if given.second_fd != NO_DESCRIPTOR:
            redundant = InterfaceUri.parse(port.bus.redundant) if port.bus else port.interface
            second = BusPort(
                socket.socket(fileno=given.second_fd),
                interface=redundant.host,
                source=first.source,
            )
        bus = EngineBus(
            port,
            master_settings(port, station.spec.cycle_us, epoch_offset_ns()),
            station.cycle_ns,
            station.image,
            station.memory_of,
            first,
            second,
            entry.set_step,
        )
        station.connect_bus(bus)
        entry.buses[port.name] = bus
        return bus


class EnginePlant:
    """All stations of one engine process, with their images and channels.

    Args:
        handover: Specifications and descriptors.
        step: Called with the name of each step before it.

    Attributes:
        engine: Runs them.
        recording: Records their frames while somebody reads them.
        rebuilder: Changes them while they run.
        buses: The slaves below them.
        arrivals: Callbacks for descriptors that are served between the cycles.
    """

    def __init__(self, handover: Handover, *, step: Step = no_step) -> None:
        self.arrivals: dict[int, Callable[[int], object]] = {}
        self._resources = ExitStack()
        self._handover = handover
        folder = ApplianceFolder(Path(handover.folder))
        self._stations: dict[str, EngineStation] = {}
        counters = self._resources.enter_context(
            DropCounters(folder.discards("engine"), [s.name for s in handover.stations])
        )
        self._channels = PortChannels(counters, self.arrivals)
        self._resources.callback(self._channels.close)
        for spec in handover.stations:
            step(f"building station {spec.name}")
            file = create_image(folder.image(spec.name), plan_layout(spec))
            station = Station(spec, file.image, file.wake_waiters)
            self._stations[spec.name] = EngineStation(station, file, self._channels)
        step("opening ports")
        for shared in handover.sockets:
            if shared.engine_fd != NO_DESCRIPTOR:
                self._channels.add_socket(shared.key, socket.socket(fileno=shared.engine_fd))
        for entry in self._stations.values():
            entry.open_ports()
        self.engine = Engine([entry.station for entry in self._stations.values()])
        ring = self._resources.enter_context(FrameRingFile(folder.frames))
        self.recording = FrameRecording(ring, self._stations)
        self.rebuilder = StationRebuilder(self.engine, self._stations, self._channels)
        self._resources.callback(self.rebuilder.close)
        self.arrivals[self.rebuilder.fileno()] = self.rebuilder.collect
        step("building buses")
        self.buses = EngineBuses(handover, self._stations, self.rebuilder.serve)
        self._resources.callback(self.buses.close)
        self.arrivals.update(self.buses.arrivals)

    def start(self, now_ns: int) -> None:
        """Bring all stations to their states, and publish the pid of the engine in their images."""
        for entry in self._stations.values():
            entry.file.image.words[StationWord.ENGINE_PID] = os.getpid()
        self.engine.start(now_ns, self._handover.states)
        self.buses.start(now_ns)

    def take(self, sock: socket.socket, passed: PassedDescriptor) -> None:
        """Take what services passed: a connection, or a socket for ports that come later."""
        if isinstance(passed, PassedConnection):
            self._channels.add_connection(sock, passed, self._handler)
        else:
            self._channels.add_socket(passed.socket, sock)

    def image(self, station: str) -> Image:
        """Return the process image of a station as it is now."""
        return self._stations[station].file.image

    def publish_discards(self) -> None:
        """Add the frames that the interfaces dropped since the last call to the counters."""
        self._channels.publish_discards()

    def stop(self) -> None:
        """Bring all stations out of Op and wake programs that wait for a next cycle.

        Slaves are brought to INIT, for at most REST_NS.
        """
        self.engine.stop()
        self.buses.rest()
        for entry in self._stations.values():
            entry.file.image.words[StationWord.ENGINE_PID] = 0
            entry.file.wake_waiters()

    def close(self) -> None:
        """Release all sockets and images."""
        self._resources.close()
        for entry in self._stations.values():
            entry.file.close()

    def _handler(self, name: PortName) -> FrameHandler:
        return self._stations[name.station].station.handlers[name.port]
