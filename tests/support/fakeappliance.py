"""An appliance to talk to: a real control server on real images, its engine's buses in memory."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Sequence
from contextlib import ExitStack
from time import monotonic_ns
from typing import Any

import msgspec

from devicebus.wire.alstatus import AlState
from eap.control.protocol import encode_request
from eap.ids import InterfaceUri, NetId
from eap.net.image_file import ImageFile, StationImage, create_image
from eap.pd.layout import plan_layout
from eap.pd.spec import (
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from eap.pd.words import RxWord, StationWord
from eap.runtime.folder import ApplianceFolder, ApplianceInfo, ProcessInfo
from eap.runtime.handover import PortName
from eap.services.control.bus_methods import Buses, bus_reports
from eap.services.control.control_server import ControlServer
from eap.services.control.methods import Methods
from eap.services.control.status import ProcessMeter, appliance_status
from eap.services.engine_link import EngineLink
from eap.services.slaves.segment_link import SegmentLink
from eap.services.transports.accepting import Listeners
from tests.support.fakeengine import FakeBus, FakeEngine, FakeSegment, bus_clients
from tests.support.loopbus import LoopBus


def station(name: str) -> StationSpec:
    return StationSpec(
        name=name,
        net_id=NetId.parse("1.1.1.1.1.1"),
        cycle_us=10_000,
        ports=(
            PortSpec(
                "eap0",
                PortKind.EAP,
                InterfaceUri.parse("udp://127.0.9.1"),
                NetId.parse("1.1.1.1.2.1"),
            ),
        ),
        variables=(
            VariableSpec("ticks", "UDINT", Writer.ENGINE),
            VariableSpec("setpoint", "INT", default=7, unit="1/min"),
            VariableSpec("curve", "REAL[2]"),
            VariableSpec("level", "INT", Writer.ENGINE),
            VariableSpec("silent", "INT", Writer.ENGINE),
        ),
        frames=(
            TxFrameSpec(
                "to-right", "eap0", "239.1.2.3", (TxPdSpec("state", 101, ("ticks", "setpoint"), 3),)
            ),
        ),
        subscriptions=(
            RxPdSpec("left", "eap0", 102, ("level",), publisher="2.1.1.1.2.1", step=1),
            RxPdSpec("other", "eap0", 103, ("silent",)),
        ),
    )


def with_buses(spec: StationSpec, names: list[str]) -> StationSpec:
    """Return a station that has bus ports too."""
    ports = [
        PortSpec(name, PortKind.BUS, InterfaceUri.parse("sim://x.yaml"), NetId.parse("1.1.1.1.3.1"))
        for name in names
    ]
    return msgspec.structs.replace(spec, ports=(*spec.ports, *ports))


class Appliance:
    """A plant's folder, images and control server; the server runs in a thread.

    Args:
        plant: Its name.
        names: Of its stations.
        stack: Ends it.
        buses: Names of bus files; the first station has a port for each, bus0 and so on.

    Attributes:
        engine: Once it serves.
    """

    engine: FakeEngine

    def __init__(
        self, plant: str, names: list[str], stack: ExitStack, buses: Sequence[str] = ()
    ) -> None:
        self.lines = [LoopBus(name) for name in buses]
        ports = [f"bus{number}" for number in range(len(buses))]
        self._specs = {
            name: with_buses(station(name), ports if name == names[0] else []) for name in names
        }
        self._ports = [PortName(names[0], port) for port in ports]
        folder = stack.enter_context(ApplianceFolder.claim(plant))
        self.info = ApplianceInfo(
            plant=plant,
            plant_file=f"{plant}.yaml",
            stations=names,
            started_at="2026-01-01T00:00:00+00:00",
            supervisor=1,
            engine=ProcessInfo(pid=1, restarts=2, report={"realtime": {"scheduler": "fifo 50"}}),
        )
        folder.write_info(self.info)
        self.files = {
            name: stack.enter_context(
                create_image(folder.image(name), plan_layout(self._specs[name]))
            )
            for name in names
        }
        self.images = {name: StationImage(folder.image(name)) for name in names}
        for name, file in self.files.items():
            _receive(file)
            stack.callback(self.images[name].close)
        self._listener = stack.enter_context(socket.socket(socket.AF_UNIX))
        self._listener.bind(str(folder.control_socket))
        self._listener.listen()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        stack.callback(self.stop)

    def set(self, name: str, variable: str, value: object) -> None:
        """Write a variable as the engine does."""
        image = self.files[name].image
        with image.writing(Writer.ENGINE):
            image.write(variable, value)

    def stop(self) -> None:
        """End the server; clients see their connection close."""
        if self._thread.is_alive():
            self.wait_served()
            self._loop.call_soon_threadsafe(self._task.cancel)
            self._thread.join()

    def wait_served(self) -> None:
        """Be served once: its buses are up, and whoever connected before has a task of its own."""
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(self._listener.getsockname())
            connection.sendall(encode_request(1, "hello", {}))
            connection.recv(1)

    def _run(self) -> None:
        self._task = self._loop.create_task(self._serve())
        try:
            self._loop.run_until_complete(self._task)
        except asyncio.CancelledError:
            pass
        finally:
            self._loop.run_until_complete(self._loop.shutdown_asyncgens())
            self._loop.close()

    async def _serve(self) -> None:
        engine = self.engine = FakeEngine(*(FakeBus(line, AlState.OP) for line in self.lines))
        segments = {
            port: FakeSegment(line) for port, line in zip(self._ports, self.lines, strict=True)
        }
        link = EngineLink(engine.services)
        links = {port: SegmentLink(segment.services) for port, segment in segments.items()}
        clients = bus_clients(link, *self._ports)
        buses = Buses(self._specs, clients, links)
        meter = ProcessMeter()
        images = [each.image for each in self.images.values()]

        async def status() -> dict[str, Any]:
            reports = await bus_reports(clients, 1)
            return appliance_status(self.info, images, {}, meter, reports)

        methods = Methods({"plant": self.info.plant}, self.images, status=status, stop=lambda: None)
        try:
            await ControlServer(methods, buses).serve(self._listener, Listeners())
        finally:
            for each in (link, engine, *links.values(), *segments.values()):
                each.close()


def _receive(file: ImageFile) -> None:
    """Leave the traces of 5 PDs taken, the last one 3 cycles ago."""
    image = file.image
    image.words[StationWord.CYCLE] = 1000
    image.words[StationWord.STATE] = 8
    for place in image.layout.rx:
        image.words[place.words + RxWord.TRACKER] = place.words
    left = image.layout.rx[0].words
    image.words[left + RxWord.RECEIVED] = 5
    image.words[left + RxWord.ARRIVED_IN_CYCLE] = 997
    image.words[left + RxWord.ARRIVED_AT_NS] = monotonic_ns()
