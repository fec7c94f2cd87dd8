"""The buses of an engine, over the sockets that the supervisor opens."""

from __future__ import annotations

import socket
import threading
from time import monotonic_ns
from typing import cast

import msgspec
import pytest

from devicebus.wire.alstatus import AlState
from devicebus.wire.register import Register
from eap.engine.engine_buses import REST_NS, EngineBuses
from eap.engine.successor import EngineStation
from eap.net.busport import SegmentSocket
from eap.net.image_file import ImageFile
from eap.pd.station import Station
from eap.runtime.bus_request import EngineMessage, EngineStarted
from eap.runtime.busfile import load_or_raise
from eap.runtime.handover import NO_DESCRIPTOR, BusSocket, Handover, PortName
from eap.runtime.station_request import SetState
from tests.support.cyclic import image_of
from tests.support.enginebus import station_of

pytestmark = pytest.mark.net

MAX_NS = 10_000_000_000


class Running:
    """All buses of one station, and the slaves below, which answer in a thread."""

    def __init__(self, folder, *, answers=True):
        spec = station_of(folder)
        self.station = Station(spec, image_of(spec), lambda: None)
        engine_end, slaves_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.services, desk_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        given = BusSocket(PortName("one", "bus0"), engine_end.detach())
        handover = Handover(
            1, str(folder), "p", "p.yaml", (spec,), (), buses=(given,), bus_fd=desk_end.detach()
        )
        self.asked = []
        place = EngineStation(self.station, cast("ImageFile", None))
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
def start(tmp_path):
    made = []

    def begin(**more):
        running = Running(tmp_path, **more)
        made.append(running)
        running.buses.start(monotonic_ns())
        return running

    yield begin
    for running in made:
        running.close()


def test_slaves_get_to_op_and_rest_in_the_end(start):
    running = start()
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


def test_slaves_that_do_not_rest_are_not_waited_for_long(start):
    running = start()
    running.run_until(lambda: running.station.image.read("bus0.state") == AlState.OP)
    running.segment.segment.slaves[1].refused_states[AlState.INIT] = 0x11
    begun_ns = monotonic_ns()
    running.buses.rest()
    assert REST_NS <= monotonic_ns() - begun_ns < 4 * REST_NS


def test_buses_that_are_silent_are_not_waited_for_longer(start):
    running = start(answers=False)
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
