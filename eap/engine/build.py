"""Construction of an engine from specifications and descriptors: stations, channels and buses."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from msgspec.structs import replace

from eap.engine.bus_requests import BusRequestHandler
from eap.engine.channels import PortChannels
from eap.engine.engine_buses import EngineBuses
from eap.engine.frame_taps import FrameRecording
from eap.engine.rebuild import EngineStation, StationRebuilder
from eap.net.framering_file import FrameRingFile
from eap.net.image_file import create_image
from eap.pd.authentication import KeyRing
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
from eap.runtime.passing import PassedConnection, PassedDescriptor, PassedLine
from eap.runtime.startup import Step, no_step


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
            station = Station(spec, file.image, file.wake_waiters, KeyRing())
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
        step("building buses")
        self.buses = EngineBuses(self.arrivals, self.engine)
        self._resources.callback(self.buses.close)
        for given in handover.buses:
            self._add_lines(given)
        for entry in self._stations.values():
            self.buses.open_all(entry)
        self.rebuilder = StationRebuilder(self.engine, self._stations, self._channels, self.buses)
        self._resources.callback(self.rebuilder.close)
        self.arrivals[self.rebuilder.fileno()] = self.rebuilder.collect
        if handover.bus_fd != NO_DESCRIPTOR:
            sock = socket.socket(fileno=handover.bus_fd)
            self.buses.serve(BusRequestHandler(sock, self.rebuilder.serve))

    def start(self, now_ns: int) -> None:
        """Bring all stations to their states, and publish the pid of the engine in their images."""
        for entry in self._stations.values():
            entry.file.image.words[StationWord.ENGINE_PID] = os.getpid()
        self.engine.start(now_ns, self._handover.states)
        self.buses.start(now_ns)

    def take(self, sock: socket.socket, passed: PassedDescriptor) -> None:
        """Take what services passed: a connection, or a socket for ports that come later."""
        match passed:
            case PassedConnection():
                self._channels.add_connection(sock, passed, self._handler)
            case PassedLine():
                self.buses.add_line(sock, passed)
            case _:
                self._channels.add_socket(passed.socket, sock)

    def _add_lines(self, given: BusSocket) -> None:
        bus = replace(given.key, number=given.number)
        for is_second, fd in ((False, given.engine_fd), (True, given.second_fd)):
            if fd != NO_DESCRIPTOR:
                self.buses.add_line(socket.socket(fileno=fd), PassedLine(bus, is_second))

    def image(self, station: str) -> Image:
        """Return the process image of a station as it is now."""
        return self._stations[station].file.image

    def look_at_keys(self) -> None:
        """Take the keys of files that have changed, and follow the clock of the host."""
        for entry in self._stations.values():
            if entry.station.spec.pd_keys:
                entry.look_at_keys()

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
