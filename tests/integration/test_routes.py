"""Stations that pass requests on, each an appliance of its own: AMS/TCP in, type 5 between them.

The client is written apart from our codec.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Iterator
from functools import partial

import pytest

from tests.integration.test_ams_listeners import AmsClient, is_free
from tests.support import aoe
from tests.support.appliance import Appliance, Plants, SharedAppliance, plants, wait_until
from tests.support.machine import slowness

pytestmark = pytest.mark.net

WEST, MIDDLE, EAST = (f"127.9.70.{number}" for number in (1, 2, 3))
HOLE = "127.9.70.5"
UNREACHABLE, TIMEOUT = 0x1B, 0x719
PLANT = """\
plant: chain
defaults: {{cycle_us: 10000}}
stations:
  - name: west
    net_id: 127.9.70.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "{scheme}://127.9.70.1", net_id: 127.9.70.1.2.1}}
    routes:
      - {{to: east, via: middle/eap0}}
      - {{to: north, net_id: 127.9.70.4.1.1, via: middle/eap0}}
      - {{to: hole, net_id: 127.9.70.5.1.1, via: "{hole}", probe: false}}
  - name: middle
    net_id: 127.9.70.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "{scheme}://127.9.70.2", net_id: 127.9.70.2.2.1}}
    routes:
      - {{to: north, net_id: 127.9.70.4.1.1, via: east/eap0}}
  - name: east
    net_id: 127.9.70.3.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "{scheme}://127.9.70.3", net_id: 127.9.70.3.2.1}}
    routes:
      - {{to: north, net_id: 127.9.70.4.1.1, via: west/eap0}}
"""
TARGET = f"{EAST}.2.1"


class Chain:
    """The stations, each an appliance of its own; one that a test ended is started again."""

    def __init__(self, farm: Plants, scheme: str) -> None:
        self.scheme = scheme
        self._farm = farm
        hole = HOLE if scheme == "udp" else f"{scheme}://{HOLE}"
        self._plant = farm.write(PLANT.format(scheme=scheme, hole=hole))
        self._stations: dict[str, SharedAppliance] = {}
        wait_until(lambda: all(map(is_free, (WEST, MIDDLE, EAST))))
        for name in ("east", "middle", "west"):
            self._stations[name] = SharedAppliance(partial(self._start, name))

    def __getitem__(self, name: str) -> Appliance:
        return self._stations[name].running()

    def run(self) -> None:
        """Run all stations."""
        for station in self._stations.values():
            station.running()

    def _start(self, name: str) -> Appliance:
        return self._farm.run(self._plant, "--station", name)


@pytest.fixture(scope="module", params=["udp", "tcp"])
def stations(request: pytest.FixtureRequest) -> Iterator[Chain]:
    with plants() as farm:
        yield Chain(farm, request.param)


@pytest.fixture
def chain(stations: Chain) -> Chain:
    stations.run()
    return stations


BY_UDP = pytest.mark.parametrize("stations", ["udp"], indirect=True)


def is_reached(client: AmsClient, target: str = TARGET) -> bool:
    return client.ask(target, aoe.READ_STATE, b"")[0] == 0


@pytest.mark.usefixtures("chain")
def test_answers_over_two_hops_return_to_their_clients() -> None:
    """Each answer comes back to who asked, long ones in fragments."""
    with AmsClient(WEST) as one, AmsClient(WEST) as other:
        wait_until(lambda: is_reached(one))
        for _ in range(50):
            assert one.net_id(TARGET) == TARGET
            assert other.net_id(f"{MIDDLE}.2.1") == f"{MIDDLE}.2.1"
        names = aoe.read_body(1 << 16, size=60_000, group=0xF3FC)
        error, data = one.ask(TARGET, aoe.READ, names)
        assert (error, data[:4]) == (0, bytes(4))
        (length,) = struct.unpack_from("<I", data, 4)
        assert len(data) == 8 + length
        written = one.ask(TARGET, aoe.WRITE, aoe.write_body(0xF200 << 16 | 1, b"\2\0"))
        assert written == (0, bytes(4))
        assert other.ask(TARGET, aoe.READ_STATE, b"") == (0, struct.pack("<IHH", 0, 15, 2))
        written = one.ask(TARGET, aoe.WRITE, aoe.write_body(0xF200 << 16 | 1, b"\x08\0"))
        assert written == (0, bytes(4))


def test_dead_hop_is_answered_for_at_once_and_comes_back(chain: Chain) -> None:
    west = chain["west"]
    with AmsClient(WEST) as client:
        wait_until(lambda: is_reached(client))
        chain["middle"].stop()
        errors = {client.ask(TARGET, aoe.READ_STATE, b"")[0]}
        assert errors <= {UNREACHABLE, TIMEOUT}
        wait_until(lambda: client.ask(TARGET, aoe.READ_STATE, b"")[0] == UNREACHABLE)
        began = time.monotonic()
        assert client.ask(TARGET, aoe.READ_STATE, b"")[0] == UNREACHABLE
        assert time.monotonic() - began < 0.5 * slowness()
        assert client.net_id(f"{WEST}.2.1") == f"{WEST}.2.1"
        (warning,) = west.status()["findings"]
        assert warning["what"].startswith(f"route to middle ({MIDDLE}:34980) is down: ")
        chain.run()
        wait_until(lambda: is_reached(client))
        wait_until(lambda: not west.status()["findings"])
    wait_until(lambda: f"({MIDDLE}:34980 by {chain.scheme}:eap0)" in west.log())
    assert "0x1b" in west.log()


@BY_UDP
def test_unknown_and_circles_are_answered_and_named(chain: Chain) -> None:
    """The route to north runs in a circle through all stations."""
    west = chain["west"]
    with AmsClient(WEST) as client:
        assert client.ask("9.9.9.9.1.1", aoe.READ_STATE, b"")[0] == 7
        wait_until(lambda: client.ask("127.9.70.4.2.1", aoe.READ_STATE, b"")[0] == 7)
        began = time.monotonic()
        assert client.ask("127.9.70.4.2.1", aoe.READ_STATE, b"")[0] == 7
        assert time.monotonic() - began < 1 * slowness()
        assert client.ask(f"{MIDDLE}.9.1", aoe.READ_STATE, b"")[0] == 7
        assert client.ask(f"{WEST}.9.1", aoe.READ_STATE, b"")[0] == 7
    assert "no route to 9.9.9.9.1.1" in west.log()
    wait_until(lambda: "routes to 127.9.70.4.2.1 run in a circle" in west.log())


@BY_UDP
def test_hop_that_swallows_everything(chain: Chain) -> None:
    """The one that waits is answered before clients give up; those that are too many at once."""
    west = chain["west"]
    hole = f"{HOLE}.2.1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as swallows:
        swallows.bind((HOLE, 34980))
        swallows.settimeout(10)
        with AmsClient(WEST) as client, aoe.UdpClient(WEST, hole) as crowd:
            for number in range(600):
                packet = aoe.packet(hole, aoe.READ_STATE, b"", invoke_id=number)
                crowd.socket.sendto(aoe.frame(packet), crowd.peer)
                if number < 500:  # the first ones are for the hole, not for a full socket
                    swallows.recv(2048)
            errors = [aoe.answer(crowd.socket.recv(2048)).error for _ in range(88)]
            assert errors == [4] * 88
            began = time.monotonic()
            assert client.ask(hole, aoe.READ_STATE, b"") == (TIMEOUT, b"")
            assert 4 < time.monotonic() - began < 5 * slowness()
            assert client.net_id(f"{WEST}.2.1") == f"{WEST}.2.1"
    _, _, text = west.stop()
    assert f"no answer from hole ({HOLE}:34980 by udp:eap0) within 4.5 s" in text
    assert "; repeated " in text, "and no line for each of them"


@BY_UDP
@pytest.mark.usefixtures("chain")
def test_notifications_come_through() -> None:
    asked = struct.pack("<6I16x", 0xF100, 0, 2, 3, 0, 500_000)  # the state, each 50 ms
    with AmsClient(WEST) as client:
        wait_until(lambda: is_reached(client))
        error, data = client.ask(TARGET, 6, asked)
        assert (error, data[:4]) == (0, bytes(4))
        for _ in range(3):
            client._number = 0  # as in notifications
            error, notice = client.receive()
            stamps, _, samples, handle, size = struct.unpack_from("<IQIII", notice, 4)
            assert (stamps, samples, handle, size) == (1, 1, *struct.unpack("<I", data[4:8]), 2)
            assert notice[-2:] == b"\5\0"
