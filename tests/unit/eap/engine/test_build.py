"""The graph of objects of an engine, driven without a clock."""

from __future__ import annotations

import socket
from contextlib import ExitStack

import msgspec
import pytest

from eap.codec.ethercat import EtherCatHeader
from eap.engine.build import EnginePlant
from eap.net import limits, tcpport
from eap.net.image_file import open_image
from eap.net.limits import ListenerLimits
from eap.pd.report import station_status
from eap.pd.spec import Wake
from eap.pd.words import StationWord
from eap.runtime.drop_counters import DropCounters
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import NO_DESCRIPTOR, Handover, PortName
from eap.runtime.passing import PassedConnection
from eap.supervisor.sockets import SharedSockets
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net


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
