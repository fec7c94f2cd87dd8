"""A bus port of an engine on simulated slaves: in memory, on a virtual clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from pathlib import Path

import msgspec

from devicebus.sim.spec import FaultSpec
from devicebus.wire.alstatus import AlState
from eap.engine.bus_settings import master_settings
from eap.engine.engine_bus import EngineBus
from eap.errors import EnvironmentalError
from eap.pd.spec import StationSpec, Writer
from eap.runtime.busfile import load_or_raise
from eap.runtime.plantfile import load_plant
from tests.support.cyclic import MS, image_of

US = 1_000
TRIP_NS = 30 * US

PLANT = """
plant: p
stations:
  - name: one
    net_id: 5.1.1.1.1.1
    cycle_us: {cycle_us}
    ports:
      - {{name: eap0, kind: eap, interface: "loop://x", net_id: 5.1.1.1.2.1}}
      - name: bus0
        kind: bus
        interface: sim://bus.yaml
        net_id: 5.1.1.1.3.1
        target: {target}
"""
BUS = """
bus: b
slaves:
  - {name: coupler, kind: coupler}
  - name: io
    kind: digital
    inputs: [{name: echo, follows: lamp}, {name: button}]
    outputs: [{name: valve}, {name: lamp}]
  - name: level
    kind: analogue
    mailbox: null
    inputs: [{name: height, type: INT, value: -7}]
    outputs: [{name: limit, type: INT}]
"""


def station_of(
    folder: Path, bus: str = BUS, *, cycle_us: int = 1000, target: str = "OP"
) -> StationSpec:
    """Return the station of a plant with one bus, whose file is made in *folder*."""
    (folder / "bus.yaml").write_text(bus)
    plant = folder / "plant.yaml"
    plant.write_text(PLANT.format(cycle_us=cycle_us, target=target))
    result = load_plant(plant)
    assert result.plant is not None, result.findings
    return result.plant.stations[0]


class Wire:
    """Both ends of the wire, as a bus port."""

    def __init__(self, folder: Path) -> None:
        self.segment = load_or_raise(folder / "bus.yaml").build()
        self.now_ns = 0
        self.tap = None
        self.is_down = False
        self.is_deaf = False
        self.sent = 0
        self._back: deque[tuple[int, bytes]] = deque()

    def fileno(self) -> int:
        return -1

    def close(self) -> None:
        self._back.clear()

    def send(self, frame: bytes) -> None:
        if self.is_down:
            raise EnvironmentalError("the bus cannot be reached: Network is down")
        self.sent += 1
        if not self.is_deaf:
            self.segment.receive_frame(bytearray(frame), self.now_ns, origin=b"")

    def receive(self) -> bytes | None:
        self.settle()
        if self._back and self._back[0][0] <= self.now_ns:
            return self._back.popleft()[1]
        return None

    def receive_stamped(self) -> tuple[bytes, int] | None:
        self.settle()
        if self._back and self._back[0][0] <= self.now_ns:
            at_ns, frame = self._back.popleft()
            return frame, at_ns
        return None

    def settle(self) -> int | None:
        """Let the segment work; return when the next frame is back."""
        self.segment.handle_timeout(self.now_ns)
        for each in self.segment.frames_to_send(self.now_ns):
            self._back.append((self.now_ns + TRIP_NS, bytes(each.frame)))
        return self._back[0][0] if self._back else None


class BusRig:
    """An EngineBus with the image of its station, whose cycles run as time passes."""

    def __init__(
        self, folder: Path, spec: StationSpec | None = None, bus: str = BUS, **more
    ) -> None:
        self.station = spec or station_of(folder, bus, **more)
        self.image = image_of(self.station)
        self.application = memoryview(bytearray(len(self.image.memory)))
        self.wire = Wire(folder)
        self.now_ns = 1_000 * MS
        self.cycle_ns = 1000 * self.station.cycle_us
        self._next_ns = self.now_ns
        self.is_listening = True
        self.changes = 0
        port = self.station.ports[1]
        self.bus = EngineBus(
            port,
            master_settings(port, self.station.cycle_us),
            self.cycle_ns,
            self.image,
            self.memory_of,
            self.wire,
        )
        self.bus.listen = self._listen

    def _listen(self, is_on: bool) -> None:
        assert is_on is not self.is_listening
        self.is_listening = is_on
        self.changes += 1

    def memory_of(self, writer: Writer) -> memoryview:
        return self.image.memory if writer is Writer.ENGINE else self.application

    def start(self) -> BusRig:
        self.wire.now_ns = self.now_ns
        self.bus.start(self.now_ns)
        return self

    def set(self, name: str, value: object) -> None:
        """Write an output, as the application does."""
        with self.image.writing(Writer.APPLICATION):
            self.image.write(name, value)
        self.application[:] = self.image.memory

    def step(self, until_ns: int) -> None:
        """Go to whatever comes next, at most to *until_ns*."""
        back_ns = self.wire.settle()
        times = [until_ns, self._next_ns, self.bus.next_timeout()]
        times += [back_ns] if self.is_listening else []
        self.now_ns = max(self.now_ns, min(at for at in times if at is not None))
        self.wire.now_ns = self.now_ns
        if self.is_listening:
            self.bus.drain(self.now_ns)
        due_ns = self.bus.next_timeout()
        if due_ns is not None and due_ns <= self.now_ns:
            self.bus.handle_timeout(self.now_ns)
        if self.now_ns >= self._next_ns:
            self._next_ns += self.cycle_ns
            self.bus.receive(self.now_ns)
            with self.image.writing(Writer.ENGINE):
                self.bus.copy_inputs()
            self.bus.exchange(self.now_ns)

    def run(self, duration_ns: int) -> None:
        """Let time pass."""
        until_ns = self.now_ns + duration_ns
        while self.now_ns < until_ns:
            self.step(until_ns)

    def wait(self, condition: Callable[[], object], limit_ns: int = 10_000 * MS) -> int:
        """Run until *condition* holds; return how long that took."""
        begun_ns = self.now_ns
        while not condition():
            assert self.now_ns < begun_ns + limit_ns, self.bus.fault or "it does not happen"
            self.step(begun_ns + limit_ns)
        return self.now_ns - begun_ns

    def wait_op(self) -> int:
        return self.wait(lambda: self.value("state") == AlState.OP)

    def value(self, name: str) -> object:
        """Return a variable of the bus."""
        return self.image.read(f"bus0.{name}")

    def fault(self, **spec: object) -> None:
        self.wire.segment.begin(msgspec.convert(spec, FaultSpec), self.now_ns)

    def end(self, **spec: object) -> None:
        self.wire.segment.end(msgspec.convert(spec, FaultSpec), self.now_ns)
