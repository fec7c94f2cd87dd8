"""The engine process: its loop in this process, its ends in one of its own."""

from __future__ import annotations

import gc
import os
import signal
import socket
import subprocess
import sys
import time
import weakref
from time import monotonic_ns

import msgspec
import pytest

from eap.compiled import cyclic
from eap.engine import process as engine_process
from eap.engine import process as module
from eap.engine.build import EnginePlant
from eap.engine.process import CycleWaiter, StopFlag, run_cycles
from eap.net.image_file import open_image
from eap.net.ticker import Ticker
from eap.pd.words import StationWord
from eap.runtime.handover import EngineOptions, Handover
from tests.support.startup import read_reports
from tests.unit.eap.conftest import eap_port, left, right

pytestmark = pytest.mark.net

LINE = (left(eap_port(1, "loop://line")), right(eap_port(2, "loop://line")))


def handover(folder, **more) -> Handover:
    options = EngineOptions(realtime=False)
    return Handover(
        os.getpid(), str(folder), "demo", "demo.yaml", LINE, (), options=options, **more
    )


def cycles(folder) -> list[int]:
    """Return how many cycles left and right have run."""
    counts = []
    for station in ("left", "right"):
        with open_image(folder / f"{station}.image") as file:
            counts.append(file.image.words[StationWord.CYCLE])
    return counts


def test_every_cycle_runs_until_the_signal(tmp_path):
    told: list[list[int]] = []
    before = signal.getsignal(signal.SIGTERM)
    engine, services = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    plant = EnginePlant(handover(tmp_path))
    try:
        stop = StopFlag()
        signal.signal(signal.SIGALRM, lambda *_: os.kill(os.getpid(), signal.SIGTERM))

        def ready() -> None:
            told.append(cycles(tmp_path))
            signal.setitimer(signal.ITIMER_REAL, 0.2)  # not before: to begin takes its time

        plant.start(monotonic_ns())
        with engine, services:
            run_cycles(plant, engine, stop, ready)
        assert stop.is_set
    finally:
        plant.close()
        signal.signal(signal.SIGTERM, before)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
    assert min(cycles(tmp_path)) >= 10  # of 20
    assert len(told) == 1
    assert min(told[0]) >= 1  # who hears it finds values of a cycle


MODULE = "eap.engine.process"


class Engine:
    """The engine as the supervisor starts it."""

    def __init__(self, given: Handover) -> None:
        self.link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.ready, ready_end = os.pipe()
        given = msgspec.structs.replace(given, link_fd=theirs.fileno())
        fd = given.to_descriptor()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "eap.runtime.startup", MODULE, str(fd), str(ready_end), ""],
            pass_fds=(fd, ready_end, theirs.fileno()),
            stderr=subprocess.PIPE,
            text=True,
        )
        os.close(fd)
        os.close(ready_end)
        theirs.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()
        self.link.close()
        os.close(self.ready)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_engine_reports_start_and_ends_on_sigterm(tmp_path, number):
    with Engine(handover(tmp_path)) as engine:
        *steps, ready = read_reports(engine.ready)
        assert [each.step for each in steps][-2:] == [
            "starting the stations", "running the first cycle"
        ]  # fmt: skip
        assert ready.ready == {
            "realtime": {"scheduler": "other: not requested"},
            "compiled": cyclic is not None,
        }
        assert min(cycles(tmp_path)) >= 1
        engine.process.send_signal(number)
        assert engine.process.communicate(timeout=20)[1] == ""
        assert engine.process.returncode == 0


def test_engine_missing_environment_is_exit_code_2(tmp_path):
    with Engine(handover(tmp_path / "nowhere")) as engine:
        error = engine.process.communicate(timeout=20)[1]
        assert engine.process.returncode == 2
        assert not any(each.ready for each in read_reports(engine.ready))
    assert error.startswith("engine: ")
    assert len(error.splitlines()) == 1


def test_an_orphan_does_not_start(tmp_path):
    orphan = msgspec.structs.replace(handover(tmp_path), supervisor=1)
    with Engine(orphan) as engine:
        engine.process.communicate(timeout=20)
        assert engine.process.returncode == -signal.SIGKILL
    assert list(tmp_path.iterdir()) == []


class Circle:
    """Reference cycle that only the garbage collector finds."""

    def __init__(self):
        self.me = self


def test_garbage_does_not_pile_up(tmp_path, monkeypatch):
    monkeypatch.setattr(engine_process, "GARBAGE", 50)
    handler = signal.getsignal(signal.SIGTERM)
    engine, services = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    plant = EnginePlant(handover(tmp_path))
    stop = StopFlag()
    circles = []
    receive = plant.engine.handle_timeout

    def make_circles(now_ns):
        receive(now_ns)
        circles.extend(weakref.ref(Circle()) for _ in range(100))
        stop.is_set = len(circles) > 5 and circles[0]() is None

    monkeypatch.setattr(plant.engine, "handle_timeout", make_circles)
    gc.disable()
    try:
        plant.start(monotonic_ns())
        with engine, services:
            run_cycles(plant, engine, stop, lambda: None)
    finally:
        gc.enable()
        plant.close()
        signal.signal(signal.SIGTERM, handler)
    assert circles[0]() is None


pytestmark = pytest.mark.net

MS = 1_000_000
LATER_NS = 10_000 * MS


@pytest.fixture
def ticker():
    made = Ticker()
    yield made
    made.close()


@pytest.fixture
def pipes():
    ends = [os.pipe() for _ in range(2)]
    yield ends
    for pair in ends:
        for end in pair:
            os.close(end)


def in_ms(milliseconds):
    return time.monotonic_ns() + milliseconds * MS


def test_cycle_waiter_serves_readable_descriptors_only(ticker, pipes):
    served = []
    handlers = {
        read: lambda now_ns, read=read: served.append((os.read(read, 1), now_ns))
        for read, _ in pipes
    }
    arrivals = CycleWaiter(ticker, handlers)
    before_ns = time.monotonic_ns()
    os.write(pipes[1][1], b"x")
    assert not arrivals.wait(in_ms(10_000))
    ((octet, at_ns),) = served
    assert octet == b"x"
    assert before_ns < at_ns <= time.monotonic_ns()
    assert arrivals.wait(in_ms(1))
    assert len(served) == 1


def test_cycle_waiter_bounds_share_of_endless_descriptor(ticker, pipes, monkeypatch):
    monkeypatch.setattr(module, "WINDOW_NS", 50 * MS)
    monkeypatch.setattr(module, "SHARE_NS", 10 * MS)
    served = []

    def never_ready(now_ns):
        served.append(now_ns)
        while time.monotonic_ns() < now_ns + MS:
            pass

    os.write(pipes[0][1], b"x")  # and nobody reads it
    arrivals = CycleWaiter(ticker, {pipes[0][0]: never_ready})
    late = 0
    for _ in range(100):
        due_ns = in_ms(5)
        while not arrivals.wait(due_ns):
            pass
        late += time.monotonic_ns() > due_ns + 20 * MS
    assert len(served) >= 20
    # Eleven calls of a millisecond use up the share of a window; these are two windows apart.
    apart = zip(served, served[22:], strict=False)
    assert all(later_ns - earlier_ns >= 50 * MS for earlier_ns, later_ns in apart)
    assert late <= 10


def test_a_wait_for_the_next_window_is_no_deadline(ticker, pipes, monkeypatch):
    monkeypatch.setattr(module, "SHARE_NS", 0)
    os.write(pipes[0][1], b"x")
    served = []
    arrivals = CycleWaiter(ticker, {pipes[0][0]: served.append})
    deadline_ns = time.monotonic_ns() + LATER_NS
    while len(served) < 3:
        assert not arrivals.wait(deadline_ns)
    assert served[2] - served[1] >= module.WINDOW_NS // 2
