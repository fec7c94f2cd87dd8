"""A segment that answers by UDP, and takes faults while it runs."""

from __future__ import annotations

import json
import os
import queue
import select
import signal
import socket
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest

from devicebus.sim.devices.build import build_slave
from devicebus.sim.fault import FaultySegment
from devicebus.sim.segment import SegmentEnd, SimulatedSegment
from devicebus.sim.spec import BusSpec
from devicebus.wire.datagram import Command, encode_frame, iter_datagrams
from eap.errors import ConfigError
from eap.ids import InterfaceUri
from eap.runtime.busfile import BusFile, load_or_raise
from eap.runtime.handover import SegmentHandover
from eap.segment import process as segment_process
from eap.segment.process import load_copy
from tests.support.bus import datagram, generic
from tests.support.startup import read_reports

pytestmark = pytest.mark.net

ADDRESS = ("127.0.9.7", 34980)
SCAN = encode_frame([datagram(Command.BRD, 0, 0, b"\0")])


@pytest.fixture
def master():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.settimeout(5)
        yield sock


def scan(master):
    master.sendto(SCAN, ADDRESS)
    data, sender = master.recvfrom(2048)
    assert sender == ADDRESS
    return next(iter_datagrams(data)).wkc


def run_with(script):
    """Run a segment of two slaves in this thread; *script* plays the master in another."""
    said = []
    read_end, write_end = os.pipe()
    failures = []

    answers = queue.Queue()

    def say(line):
        said.append(line)
        if line.get("ready"):
            threading.Thread(target=play).start()
        else:
            answers.put(line)

    def command(text):
        os.write(write_end, text.encode() + b"\n")
        return answers.get(timeout=20)

    def play():
        try:
            script(command)
        except BaseException as exc:  # noqa: BLE001  shown by the test's own thread
            failures.append(exc)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    bus = BusFile(BusSpec(bus="b", slaves=(generic("a"), generic("b"))), {}, {})
    try:
        segment_process.run(bus, InterfaceUri.parse("udp://127.0.9.7"), say, command_fd=read_end)
    finally:
        os.close(read_end)
        os.close(write_end)
    if failures:
        raise failures[0]
    return said


def test_segment_answers_until_signal(master):
    assert run_with(lambda _: scan(master)) == [{"ready": True, "slaves": 2}]


def test_faults_by_command(master):
    def script(command):
        assert scan(master) == 2
        assert command(json.dumps({"kind": "power", "slave": "b"})) == {"ok": True}
        assert scan(master) == 1
        assert command(json.dumps({"kind": "power", "slave": "b", "end": True})) == {"ok": True}
        assert scan(master) == 2

    assert len(run_with(script)) == 3


def test_command_that_cannot_be(master):
    def script(command):
        for text in ("nonsense", '{"kind": "rain"}', json.dumps({"kind": "cut", "slave": "x"})):
            assert command(text)["ok"] is False
        assert scan(master) == 2

    assert "no slave 'x'" in run_with(script)[-1]["error"]


def test_values_by_command_and_answers_with_the_number_of_the_command(master):
    def script(command):
        told = {"id": 7, "set": {"slave": "b", "entry": "level", "value": 9}}
        assert command(json.dumps(told)) == {"ok": True, "id": 7}
        told = {"id": 8, "release": {"slave": "b", "entry": "limit"}}
        answer = command(json.dumps(told))
        assert (answer["ok"], answer["id"]) == (False, 8)
        assert command("[]") == {"ok": False, "error": "a command is a JSON object"}

    assert len(run_with(script)) == 4


def test_commands_may_come_in_pieces_and_end(master):
    bus = BusFile(BusSpec(bus="b", slaves=(generic("a"),)), {}, {})
    read_end, write_end = os.pipe()
    said = []

    def say(line):
        said.append(line)
        if line.get("ready"):
            os.write(write_end, b'{"kind": "cut", ')
            os.write(write_end, b'"slave": "a"}\n\n{"kind"')
            os.close(write_end)
            return
        os.kill(os.getpid(), signal.SIGTERM)

    try:
        interface = InterfaceUri.parse("udp://127.0.9.7")
        segment_process.run(bus, interface, say, command_fd=read_end)
    finally:
        os.close(read_end)
    assert said[1:] == [{"ok": True}]


def test_late_frame_comes_when_its_time_has_come(master):
    def script(command):
        assert command(json.dumps({"kind": "delay", "delay_us": 20_000}))["ok"]
        for _ in range(5):
            assert scan(master) == 2

    assert run_with(script)[1] == {"ok": True}


MODULE = "eap.segment.process"


class Child:
    """The process that the supervisor starts for a simulated bus."""

    def __init__(self, file, *, supervisor=None, stale=()):
        self.frames, frames = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.commands, commands = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for frame in stale:
            self.frames.send(frame)
        self.ready, ready = os.pipe()
        given = SegmentHandover(
            supervisor or os.getpid(), str(file), "", "", frames.fileno(), commands.fileno()
        )
        fd = given.to_descriptor()
        self.process = subprocess.Popen(
            [sys.executable, "-m", "eap.runtime.startup", MODULE, str(fd), str(ready), ""],
            pass_fds=(fd, frames.fileno(), commands.fileno(), ready),
            stderr=subprocess.PIPE,
            text=True,
        )
        os.close(fd)
        os.close(ready)
        frames.close()
        commands.close()
        for end in (self.frames, self.commands):
            end.settimeout(5)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.process.kill()
        self.process.communicate()
        self.frames.close()
        self.commands.close()
        os.close(self.ready)

    def scan(self):
        self.frames.send(SCAN)
        return next(iter_datagrams(self.frames.recv(2048))).wkc

    def command(self, **spec):
        self.commands.send(json.dumps(spec).encode())
        return json.loads(self.commands.recv(65536))


@pytest.fixture
def bus_file(tmp_path):
    file = tmp_path / "bus.yaml"
    file.write_text("bus: b\nslaves: [{name: a, kind: coupler}, {name: b, kind: coupler}]\n")
    return file


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_segment_child_answers_new_frames_and_ends_on_sigterm(bus_file, number):
    with Child(bus_file, stale=[SCAN] * 20) as child:
        assert read_reports(child.ready)[-1].ready == {"slaves": 2}
        assert child.scan() == 2
        assert not select.select([child.frames], [], [], 0.1)[0]
        child.process.send_signal(number)
        assert child.process.communicate(timeout=20)[1] == ""
        assert child.process.returncode == 0


def test_child_takes_commands_one_a_message(bus_file):
    with Child(bus_file) as child:
        read_reports(child.ready)
        assert child.command(kind="power", slave="b", id=3) == {"ok": True, "id": 3}
        assert child.scan() == 1
        assert child.command(kind="power", slave="b", end=True) == {"ok": True}
        assert child.scan() == 2


def test_segment_child_runs_without_reader(bus_file):
    with Child(bus_file) as child:
        read_reports(child.ready)
        for _ in range(2000):
            child.commands.send(b"{}")
        assert child.scan() == 2


def test_child_without_a_bus_file_says_so_in_its_exit_code(bus_file):
    bus_file.write_text("bus: b\nslaves: []\n")
    with Child(bus_file) as child:
        error = child.process.communicate(timeout=20)[1]
        assert child.process.returncode == 2
        assert not any(each.ready for each in read_reports(child.ready))
    assert error.startswith("segment: ")
    assert "the bus has no slaves" in error


def test_segment_child_without_supervisor_does_not_start(bus_file):
    with Child(bus_file, supervisor=1) as child:
        child.process.communicate(timeout=20)
        assert child.process.returncode == -signal.SIGKILL


class StalledSocket:
    """One frame waits; the process runs on *stall_ns* after it should have."""

    def __init__(self, clock, stall_ns):
        self.clock = clock
        self.stall_ns = stall_ns
        self.arrivals = [SimpleNamespace(frame=bytearray(SCAN), origin=None), None]
        self.end_fd = None

    def receive(self):
        self.clock.now_ns += self.stall_ns
        self.stall_ns = 0
        return self.arrivals.pop(0)

    def send(self, frame, origin):
        pass


@pytest.mark.parametrize(("stall_ms", "postponed"), [(0, 0), (150, 1)])
def test_frames_that_waited_for_a_late_process_come_before_watchdogs(
    monkeypatch, stall_ms, postponed
):
    clock = SimpleNamespace(now_ns=10**9)
    monkeypatch.setattr(segment_process.time, "monotonic_ns", lambda: clock.now_ns)
    segment = FaultySegment(SimulatedSegment([build_slave(generic())]))
    calls = []
    monkeypatch.setattr(
        SimulatedSegment, "postpone_timeouts", lambda _, now_ns: calls.append(now_ns)
    )
    sock = StalledSocket(clock, stall_ms * 1_000_000)
    loop = segment_process._Loop(segment, {SegmentEnd.PRIMARY: sock}, None)
    monkeypatch.setattr(FaultySegment, "next_timeout", lambda _: 10**9 + 100_000_000)
    loop._poll_timeout_ms()
    loop._forward_frames()
    assert len(calls) == postponed


def test_slaves_stay_those_that_were_applied(tmp_path, capsys):
    file, copy = tmp_path / "bus.yaml", tmp_path / "copy.slaves"
    file.write_text("bus: b\nslaves: [{name: first, kind: coupler}]\n")
    digest = load_or_raise(file).digest()

    def slaves(digest):
        bus = load_copy(SegmentHandover(1, str(file), digest, str(copy), 5, 6))
        return [slave.name for slave in bus.spec.slaves]

    assert slaves(digest) == ["first"]
    file.write_text("bus: b\nslaves: [{name: second, kind: coupler}]\n")
    assert slaves(digest) == ["first"]
    copy.write_bytes(copy.read_bytes().replace(b"first", b"f\xff\xff\xff\xff"))
    assert slaves(digest) == ["second"]
    assert "has changed since it was applied" in capsys.readouterr().err
    assert load_copy(SegmentHandover(1, str(file), "", "", 5, 6)) == load_or_raise(file)
    file.write_text("bus: b\nslaves: []\n")
    with pytest.raises(ConfigError, match="no slaves"):
        slaves(digest)
