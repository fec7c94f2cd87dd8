"""Buses of a running engine: brought up, added, replaced and removed; slaves answer in threads."""

from __future__ import annotations

import select
import socket
import threading
from time import monotonic_ns

import msgspec
import pytest
from msgspec.structs import replace

from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from eap.engine.build import EnginePlant
from eap.engine.engine_buses import REST_NS
from eap.net.busport import SegmentSocket
from eap.pd.spec import record_to_lines
from eap.runtime.busfile import load_or_raise
from eap.runtime.engine_messages import (
    Configure,
    DescribeBus,
    EngineMessage,
    EngineReply,
    EngineStarted,
)
from eap.runtime.handover import NO_DESCRIPTOR, BusSocket, Handover, PortName
from eap.runtime.passing import PassedLine
from eap.runtime.socket_plan import bus_of
from tests.support.enginebus import station_of

pytestmark = pytest.mark.net

MAX_NS = 20_000_000_000


class Slaves:
    """Simulated slaves at one end of a pair, which answer in a thread."""

    def __init__(self, folder, *, answers=True):
        self.engine_end, slaves_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.segment = load_or_raise(folder / "bus.yaml").build()
        self._end = SegmentSocket(slaves_end)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._answer)
        if answers:
            self._thread.start()

    def states(self):
        return [each.esc.memory[Register.AL_STATUS] for each in self.segment.segment.slaves]

    def close(self):
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._end.close()
        self.engine_end.close()

    def _answer(self):
        while not self._stopping.is_set():
            arrival = self._end.receive()
            now_ns = monotonic_ns()
            if arrival is None:
                self.segment.handle_timeout(now_ns)
                self._stopping.wait(0.0002)
                continue
            self.segment.receive_frame(arrival.frame, now_ns, origin=arrival.origin)
            for out in self.segment.frames_to_send(now_ns):
                self._end.send(out.frame, out.origin)


class RunningPlant:
    """An engine with one station and its bus."""

    def __init__(self, folder, *, answers=True):
        self.folder = folder
        self.spec = station_of(folder)
        self.slaves = [Slaves(folder, answers=answers)]
        self.services, engine_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.services.setblocking(False)
        given = replace(
            self.key(self.spec.ports[1]), number=1, engine_fd=self.slaves[0].engine_end.detach()
        )
        handover = Handover(
            1, str(folder), "p", "p.yaml", (self.spec,), (),
            buses=(given,), bus_fd=engine_end.detach(),
        )  # fmt: skip
        self.plant = EnginePlant(handover)
        self.plant.start(monotonic_ns())
        self.replies: dict[int, EngineReply] = {}
        self._due_ns = 0
        self._count = 0

    def key(self, port):
        return bus_of("one", port)

    def value(self, name):
        return self.plant.image("one").read(name)

    def step(self):
        now_ns = monotonic_ns()
        plant = self.plant
        for take in list(plant.arrivals.values()):
            if take != plant.rebuilder.collect:
                take(now_ns)
        if plant.rebuilder.is_building and _is_readable(plant.rebuilder.fileno()):
            plant.rebuilder.collect(now_ns)
        if plant.engine.next_timeout() <= now_ns:
            plant.engine.handle_timeout(now_ns)
        if plant.rebuilder.is_ready:
            plant.rebuilder.swap(now_ns)
        plant.buses.publish()
        self._receive()

    def run_until(self, condition):
        end_ns = monotonic_ns() + MAX_NS
        while not condition():
            assert monotonic_ns() < end_ns
            self.step()

    def ask(self, request):
        self.services.send(msgspec.msgpack.encode(request))
        self.run_until(lambda: request.id in self.replies)
        return self.replies[request.id]

    def configure(self, *ports):
        """Run the station with these bus ports; return the error, if any."""
        self._count += 1
        names = {port.name for port in ports}
        variables = tuple(each for each in self.spec.variables if each.name.split(".")[0] in names)
        spec = replace(self.spec, ports=(self.spec.ports[0], *ports), variables=variables)
        path = self.folder / f"{self._count}.spec"
        path.write_bytes(record_to_lines(spec))
        reply = self.ask(Configure(id=self._count, station="one", path=str(path)))
        return None if reply.error is None else reply.error.message

    def add_slaves(self, port, number):
        slaves = Slaves(self.folder)
        self.slaves.append(slaves)
        bus = replace(self.key(port), number=number)
        self.plant.take(slaves.engine_end.dup(), PassedLine(bus))
        return slaves

    def close(self):
        self.plant.close()
        self.services.close()
        for slaves in self.slaves:
            slaves.close()

    def _receive(self):
        while True:
            try:
                data = self.services.recv(1 << 20)
            except BlockingIOError:
                return
            message = msgspec.msgpack.decode(data, type=EngineMessage)
            if isinstance(message, EngineReply):
                self.replies[message.id] = message


def _is_readable(fd):
    return bool(select.select([fd], [], [], 0)[0])


@pytest.fixture
def start_plant(tmp_path):
    made = []

    def begin(**more):
        made.append(RunningPlant(tmp_path, **more))
        return made[-1]

    yield begin
    for running in made:
        running.close()


def test_slaves_get_to_op_and_rest_in_the_end(start_plant):
    running = start_plant()
    message = msgspec.msgpack.decode(running.services.recv(100), type=EngineMessage)
    assert isinstance(message, EngineStarted)
    running.run_until(lambda: running.value("bus0.state") == AlState.OP)
    begun_ns = monotonic_ns()
    running.plant.stop()
    assert monotonic_ns() - begun_ns < REST_NS
    assert running.slaves[0].states() == [AlState.INIT] * 3


def test_slaves_that_do_not_rest_are_not_waited_for_long(start_plant):
    running = start_plant()
    running.run_until(lambda: running.value("bus0.state") == AlState.OP)
    running.slaves[0].segment.segment.slaves[1].refused_states[AlState.INIT] = 0x11
    begun_ns = monotonic_ns()
    running.plant.stop()
    assert REST_NS <= monotonic_ns() - begun_ns < 4 * REST_NS


def test_buses_that_are_silent_are_not_waited_for_longer(start_plant):
    running = start_plant(answers=False)
    begun_ns = monotonic_ns()
    running.plant.stop()
    assert monotonic_ns() - begun_ns < 4 * REST_NS


def test_removed_bus_goes_to_init_and_refuses_requests(start_plant):
    running = start_plant()
    running.run_until(lambda: running.value("bus0.state") == AlState.OP)
    assert running.ask(DescribeBus(id=101, bus=1)).report.is_up
    (bus,) = running.plant.buses._running
    assert running.configure() is None
    assert "bus0.state" not in running.plant.image("one").slots
    running.run_until(lambda: running.slaves[0].states() == [AlState.INIT] * 3)
    error = running.ask(DescribeBus(id=102, bus=1)).error
    assert "there is no bus 1" in error.message
    running.run_until(lambda: bus.filenos() == [-1])
    assert bus.drain not in running.plant.arrivals.values()


def test_added_bus_is_brought_up_beside_the_other(start_plant):
    running = start_plant()
    running.run_until(lambda: running.value("bus0.state") == AlState.OP)
    (bus0,) = running.spec.ports[1:]
    bus1 = replace(bus0, name="bus1")
    assert running.configure(bus0, bus1) == "port bus1: the socket of its bus is missing"
    before = running.ask(DescribeBus(id=101, bus=1)).report
    slaves = running.add_slaves(bus1, 2)
    assert running.configure(bus0, bus1) is None
    running.run_until(lambda: slaves.states() == [AlState.OP] * 3)
    assert running.ask(DescribeBus(id=102, bus=2)).report.cycles
    after = running.ask(DescribeBus(id=103, bus=1)).report
    assert after.cycles > before.cycles
    assert after.is_up
    assert running.slaves[0].states() == [AlState.OP] * 3


def test_replaced_bus_starts_when_the_one_before_has_left(start_plant):
    running = start_plant()
    running.run_until(lambda: running.value("bus0.state") == AlState.OP)
    (bus0,) = running.spec.ports[1:]
    other = replace(bus0, bus=replace(bus0.bus, simulated="other slaves"))
    slaves = running.add_slaves(other, 2)
    assert running.configure(other) is None
    seen = set()

    def is_up():
        if any(state not in {0, AlState.INIT} for state in slaves.states()):
            seen.add(tuple(running.slaves[0].states()))
        return slaves.states() == [AlState.OP] * 3

    running.run_until(is_up)
    assert seen == {(AlState.INIT,) * 3}
    running.run_until(lambda: running.value("bus0.state") == AlState.OP)
    assert "there is no bus 1" in running.ask(DescribeBus(id=101, bus=1)).error.message


def test_sockets_that_were_passed_twice_are_closed(start_plant):
    running = start_plant()
    (bus0,) = running.spec.ports[1:]
    running.run_until(lambda: running.value("bus0.state") == AlState.OP)
    bus = replace(running.key(bus0), number=1)
    first, second = socket.socketpair()
    running.plant.take(first, PassedLine(bus))
    assert first.fileno() == -1
    second.close()


def test_without_a_pair_there_are_no_requests(tmp_path):
    plant = EnginePlant(Handover(1, str(tmp_path), "p", "p.yaml", (), ()))
    assert plant.buses.requests is None
    plant.buses.start(0)
    plant.buses.rest()
    plant.close()
    assert Handover(1, "", "", "", (), ()).bus_fd == NO_DESCRIPTOR
    assert BusSocket(PortName("a", "b")).engine_fd == NO_DESCRIPTOR
