"""The graph of objects of an engine, driven without a clock."""

from __future__ import annotations

import socket
import threading
from contextlib import ExitStack
from time import monotonic_ns
from typing import cast

import msgspec
import pytest

from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from eap.codec.ethercat import EtherCatHeader
from eap.engine.build import REST_NS, EngineBuses, EnginePlant
from eap.engine.channels import PortChannels
from eap.engine.rebuild import EngineStation
from eap.net import limits, tcpport
from eap.net.busport import SegmentSocket
from eap.net.image_file import ImageFile, open_image
from eap.net.limits import ListenerLimits
from eap.pd.report import station_status
from eap.pd.spec import Wake
from eap.pd.station import Station
from eap.pd.words import StationWord
from eap.runtime.busfile import load_or_raise
from eap.runtime.drop_counters import DropCounters
from eap.runtime.engine_messages import EngineMessage, EngineStarted, SetState
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import NO_DESCRIPTOR, BusSocket, Handover, PortName
from eap.runtime.passing import PassedConnection
from eap.supervisor.sockets import SharedSockets
from tests.support.cyclic import image_of
from tests.support.enginebus import station_of
from tests.unit.eap.conftest import eap_port, left, right


class Running:
    """An engine's plant that runs cycle by cycle."""

    def __init__(self, tmp_path, stations, sockets=()) -> None:
        self.folder = ApplianceFolder(tmp_path)
        self.plant = EnginePlant(
            Handover(1, str(tmp_path), "demo", "demo.yaml", tuple(stations), tuple(sockets))
        )
        self.plant.start(1)

    def run_cycles(self, count: int) -> None:
        for _ in range(2 * count):  # two stations
            self.plant.engine.handle_timeout(self.plant.engine.next_timeout())

    def values(self, station: str) -> dict:
        with open_image(self.folder.image(station)) as file:
            return file.image.read_all()

    def word(self, station: str, word: StationWord) -> int:
        with open_image(self.folder.image(station)) as file:
            return file.image.words[word]

    def discards(self) -> dict:
        names = ["left", "right"]
        with DropCounters(self.folder.discards("engine"), names) as counters:
            return counters.stats()


@pytest.fixture
def start(tmp_path):
    """Start plants that are closed at the end of the test."""
    started = []

    def start_plant(stations, sockets=()):
        started.append(Running(tmp_path, stations, sockets))
        return started[-1]

    yield start_plant
    for running in started:
        running.plant.close()


def test_stations_on_a_line_in_memory_hear_each_other(start):
    line = [left(eap_port(1, "loop://line")), right(eap_port(2, "loop://line"))]
    running = start(line)
    running.run_cycles(5)
    assert running.values("right")["ticks"] >= 4
    assert running.values("right")["name"] == "abc"
    assert running.word("left", StationWord.ENGINE_PID) > 0
    running.plant.stop()
    assert running.word("left", StationWord.ENGINE_PID) == 0


@pytest.fixture
def shared(tmp_path):
    """Open the sockets of some stations for as long as the test lasts."""
    opened = []

    def open_for(*stations):
        sockets = SharedSockets(tmp_path / f"control{len(opened)}")
        opened.append(sockets)
        # The plant closes what it is given: here it shares a process with the supervisor.
        return [
            msgspec.structs.replace(each, engine_fd=socket.dup(each.engine_fd))
            for each in sockets.fit(stations)
            if each.engine_fd != NO_DESCRIPTOR
        ]

    yield open_for
    for sockets in opened:
        sockets.close()


@pytest.mark.net
def test_udp_ports_are_independent(start, shared):
    stations = [left(), right(eap_port(2, wake=Wake.ARRIVAL))]
    running = start(stations, shared(*stations))
    running.run_cycles(3)
    (take,) = [
        take
        for fd, take in running.plant.arrivals.items()
        if fd != running.plant.rebuilder.fileno()
    ]
    take(1)
    assert running.values("right")["ticks"] >= 2


@pytest.mark.net
def test_frames_of_a_passed_connection_reach_the_port_behind_it(start, shared):
    stations = [left(), right(eap_port(2, tcp=True))]
    running = start(stations, shared(*stations))
    publisher, accepted = socket.socketpair()
    with publisher, socket.create_server(("127.0.0.1", 0)) as listener:
        accepted.close()
        with socket.create_connection(listener.getsockname()) as peer:
            connection, _ = listener.accept()
            owners = (PortName("right", "eap0"),)
            running.plant.take(connection, PassedConnection(owners, "10.0.0.2"))
            peer.sendall(EtherCatHeader(1, 0, 4).encode() + b"\0")
            peer.sendall(EtherCatHeader(0, 0, 5).encode())
            running.run_cycles(3)
            running.plant.publish_discards()
            running.plant.publish_discards()
    assert running.discards() == {"left": {}, "right": {"tcp_type": 1}}
    with open_image(running.folder.image("right")) as file:
        assert station_status(file.image, 1)["discarded"] == {"truncated": 1}


@pytest.mark.net
def test_host_over_its_share_loses_its_silent_connection_to_a_port(start, shared, monkeypatch):
    monkeypatch.setattr(tcpport, "LIMITS", ListenerLimits(total=2, reserved=0, per_host=1))
    monkeypatch.setattr(limits, "FRESH_NS", 0)
    stations = [left(), right(eap_port(2, tcp=True))]
    running = start(stations, shared(*stations))
    owners = (PortName("right", "eap0"),)
    with socket.create_server(("127.0.0.1", 0)) as listener, ExitStack() as stack:
        peers = [
            stack.enter_context(socket.create_connection(listener.getsockname(), 5))
            for _ in range(2)
        ]
        for _ in peers:
            passed = PassedConnection(owners, "10.0.0.1")
            running.plant.take(listener.accept()[0], passed)
        assert peers[0].recv(1) == b""
        running.run_cycles(3)
        running.plant.publish_discards()
    assert running.discards() == {"left": {}, "right": {"tcp_evicted": 1}}


pytestmark = pytest.mark.net

MAX_NS = 10_000_000_000


class RunningBuses:
    """All buses of one station, and the slaves below, which answer in a thread."""

    def __init__(self, folder, *, answers=True):
        spec = station_of(folder)
        self.station = Station(spec, image_of(spec), lambda: None)
        engine_end, slaves_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.services, desk_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        given = BusSocket(PortName("one", "bus0"), 1, engine_end.detach())
        handover = Handover(
            1, str(folder), "p", "p.yaml", (spec,), (), buses=(given,), bus_fd=desk_end.detach()
        )
        self.asked = []
        place = EngineStation(self.station, cast("ImageFile", None), cast("PortChannels", None))
        self.buses = EngineBuses(handover, {"one": place}, lambda *asked: self.asked.append(asked))
        self.segment = load_or_raise(folder / "bus.yaml").build()
        self._end = SegmentSocket(slaves_end)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._answer)
        if answers:
            self._thread.start()

    def run_until(self, condition):
        end_ns = monotonic_ns() + MAX_NS
        due_ns = 0
        while not condition():
            now_ns = monotonic_ns()
            assert now_ns < end_ns
            for take in self.buses.arrivals.values():
                take(now_ns)
            if now_ns >= due_ns:
                due_ns = now_ns + 1_000_000
                self.station.cycle(now_ns, now_ns)

    def close(self):
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self.buses.close()
        self._end.close()
        self.services.close()

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


@pytest.fixture
def start_buses(tmp_path):
    made = []

    def begin(**more):
        running = RunningBuses(tmp_path, **more)
        made.append(running)
        running.buses.start(monotonic_ns())
        return running

    yield begin
    for running in made:
        running.close()


def test_slaves_get_to_op_and_rest_in_the_end(start_buses):
    running = start_buses()
    message = msgspec.msgpack.decode(running.services.recv(100), type=EngineMessage)
    assert isinstance(message, EngineStarted)
    assert len(running.buses.arrivals) == 2
    running.services.send(msgspec.msgpack.encode(SetState(id=1, station="one", state=4)))
    running.run_until(lambda: running.station.image.read("bus0.state") == AlState.OP)
    assert [asked[0] for asked in running.asked] == [SetState(id=1, station="one", state=4)]
    begun_ns = monotonic_ns()
    running.buses.rest()
    assert monotonic_ns() - begun_ns < REST_NS
    status = [each.esc.memory[Register.AL_STATUS] for each in running.segment.segment.slaves]
    assert status == [AlState.INIT] * 3


def test_slaves_that_do_not_rest_are_not_waited_for_long(start_buses):
    running = start_buses()
    running.run_until(lambda: running.station.image.read("bus0.state") == AlState.OP)
    running.segment.segment.slaves[1].refused_states[AlState.INIT] = 0x11
    begun_ns = monotonic_ns()
    running.buses.rest()
    assert REST_NS <= monotonic_ns() - begun_ns < 4 * REST_NS


def test_buses_that_are_silent_are_not_waited_for_longer(start_buses):
    running = start_buses(answers=False)
    begun_ns = monotonic_ns()
    running.buses.rest()
    assert monotonic_ns() - begun_ns < 4 * REST_NS


def test_without_a_pair_there_is_no_desk(tmp_path):
    buses = EngineBuses(Handover(1, str(tmp_path), "p", "p.yaml", (), ()), {}, print)
    assert buses.requests is None
    assert buses.arrivals == {}
    buses.start(0)
    buses.rest()
    buses.close()
    assert Handover(1, "", "", "", (), ()).bus_fd == NO_DESCRIPTOR
