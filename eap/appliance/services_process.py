"""The services process: everything of an appliance that may take its time.

It is started by the supervisor with one argument, the descriptor of its handover.  Whatever happens
here, the engine goes on: the two share images, and pairs of sockets on which it never waits.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import sys
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from time import monotonic_ns
from typing import Any

from eap.appliance.aoe_desk import AoeDesk
from eap.appliance.bus_client import BusClient
from eap.appliance.bus_methods import Buses
from eap.appliance.control_server import ControlServer
from eap.appliance.discards import DiscardCounters, Refusal
from eap.appliance.engine_link import EngineLink
from eap.appliance.handover import (
    NO_DESCRIPTOR,
    Handover,
    PortName,
    SharedSocket,
    SocketKind,
    tell_ready,
)
from eap.appliance.intake import FrameIntake, watch_channel
from eap.appliance.methods import Methods
from eap.appliance.monitor_ways import open_ways
from eap.appliance.monitoring import SubscriberWatch
from eap.appliance.runtime import ApplianceFolder
from eap.appliance.segment_link import SegmentLink
from eap.appliance.sources import play_sources
from eap.appliance.station_image import StationImage
from eap.appliance.status import ProcessMeter, appliance_status
from eap.appliance.tcp_door import TcpDoor
from eap.errors import ConfigError, EapError, EnvironmentalError, ImageError
from eap.ids import InterfaceUri, NetId
from eap.net import realtime
from eap.net.ethernet import EthernetInterface, packet_batch
from eap.net.mmsg import ReceiveBatch
from eap.net.udp import UdpChannel
from eap.pd.spec import StationSpec

IMAGE_PATIENCE_S = 15.0
STATUS_PATIENCE_S = 0.3
"""How long ``status`` waits for what the engine says of its buses."""
_IMAGE_PAUSE_S = 0.01


class Services:
    """The objects of one services process, from its start to its end."""

    def __init__(self, handover: Handover, resources: ExitStack) -> None:
        self._handover = handover
        self._resources = resources
        self._folder = ApplianceFolder(Path(handover.folder))
        self._names = [station.name for station in handover.stations]
        self._counters = resources.enter_context(
            DiscardCounters(self._folder.discards("services"), self._names)
        )
        self._link = resources.enter_context(socket.socket(fileno=handover.link_fd))
        self._listener = resources.enter_context(socket.socket(fileno=handover.control_fd))
        self._batch = ReceiveBatch()
        self._stopping = asyncio.Event()
        self._desks = {
            station.name: AoeDesk({}, _net_ids(station)) for station in handover.stations
        }

    async def run(self) -> None:
        """Serve until SIGTERM."""
        images = {name: await self._open_image(name) for name in self._names}
        # Not before: whoever waits for images of an engine that failed just ends.
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, self._stopping.set)
        self._watch_sockets()
        buses = self._buses()
        server = ControlServer(self._methods(images, buses), buses)
        async with asyncio.TaskGroup() as group:
            tasks = [group.create_task(server.serve(self._listener))]
            tasks += [group.create_task(door.serve()) for door in self._doors()]
            tasks += [group.create_task(desk.serve()) for desk in self._desks.values()]
            watch = SubscriberWatch(images, open_ways(self._handover, self._resources))
            tasks.append(group.create_task(watch.run()))
            tasks += [
                group.create_task(play_sources(station, images[station.name]))
                for station in self._handover.stations
            ]
            tell_ready(self._handover.ready_fd, {})
            await self._stopping.wait()
            for task in tasks:
                task.cancel()

    async def _open_image(self, station: str) -> StationImage:
        """Open one image; at the first start the engine is just making it."""
        deadline_ns = monotonic_ns() + int(IMAGE_PATIENCE_S * 1e9)
        while True:
            try:
                image = StationImage(self._folder.image(station))
            except ImageError:
                if monotonic_ns() > deadline_ns:
                    raise
            else:
                self._resources.callback(image.close)
                return image
            await asyncio.sleep(_IMAGE_PAUSE_S)

    def _methods(self, images: dict[str, StationImage], buses: Buses) -> Methods:
        meter = ProcessMeter()
        engine = self._resources.enter_context(
            DiscardCounters(self._folder.discards("engine"), self._names)
        )
        release = version("eap-appliance")
        identity = {"release": release, "plant": self._handover.plant, "pid": os.getpid()}

        async def status() -> dict[str, Any]:
            return appliance_status(
                self._folder.read_info(),
                [each.image for each in images.values()],
                (engine.stats(), self._counters.stats()),
                meter,
                await buses.reports(STATUS_PATIENCE_S),
            )

        return Methods(
            identity,
            images,
            status=status,
            stop=lambda: os.kill(self._handover.supervisor, signal.SIGTERM),
        )

    def _buses(self) -> Buses:
        handover = self._handover
        if handover.bus_fd == NO_DESCRIPTOR:
            return Buses(handover.stations, None, {})
        link = EngineLink(socket.socket(fileno=handover.bus_fd))
        self._resources.callback(link.close)
        segments = {}
        for bus in handover.buses:
            if bus.command_fd != NO_DESCRIPTOR:
                segments[bus.owner] = SegmentLink(socket.socket(fileno=bus.command_fd))
                self._resources.callback(segments[bus.owner].close)
        client = BusClient(link, [bus.owner for bus in handover.buses])
        return Buses(handover.stations, client if handover.buses else None, segments)

    def _watch_sockets(self) -> None:
        now_ns = monotonic_ns()
        for shared in self._handover.sockets:
            if shared.kind is SocketKind.PACKET:
                self._watch_interface(shared, now_ns)
            elif shared.kind in {SocketKind.UDP, SocketKind.GROUP}:
                intake = FrameIntake(_stations_of(shared), self._counters, now_ns)
                channel = UdpChannel(
                    socket.socket(fileno=shared.services_fd), self._batch, [intake.take]
                )
                self._resources.callback(channel.close)
                watch_channel(channel)

    def _watch_interface(self, shared: SharedSocket, now_ns: int) -> None:
        interface = EthernetInterface(socket.socket(fileno=shared.services_fd), packet_batch())
        self._resources.callback(interface.close)
        for owner in shared.owners:
            intake = FrameIntake([owner.station], self._counters, now_ns)
            spec = self._handover.port(owner)
            port = interface.port(intake.take, vlan_id=spec.vlan_id, join=spec.join)
        watch_channel(port)

    def _doors(self) -> list[TcpDoor]:
        return [
            TcpDoor(
                self._resources.enter_context(socket.socket(fileno=shared.services_fd)),
                tuple(owner for owner in shared.owners if self._takes_tcp(owner)),
                self._link,
                _Refusals(self._counters, _stations_of(shared)).count,
                [self._desks[station] for station in _stations_of(shared)],
            )
            for shared in self._handover.sockets
            if shared.kind is SocketKind.TCP
        ]

    def _takes_tcp(self, name: PortName) -> bool:
        port = self._handover.port(name)
        return port.tcp or InterfaceUri.parse(port.interface).scheme == "tcp"


class _Refusals:
    """Counts connections that were closed, at every station behind the listener."""

    def __init__(self, counters: DiscardCounters, stations: list[str]) -> None:
        self._counters = counters
        self._stations = stations

    def count(self, reason: Refusal) -> None:
        for station in self._stations:
            self._counters.count(station, reason)


def _net_ids(station: StationSpec) -> list[NetId]:
    return [NetId.parse(text) for text in (station.net_id, *(p.net_id for p in station.ports))]


def _stations_of(shared: SharedSocket) -> list[str]:
    return list(dict.fromkeys(owner.station for owner in shared.owners))


def main() -> int:
    """Return the exit code: 2 for what this machine or the specification lacks."""
    handover = Handover.from_descriptor(int(sys.argv[1]))
    realtime.die_with_parent(handover.supervisor)
    logging.basicConfig(format="services: %(message)s", level=logging.INFO)
    try:
        with ExitStack() as resources:
            asyncio.run(_serve(handover, resources))
    except EapError as exc:
        sys.stderr.write(f"services: {exc}\n")
        return 2 if isinstance(exc, (ConfigError, EnvironmentalError)) else 1
    return 0


async def _serve(handover: Handover, resources: ExitStack) -> None:
    await Services(handover, resources).run()


if __name__ == "__main__":
    sys.exit(main())
