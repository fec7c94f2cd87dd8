"""Stations of an engine in memory that are configured anew while they run."""

from __future__ import annotations

import select
import socket

import pytest
from msgspec.structs import replace

from eap.codec.pd import decode_frame_header
from eap.engine.build import EnginePlant
from eap.engine.channels import PortChannels, has_tcp, sends_to
from eap.engine.engine_buses import EngineBuses
from eap.engine.rebuild import MAX_WAITING, EngineStation, StationReplacement
from eap.errors import EngineRefusedError, EnvironmentalError
from eap.ids import InterfaceUri, NetId
from eap.net.image_file import ImageFile, create_image, open_image
from eap.net.loopback import LoopbackLines
from eap.pd.device import DeviceState
from eap.pd.engine import Engine
from eap.pd.handover import ImageHandover
from eap.pd.layout import plan_layout
from eap.pd.report import station_status
from eap.pd.spec import (
    REQUESTER,
    BusPortSpec,
    PortKind,
    PortSpec,
    RxPdSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
    record_to_lines,
)
from eap.pd.station import Station
from eap.pd.words import StationWord
from eap.runtime.drop_counters import DropCounters
from eap.runtime.engine_messages import Configure, SetState
from eap.runtime.folder import ApplianceFolder
from eap.runtime.handover import Handover
from tests.support.cyclic import MS
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net

NO_BUSES = EngineBuses({}, Engine([]))


def replacement(place, **changes):
    """Return the replacement of a station by one with *changes*."""
    return StationReplacement(place, replace(place.station.spec, **changes), NO_BUSES)


TIMEOUT_MS = 10_000


class Running:
    """An engine's plant of two stations on a line, whose cycles run when the test says so."""

    def __init__(self, folder):
        self.folder = ApplianceFolder(folder)
        self.left, self.right = left(eap_port(1, "loop://x")), right(eap_port(2, "loop://x"))
        specs = (self.left, self.right)
        self.plant = EnginePlant(Handover(1, str(folder), "demo", "demo.yaml", specs, ()))
        self.plant.start(1)
        self.answers = {}
        self.count = 0

    def cycles(self, count=1):
        for _ in range(2 * count):
            self.plant.engine.handle_timeout(self.plant.engine.next_timeout())
            if self.plant.rebuilder.is_ready:
                self.plant.rebuilder.swap(self.plant.engine.next_timeout() - 1)

    def post(self, spec, name=None):
        """Ask for *spec*; return the number of the request."""
        self.count += 1
        path = self.folder.path / f"{self.count}.spec"
        path.write_bytes(record_to_lines(spec))
        request = Configure(id=self.count, station=name or spec.name, path=str(path))
        return self.serve(request)

    def serve(self, request):
        now_ns = self.plant.engine.next_timeout() - 1
        self.plant.rebuilder.serve(
            request, now_ns, lambda error: self.answers.update({request.id: error})
        )
        return request.id

    def finish(self, number):
        """Wait for what was asked, with cycles in the meantime; return the error, if any."""
        rebuilder = self.plant.rebuilder
        while number not in self.answers:
            if select.select([rebuilder], [], [], 0.001)[0]:
                rebuilder.collect(self.plant.engine.next_timeout() - 1)
            self.cycles()
        return self.answers[number]

    def configure(self, spec, name=None):
        return self.finish(self.post(spec, name))

    def status(self, name):
        with open_image(self.folder.image(name)) as file:
            return station_status(file.image, 1)

    def values(self, name):
        with open_image(self.folder.image(name)) as file:
            return file.image.read_all()

    def word(self, name, word):
        with open_image(self.folder.image(name)) as file:
            return file.image.words[word]

    def write(self, station, **values):
        with open_image(self.folder.image(station)) as file, file.image.writing(Writer.APPLICATION):
            for variable, value in values.items():
                file.image.write(variable, value)


@pytest.fixture
def running(tmp_path):
    made = Running(tmp_path)
    yield made
    made.plant.close()


BUS = PortSpec(
    "bus0", PortKind.BUS, InterfaceUri.parse("sim:///x.yaml"), NetId.parse("1.2.3.4.5.9"),
    bus=BusPortSpec("/x.yaml"),
)  # fmt: skip


def wider(spec):
    """The sender with one more variable in a second PD."""
    (frame,) = spec.frames
    more = TxFrameSpec("more", "eap0", "127.9.2.2", (TxPdSpec("extra", 8, ("level",)),))
    return replace(
        spec,
        variables=(VariableSpec("level", "INT", default=-5), *spec.variables),
        frames=(frame, more),
    )


def listening_more(spec):
    """The receiver with a subscription that nobody serves."""
    more = RxPdSpec("nobody", "eap0", 99, ("spare",), "9.9.9.9.1.1", timeout_ms=50)
    return replace(
        spec,
        variables=(VariableSpec("spare", "INT", Writer.ENGINE), *spec.variables),
        subscriptions=(more, *spec.subscriptions),
    )


def test_rebuild_with_added_pd_keeps_other_counters(running):
    running.cycles(5)
    running.write("left", setpoint=[1.5, 2.5], name="xyz")
    running.cycles(5)
    before = running.status("right")["pd"]["rx"][0]
    assert running.configure(wider(running.left)) is None
    running.cycles(20)
    left_now, right_now = running.status("left"), running.status("right")
    assert [pd["name"] for pd in left_now["pd"]["tx"]] == ["state", "extra"]
    assert left_now["pd"]["tx"][0]["sent"] == left_now["cycle"]
    assert 0 < left_now["pd"]["tx"][1]["sent"] < left_now["cycle"]
    rx = right_now["pd"]["rx"][0]
    assert (rx["lost"], rx["duplicated"], rx["reordered"]) == (0, 0, 0)
    assert rx["received"] > before["received"]
    assert running.values("left")["name"] == "xyz"
    assert running.values("left")["level"] == -5
    assert running.values("right")["setpoint"] == (1.5, 2.5)
    assert right_now["discarded"].keys() == {"unknown_id"}


@pytest.mark.parametrize("side", ["left", "right"])
def test_one_side_is_swapped_a_hundred_times_while_frames_flow(running, side):
    spec = getattr(running, side)
    other = wider(spec) if side == "left" else listening_more(spec)
    running.cycles(3)
    for number in range(100):
        assert running.configure(spec if number % 2 else other) is None
        running.cycles(number % 3)
    sent = running.status("left")["pd"]["tx"][0]["sent"]
    right_now = running.status("right")
    rx = next(rx for rx in right_now["pd"]["rx"] if rx["name"] == "left-state")
    assert (rx["lost"], rx["duplicated"], rx["reordered"]) == (0, 0, 0)
    assert sent == running.word("left", StationWord.CYCLE)
    assert rx["received"] in {sent, sent - 1}  # one may be under way
    assert running.word("left", StationWord.RESTARTS) == 0
    with open_image(running.folder.image(side)) as file:
        assert file.generation == 101
    assert list(running.folder.path.glob(".*")) == []


def test_rebuild_without_the_socket_of_its_bus_is_rejected(running):
    running.cycles(3)
    error = running.configure(replace(running.left, ports=(*running.left.ports, BUS)))
    assert isinstance(error, EngineRefusedError)
    assert str(error) == "port bus0: the socket of its bus is missing"
    cycle = running.word("left", StationWord.CYCLE)
    running.cycles(3)
    assert running.word("left", StationWord.CYCLE) == cycle + 3


def test_rebuild_failure_leaves_no_files(running):
    pd = RxPdSpec("a", "eap0", 1, ("nothing",))
    error = running.configure(replace(running.right, subscriptions=(pd,)))
    assert isinstance(error, EngineRefusedError)
    assert str(error) == "station right: KeyError: 'nothing'"
    number = running.serve(Configure(id=77, station="left", path="/nowhere"))
    assert "/nowhere: [Errno 2]" in str(running.finish(number))
    assert str(running.configure(running.left, "right")).startswith("station right cannot become")
    assert list(running.folder.path.glob(".*")) == []
    running.cycles(3)
    assert running.status("right")["pd"]["rx"][0]["received"] > 0


def test_rebuild_with_failed_rename_changes_nothing(running, monkeypatch):
    running.cycles(3)

    def full(self, path):
        raise EnvironmentalError(f"{path}: read-only")

    with monkeypatch.context() as patch:
        patch.setattr(ImageFile, "move_to", full)
        assert "read-only" in str(running.configure(wider(running.left)))
    assert list(running.folder.path.glob(".*")) == []
    assert not running.status("left")["pd"]["tx"][1:]
    assert running.configure(wider(running.left)) is None
    assert len(running.status("left")["pd"]["tx"]) == 2


def test_requests_are_done_one_after_the_other_and_not_without_limit(running):
    specs = [wider(running.left), listening_more(running.right), running.left]
    numbers = [running.post(spec) for spec in specs]
    numbers += [running.post(running.left) for _ in range(MAX_WAITING)]
    refused = [number for number in numbers if running.answers.get(number) is not None]
    assert len(refused) == 2
    assert "changes wait already" in str(running.answers[refused[0]])
    for number in numbers:
        running.finish(number)
    assert [pd["name"] for pd in running.status("left")["pd"]["tx"]] == ["state"]
    assert len(running.status("right")["pd"]["rx"]) == 2


def test_rebuild_with_same_spec_changes_nothing(running):
    assert running.configure(running.left) is None
    with open_image(running.folder.image("left")) as file:
        assert file.generation == 1


def test_accounts_that_part_while_something_is_built_are_looked_at_again(running, monkeypatch):
    running.cycles(3)
    answers = [False, True]
    monkeypatch.setattr(ImageHandover, "is_current", property(lambda _: answers.pop(0)))
    assert running.configure(wider(running.left)) is None
    assert answers == []
    assert list(running.folder.path.glob(".*")) == []


def test_the_swap_waits_for_the_next_cycle_when_that_is_near(running):
    number = running.post(wider(running.left))
    select.select([running.plant.rebuilder], [], [], TIMEOUT_MS / 1000)
    due_ns = running.plant.engine.next_timeout()
    running.plant.rebuilder.collect(due_ns - 100_000)
    assert number not in running.answers
    running.cycles()
    assert running.answers[number] is None
    while running.plant.rebuilder.is_building:  # it clears up what has been replaced
        select.select([running.plant.rebuilder], [], [], TIMEOUT_MS / 1000)
        running.plant.rebuilder.collect(due_ns)
    number = running.post(running.left)
    select.select([running.plant.rebuilder], [], [], TIMEOUT_MS / 1000)
    running.plant.rebuilder.collect(running.plant.engine.next_timeout() - 2_000_000)
    assert running.answers[number] is None


def test_states_change_while_cycles_run(running):
    def go(state):
        number = running.serve(SetState(id=1000 + state, station="right", state=state))
        return running.finish(number)

    running.cycles(3)
    assert go(DeviceState.SAFEOP) is None
    received = running.status("right")["pd"]["rx"][0]["received"]
    running.cycles(3)
    assert running.status("right")["state"] == "SAFEOP"
    assert running.status("right")["pd"]["rx"][0]["received"] == received
    assert running.status("right")["discarded"] == {"suppressed": 3}
    assert running.configure(listening_more(running.right)) is None
    assert running.status("right")["state"] == "SAFEOP"
    assert go(DeviceState.OP) is None
    running.cycles(3)
    assert running.status("right")["pd"]["rx"][1]["lost"] == 0
    assert running.status("right")["pd"]["rx"][1]["received"] > received
    assert str(go(DeviceState.INIT)).startswith("INIT cannot be requested")
    assert str(go(3)) == "there is no state 3, expected 2, 4 or 8"
    number = running.serve(SetState(id=1, station="nobody", state=8))
    assert str(running.answers[number]) == "there is no station nobody"


def test_engine_whose_swap_fails_ends_for_its_new_start(tmp_path, monkeypatch):
    running = Running(tmp_path)

    def fail(self, path):
        raise RuntimeError("no error that a swap knows")

    monkeypatch.setattr(ImageFile, "move_to", fail)
    with pytest.raises(RuntimeError):
        running.configure(wider(running.left))
    running.plant.close()  # waits for the thread that built


def test_rebuilder_close_waits_for_build(tmp_path):
    running = Running(tmp_path)
    running.post(wider(running.left))
    running.plant.close()
    assert list(tmp_path.glob(".*")) == []
    assert running.answers == {}


pytestmark = pytest.mark.net


@pytest.fixture
def place(tmp_path):
    spec = left(eap_port(1, "loop://x"))
    file = create_image(tmp_path / "left.image", plan_layout(spec))
    with DropCounters(tmp_path / "counts", ["left"]) as counters:
        channels = PortChannels(counters, {})
        made = EngineStation(Station(spec, file.image, file.wake_waiters), file, channels)
        yield made
        made.file.close()


def test_rebuild_loses_no_concurrent_writes(place, tmp_path):
    """A writer during the replacement finds the image retired, or is carried over."""
    engine = Engine([place.station])
    engine.start(0)
    engine.handle_timeout(10 * MS)
    program = open_image(tmp_path / "left.image")
    successor = replacement(place, frames=())
    with program.image.writing(Writer.APPLICATION):
        program.image.write("running", True)
    assert not program.retired
    successor.take_over(engine, 20 * MS)
    assert program.retired
    assert place.file.image.read("running") is True
    assert place.file.image.words[0] == 1
    program.close()


def test_rebuild_keeps_partial_write_of_stopped_program(place, tmp_path):
    engine = Engine([place.station])
    engine.start(0)
    engine.handle_timeout(10 * MS)
    with open_image(tmp_path / "left.image") as program:
        with program.image.writing(Writer.APPLICATION):
            program.image.write("running", True)
        engine.handle_timeout(20 * MS)
        with program.image.writing(Writer.APPLICATION):
            program.image.write("running", False)
            before = replacement(place, frames=()).take_over(engine, 20 * MS)
        assert before.inputs is not place.station.inputs
    assert (
        place.file.image.read("running") is True
    )  # its program writes again: the image is retired


def test_an_image_that_is_not_used_is_removed(place, tmp_path):
    replacement(place, frames=()).discard()
    with pytest.raises(EngineRefusedError):
        replacement(place, name="other")
    with pytest.raises(KeyError):
        replacement(place, variables=())
    assert {path.name for path in tmp_path.iterdir()} == {"left.image", "counts"}


pytestmark = pytest.mark.net


HERE = "127.9.2.31"


def sending(*destinations):
    frames = tuple(
        TxFrameSpec(f"f{n}", "eap0", where, (TxPdSpec(f"p{n}", n, ("running",)),))
        for n, where in enumerate(destinations)
    )
    return replace(left(eap_port(31)), frames=frames)


def test_a_port_has_tcp_when_it_sends_takes_or_is_made_of_it():
    udp = eap_port(31)
    assert sends_to(sending("127.9.2.2", "tcp://127.9.2.3", REQUESTER), "eap0") == {
        "tcp://127.9.2.3"
    }
    assert sends_to(sending("tcp://127.9.2.3"), "eap1") == set()
    assert [has_tcp(sending("127.9.2.2"), port) for port in (udp, replace(udp, tcp=True))] == [
        False,
        True,
    ]
    assert has_tcp(sending("127.9.2.2"), eap_port(31, "tcp://127.9.2.31"))
    assert has_tcp(sending("tcp://127.9.2.3"), udp)


@pytest.fixture
def listeners():
    """Two that take connections."""
    made = [socket.create_server(("127.9.2.32", 0)) for _ in range(2)]
    yield made
    for each in made:
        each.close()


def test_destinations_by_tcp_come_and_go_while_the_station_runs(tmp_path, listeners):
    first, second = ("tcp://{}:{}".format(*listener.getsockname()) for listener in listeners)
    spec = sending("127.9.2.2")
    file = create_image(tmp_path / "left.image", plan_layout(spec))
    station = Station(spec, file.image, file.wake_waiters)
    station.connect("eap0", LoopbackLines().open(InterfaceUri.parse("loop://x")))
    counters = DropCounters(tmp_path / "counts", ["left"])
    channels = PortChannels(counters, {})
    place = EngineStation(station, file, channels)
    engine = Engine([station])
    engine.start(0)

    def configure(*destinations):
        successor = StationReplacement(place, sending(*destinations), NO_BUSES)
        successor.take_over(engine, engine.next_timeout())
        place.channels.update_tcp(place.station)

    def accept(listener):
        while not select.select([listener], [], [], 0)[0]:
            engine.handle_timeout(engine.next_timeout())
        connection, _ = listener.accept()
        connection.setblocking(False)
        return connection

    def receive(connection):
        while not select.select([connection], [], [], 0)[0]:
            engine.handle_timeout(engine.next_timeout())
        return connection.recv(1 << 16)

    configure("127.9.2.2", first)
    with accept(listeners[0]) as one:
        assert decode_frame_header(receive(one)).count == 1
        configure(first, second)
        with accept(listeners[1]) as two:
            assert receive(two)
            assert receive(one)  # still the same connection
            configure(second)
            while receive(one):
                pass  # and then it has been closed
            assert receive(two)
            configure("127.9.2.2")
            while receive(two):
                pass
    channels.close()
    place.file.close()
    counters.close()
