"""A segment that answers by UDP, and takes faults while it runs."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading

import pytest

from devicebus.sim.spec import BusSpec
from devicebus.wire.datagram import Command, encode_frame, iter_datagrams
from eap.appliance import segment_process
from eap.appliance.busfile import Bus
from eap.ids import InterfaceUri
from tests.support.bus import datagram, generic

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

    def say(line):
        said.append(line)
        if line.get("ready"):
            threading.Thread(target=play).start()

    def play():
        try:
            script(lambda text: os.write(write_end, text.encode() + b"\n"))
        except BaseException as exc:  # noqa: BLE001  shown by the test's own thread
            failures.append(exc)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)

    bus = Bus(BusSpec(bus="b", slaves=(generic("a"), generic("b"))), {})
    try:
        segment_process.run(bus, InterfaceUri.parse("udp://127.0.9.7"), say, command_fd=read_end)
    finally:
        os.close(read_end)
        os.close(write_end)
    if failures:
        raise failures[0]
    return said


def test_answers_until_it_is_asked_to_end(master):
    assert run_with(lambda _: scan(master)) == [{"ready": True, "slaves": 2}]


def test_faults_by_command(master):
    counts = []

    def script(command):
        counts.append(scan(master))
        command(json.dumps({"kind": "power", "slave": "b"}))
        counts.extend(scan(master) for _ in range(50))
        command(json.dumps({"kind": "power", "slave": "b", "end": True}))
        counts.extend(scan(master) for _ in range(50))
        command("nonsense")
        command(json.dumps({"kind": "cut", "slave": "x"}))
        scan(master)

    said = run_with(script)
    assert counts[0] == counts[-1] == 2
    assert counts[50] == 1
    assert said[1:3] == [{"ok": True}, {"ok": True}]
    assert [each["ok"] for each in said[3:]] == [False] * (len(said) - 3)
    assert "no slave 'x'" in said[-1]["error"]


def test_late_frame_comes_when_its_time_has_come(master):
    def script(command):
        command(json.dumps({"kind": "delay", "delay_us": 20_000}))
        for _ in range(5):
            assert scan(master) == 2

    assert run_with(script)[1] == {"ok": True}
