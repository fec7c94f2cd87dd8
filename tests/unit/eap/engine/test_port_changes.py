"""Ports of stations of an engine that come and go while others exchange frames."""

from __future__ import annotations

import os
import select
import socket
from contextlib import ExitStack, closing
from pathlib import Path

import pytest
from msgspec.structs import replace

from eap.engine.build import EnginePlant
from eap.engine.process import CycleWaiter
from eap.errors import EapError
from eap.net.image_file import open_image
from eap.net.ticker import Ticker
from eap.pd.report import station_status
from eap.pd.spec import (
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Wake,
    Writer,
    record_to_lines,
)
from eap.runtime.engine_messages import Configure
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import NO_DESCRIPTOR, Handover, PortName, SharedSocket
from eap.runtime.passing import PassedConnection, PassedSocket
from eap.supervisor.sockets import SharedSockets
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net


class Running:
    """An engine of two stations whose cycles run when the test says so."""

    def __init__(self, folder, sockets: SharedSockets, *specs: StationSpec) -> None:
        self.folder = ApplianceFolder(folder)
        self.sockets = sockets
        given = [
            replace(each, engine_fd=os.dup(each.engine_fd))
            for each in sockets.fit(specs)
            if each.engine_fd != NO_DESCRIPTOR
        ]
        self.plant = EnginePlant(Handover(1, str(folder), "demo", "", specs, tuple(given)))
        self.plant.start(1)
        self._count = 0

    def cycles(self, count: int = 1) -> None:
        for _ in range(2 * count):
            self.plant.engine.handle_timeout(self.plant.engine.next_timeout())
            if self.plant.rebuilder.is_ready:
                self.plant.rebuilder.swap(self.plant.engine.next_timeout() - 1)

    def configure(self, spec: StationSpec, *, passes: bool = True) -> EapError | None:
        """Pass the sockets of *spec* and run it, with cycles in the meantime."""
        for shared in self.sockets.fit([spec]) if passes else ():
            if shared.engine_fd != NO_DESCRIPTOR:
                sock = socket.socket(fileno=os.dup(shared.engine_fd))
                self.plant.take(sock, PassedSocket(shared.key))
        self._count += 1
        path = self.folder.path / f"{self._count}.spec"
        path.write_bytes(record_to_lines(spec))
        answers: list[EapError | None] = []
        request = Configure(id=self._count, station=spec.name, path=str(path))
        rebuilder = self.plant.rebuilder
        rebuilder.serve(request, self.plant.engine.next_timeout() - 1, answers.append)
        while not answers:
            if select.select([rebuilder], [], [], 0.001)[0]:
                rebuilder.collect(self.plant.engine.next_timeout() - 1)
            self.cycles()
        return answers[0]

    def rx(self, station: str) -> dict[str, dict]:
        with open_image(self.folder.image(station)) as file:
            rows = station_status(file.image, 1)["pd"]["rx"]
        return {row["name"]: row for row in rows}

    def discarded(self, station: str) -> dict[str, int]:
        with open_image(self.folder.image(station)) as file:
            return station_status(file.image, 1)["discarded"]

    def descriptors(self) -> list[str]:
        """Return the sockets of this process that are bound to addresses of the plant."""
        names = []
        for fd in Path("/proc/self/fd").iterdir():
            if fd.is_socket():
                with socket.socket(fileno=os.dup(int(fd.name))) as sock:
                    names.append(str(sock.getsockname()))
        return sorted(name for name in names if "127.9.2." in name)


@pytest.fixture
def start(tmp_path):
    with ExitStack() as opened:
        sockets = opened.enter_context(SharedSockets(tmp_path / "control"))

        def start_plant(*specs: StationSpec) -> Running:
            running = Running(tmp_path, sockets, *specs)
            opened.enter_context(closing(running.plant))
            return running

        yield start_plant


def second(number: int, interface: str, **more) -> PortSpec:
    return replace(eap_port(number, interface, **more), name="eap1")


def with_sender(spec: StationSpec, port: PortSpec, destination: str) -> StationSpec:
    """The sender with a second port and a PD there."""
    frame = TxFrameSpec("more", "eap1", destination, (TxPdSpec("extra", 8, ("ticks",)),))
    return replace(spec, ports=(*spec.ports, port), frames=(*spec.frames, frame))


def with_receiver(spec: StationSpec, port: PortSpec) -> StationSpec:
    """The receiver with a second port and a subscription there."""
    pd = RxPdSpec("extra", "eap1", 8, ("copy",), "1.2.3.4.6.1", step=1, timeout_ms=1000)
    return replace(
        spec,
        ports=(*spec.ports, port),
        variables=(*spec.variables, VariableSpec("copy", "UINT", Writer.ENGINE)),
        subscriptions=(*spec.subscriptions, pd),
    )


LOOPS = (eap_port(1, "loop://x"), eap_port(2, "loop://x")), (
    second(1, "loop://y"), second(2, "loop://y"), "127.9.2.9"
)  # fmt: skip
DATAGRAMS = (eap_port(1), eap_port(2)), (
    second(1, "udp://127.9.2.11"), second(2, "udp://127.9.2.12", wake=Wake.ARRIVAL), "127.9.2.12"
)  # fmt: skip


def sender_id(port: PortSpec) -> PortSpec:
    return replace(port, net_id=type(port.net_id).parse("1.2.3.4.6.1"))


@pytest.mark.parametrize(("ports", "more"), [LOOPS, DATAGRAMS], ids=["loop", "udp"])
def test_ports_come_and_go_while_another_port_loses_no_frame(start, ports, more):
    one, two = left(ports[0]), right(ports[1])
    new_one = with_sender(one, sender_id(more[0]), more[2])
    new_two = with_receiver(two, more[1])
    running = start(one, two)
    running.cycles(5)
    own = set(running.descriptors())
    arrivals = len(running.plant.arrivals)
    for _ in range(3):
        assert running.configure(new_two) is None
        assert running.configure(new_one) is None
        running.cycles(10)
        rows = running.rx("right")
        assert rows["extra"]["received"] >= 9
        assert [rows[name]["lost"] for name in ("left-state", "extra")] == [0, 0]
        assert len(running.plant.arrivals) == arrivals + (more[1].wake is Wake.ARRIVAL)
        assert running.configure(one) is None
        assert running.configure(two) is None
        running.cycles(5)
        running.sockets.keep_only(running.sockets.fit([one, two]))
        assert set(running.descriptors()) == own
        assert len(running.plant.arrivals) == arrivals
    row = running.rx("right")["left-state"]
    assert (row["lost"], row["duplicated"], row["reordered"]) == (0, 0, 0)
    assert row["received"] > 40


def test_port_with_another_interface_goes_on_with_its_counters(start):
    one, two = left(), right()
    running = start(one, two)
    running.cycles(5)
    moved = right(eap_port(2, "udp://127.9.2.12"))
    assert running.configure(moved) is None  # until then frames are received
    before = running.rx("right")["left-state"]["received"]
    running.cycles(3)
    assert running.rx("right")["left-state"]["received"] == before >= 5
    assert running.configure(left(destination="127.9.2.12")) is None
    running.cycles(10)
    row = running.rx("right")["left-state"]
    assert row["received"] > before + 8
    assert row["lost"] == 0


def test_port_without_its_socket_is_refused_and_nothing_changes(start):
    running = start(left(), right())
    running.cycles(3)
    wanted = with_receiver(right(), second(2, "udp://127.9.2.12"))
    error = running.configure(wanted, passes=False)
    assert str(error) == "port eap1: its socket is missing: udp 127.9.2.12"
    before = running.rx("right")
    running.cycles(3)
    assert running.rx("right")["left-state"]["received"] > before["left-state"]["received"]
    assert running.configure(wanted) is None


def test_sockets_of_a_refused_change_are_closed(start):
    running = start(left(), right())
    own = set(running.descriptors())
    wanted = with_receiver(right(), second(2, "udp://127.9.2.12"))
    error = running.configure(replace(wanted, variables=right().variables))
    assert "KeyError" in str(error)
    running.sockets.keep_only(running.sockets.fit([left(), right()]))
    assert set(running.descriptors()) == own


def test_socket_whose_request_never_came_is_closed_by_the_next_change(start):
    running = start(left(), right())
    own = set(running.descriptors())
    for shared in running.sockets.fit([right(second(2, "udp://127.9.2.12"))]):
        if shared.engine_fd != NO_DESCRIPTOR:
            sock = socket.socket(fileno=os.dup(shared.engine_fd))
            running.plant.take(sock, PassedSocket(shared.key))
    running.sockets.keep_only(running.sockets.fit([left(), right()]))
    assert set(running.descriptors()) > own
    assert running.configure(left()) is None
    assert set(running.descriptors()) == own


def test_connection_for_a_removed_port_is_closed(start):
    two = right(eap_port(2, tcp=True))
    running = start(left(), two)
    assert running.configure(replace(two, ports=(second(2, "loop://z"),), subscriptions=())) is None
    ours, theirs = socket.socketpair()
    with ours:
        running.plant.take(theirs, PassedConnection((PortName("right", "eap0"),), "10.0.0.1"))
        assert ours.recv(1) == b""


def test_socket_that_is_passed_twice_is_closed(start):
    running = start(left(), right())
    key: SharedSocket = running.sockets.fit([left()])[0].key
    with socket.socket() as sock:
        copy = sock.dup()
        running.plant.take(copy, PassedSocket(key))
        assert copy.fileno() == -1


def test_cycle_waiter_follows_descriptors_that_come_and_go():
    with closing(Ticker()) as ticker, ExitStack() as opened:
        pairs = [socket.socketpair() for _ in range(2)]
        for sock in (each for pair in pairs for each in pair):
            opened.enter_context(sock)
        seen = []

        def handler(index):
            return lambda now_ns: seen.append((index, pairs[index][0].recv(9)))

        handlers = {pairs[0][0].fileno(): handler(0)}
        waiter = CycleWaiter(ticker, handlers)
        never_ns = 1 << 62
        pairs[0][1].send(b"a")
        assert not waiter.wait(never_ns)
        handlers.clear()
        handlers[pairs[1][0].fileno()] = handler(1)
        pairs[0][0].close()
        waiter.update()
        pairs[1][1].send(b"b")
        assert not waiter.wait(never_ns)
        assert seen == [(0, b"a"), (1, b"b")]


class Tap:
    """Notes how many frames pass at a port."""

    def __init__(self) -> None:
        self.received_frames = 0

    def received(self, handle):
        def note(data, size, at_ns, origin):
            self.received_frames += 1
            handle(data, size, at_ns, origin)

        return note

    def sending(self, channel):
        return channel


def test_recorded_ports_come_and_go(start):
    two = right()
    new_two = with_receiver(two, sender_id(second(2, "udp://127.9.2.12")))
    running = start(left(), two)
    tap = Tap()
    entry = running.plant.recording._stations["right"]
    entry.station.tap("eap0", tap)
    assert running.configure(new_two) is None
    running.cycles(5)
    assert tap.received_frames >= 5
    other = Tap()
    entry.station.tap("eap1", other)
    assert running.configure(two) is None
    before = tap.received_frames
    running.cycles(5)
    assert tap.received_frames >= before + 5
    entry.station.untap()
    assert running.rx("right")["left-state"]["lost"] == 0
