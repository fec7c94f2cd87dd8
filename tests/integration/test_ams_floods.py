"""AMS/TCP clients that flood, take nothing, or send what is no packet, all at the same time."""

from __future__ import annotations

import random
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest

from tests.support import aoe
from tests.support.appliance import Appliance, Plants, troubles, wait_until
from tests.support.machine import slowness

pytestmark = pytest.mark.net

ADDRESS, READER = "127.9.52.1", "127.9.52.2"
TARGET = f"{ADDRESS}.2.1"
SECONDS = 3.0
MOST_GROWN = 48 << 20
"""Octets that all these clients together may take; what each may is bounded, see the docs."""
PLANT = f"""\
plant: floods
defaults: {{cycle_us: 10000}}
stations:
  - name: target
    net_id: {ADDRESS}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{ADDRESS}", net_id: {TARGET}}}
    variables: {{ticks: UDINT}}
    sources:
      ticks: {{kind: counter}}
    frames:
      - {{name: out, port: eap0, to: reader/eap0}}
    publish:
      - {{name: state, frame: out, id: 1, variables: [ticks]}}
  - name: reader
    net_id: {READER}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{READER}", net_id: {READER}.2.1}}
    subscribe:
      - {{name: ticks, port: eap0, from: target/state, timeout_ms: 500}}
"""


def prefixed(packet: bytes) -> bytes:
    return struct.pack("<HI", 0, len(packet)) + packet


SMALL = prefixed(aoe.packet(TARGET, aoe.READ, aoe.read_body(0x10000000)))
_ITEM = struct.pack("<III", aoe.SDO, 0x10000000, 4)
LARGE = prefixed(
    aoe.packet(TARGET, 9, struct.pack("<IIII", 0xF080, 500, 500 * 8, 500 * 12) + 500 * _ITEM)
)
"""A sum of reads: as long a request as its answer."""
WRITE = prefixed(aoe.packet(TARGET, aoe.WRITE, aoe.write_body(0x20000000, bytes(200_000))))


@pytest.fixture
def appliance(farm: Plants) -> Appliance:
    return farm.run(farm.write(PLANT))


@contextmanager
def running(*works: Callable[[threading.Event], None]) -> Iterator[None]:
    stop = threading.Event()
    threads = [threading.Thread(target=work, args=(stop,)) for work in works]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join()


def never_read(octets: bytes, count: int) -> Callable[[threading.Event], None]:
    """Send the same again and again by some connections, and read nothing."""

    def work(stop: threading.Event) -> None:
        with ExitStack() as stack:
            crowd = [
                stack.enter_context(socket.create_connection((ADDRESS, 48898)))
                for _ in range(count)
            ]
            left = [memoryview(b"")] * count
            for each in crowd:
                each.setblocking(False)
            while not stop.is_set():
                for number, each in enumerate(crowd):
                    view = left[number] or memoryview(octets)
                    try:
                        left[number] = view[each.send(view) :]
                    except OSError:
                        continue  # no room, or closed for being slow
                time.sleep(0.001)

    return work


def come_and_go(stop: threading.Event) -> None:
    """Send what is no packet, or half of one, and go with or without a word."""
    dice = random.Random(5)
    while not stop.is_set():
        with socket.socket() as sock:
            if dice.random() < 0.5:
                linger = struct.pack("ii", 1, 0)
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
            try:
                sock.connect((ADDRESS, 48898))
                sock.sendall(dice.choice((dice.randbytes(50), SMALL[:40], SMALL * 3, b"")))
            except OSError:
                continue
        time.sleep(0.002)


def ask_for_a_while(sock: socket.socket, seconds: float) -> list[float]:
    """Return how long each answer took."""
    took = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        begin = time.monotonic()
        sock.sendall(SMALL)
        answer = sock.recv(400)
        assert answer[30:34] == bytes(4)
        took.append(time.monotonic() - begin)
    return took


def test_others_are_served_memory_is_bounded_and_the_engine_undisturbed(
    appliance: Appliance,
) -> None:
    wait_until(lambda: appliance.rx("reader", "ticks")["received"] > 20)
    before = appliance.status()
    lost = troubles(appliance.rx("reader", "ticks"))
    floods = [never_read(SMALL, 20), never_read(LARGE, 20), never_read(WRITE, 10), come_and_go]
    with socket.create_connection((ADDRESS, 48898)) as good:
        good.settimeout(10)
        with running(*floods):
            took = ask_for_a_while(good, SECONDS)
            during = appliance.status()
        ask_for_a_while(good, SECONDS / 10)
    grown = during["processes"]["services"]["rss"] - before["processes"]["services"]["rss"]
    assert grown < MOST_GROWN
    assert len(took) > 20
    assert max(took) < 2 * slowness()
    after = appliance.status()
    for name, process in before["processes"].items():
        assert after["processes"][name]["pid"] == process["pid"]
    assert troubles(appliance.rx("reader", "ticks")) == lost
    discarded = appliance.station("target")["discarded"]
    assert discarded["ams_type"] > 3
    assert "ams_full" not in discarded
