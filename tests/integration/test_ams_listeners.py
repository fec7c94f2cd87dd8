"""AMS/TCP 48898 and UDP 48899 at the addresses of running stations.

The client is written apart from our codec.
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import time
from collections import Counter
from contextlib import ExitStack
from typing import Any

import pytest

from eap.services.transports.ams_tcp import LIMITS
from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import Appliance, Plants, wait_until
from tests.support.namespaces import Namespace, cable
from tests.support.vectors import load

pytestmark = pytest.mark.net

LEFT, RIGHT, LONE = (f"127.9.48.{number}" for number in (1, 2, 3))
FIRST, SECOND, THIRD = f"{LEFT}.2.1", f"{LEFT}.2.2", f"{RIGHT}.2.1"
PLANT = f"""\
plant: doors
defaults: {{cycle_us: 10000}}
stations:
  - name: left
    net_id: {LEFT}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{LEFT}", net_id: {FIRST}}}
  - name: lodger
    net_id: {LEFT}.1.2
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{LEFT}:5000", net_id: {SECOND}}}
  - name: right
    net_id: {RIGHT}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{RIGHT}", net_id: {THIRD}}}
"""
ALONE = f"""\
plant: alone
stations:
  - name: left
    net_id: {LONE}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{LONE}", net_id: {LONE}.2.1}}
"""
ADD_ROUTE, SERVER_INFO = (vector.octets for vector in load("ams_discovery"))


def discover(address: str, question: bytes, count: int) -> list[bytes]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
        client.settimeout(5)
        client.sendto(question, (address, 48899))
        return [client.recv(400) for _ in range(count)]


@pytest.fixture(scope="module")
def appliance(module_farm: Plants) -> Appliance:
    wait_until(lambda: all(map(is_free, (LEFT, RIGHT))))
    return module_farm.run(module_farm.write(PLANT))


def is_free(address: str) -> bool:
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((address, 48898))
        except OSError:
            return False
    return True


def test_every_dictionary_of_an_address_by_one_connection(appliance: Appliance) -> None:
    with AmsClient(LEFT) as client, AmsClient(RIGHT) as other:
        assert [client.net_id(target) for target in (FIRST, SECOND, FIRST)] == [
            FIRST,
            SECOND,
            FIRST,
        ]
        assert other.net_id(THIRD) == THIRD
        assert client.ask("9.9.9.9.1.1", aoe.READ_STATE, b"") == (7, b"")
        assert client.net_id(THIRD) == THIRD  # by a route
        router = client.ask(f"{LEFT}.1.1", aoe.READ_STATE, b"")
        assert router == (0, bytes.fromhex("00000000 0500 0800"))
        wanted = struct.pack("<H", 2)
        written = client.ask(FIRST, aoe.WRITE, aoe.write_body(0xF200 << 16 | 1, wanted))
        assert written == (0, bytes(4))
        assert client.net_id(FIRST) == FIRST
        assert [appliance.station(name)["state"] for name in ("left", "lodger")] == ["PREOP", "OP"]
        wanted = struct.pack("<H", 8)
        written = client.ask(FIRST, aoe.WRITE, aoe.write_body(0xF200 << 16 | 1, wanted))
        assert written == (0, bytes(4))


def test_routers_are_found_by_address(appliance: Appliance) -> None:
    found = {answer[12:18] for answer in discover(LEFT, SERVER_INFO, 2)}
    assert found == {aoe.net_id(f"{LEFT}.1.{n}") for n in (1, 2)}
    (answer,) = discover(RIGHT, SERVER_INFO, 1)
    assert answer[12:18] == aoe.net_id(f"{RIGHT}.1.1")
    (answer,) = discover(RIGHT, ADD_ROUTE, 1)
    assert answer[8:12] == b"\6\0\0\x80"
    assert answer[-8:] == b"\1\0\4\0\0\0\0\0"  # who is on this host may


def test_listeners_outlive_services(appliance: Appliance) -> None:
    with AmsClient(LEFT) as client:
        assert client.net_id(FIRST) == FIRST
        services = appliance.pid("services")
        os.kill(services, signal.SIGKILL)
        with AmsClient(LEFT) as next_client:  # accepted when services is back
            next_client.socket.settimeout(15)
            assert next_client.net_id(FIRST) == FIRST
        assert client.socket.recv(1) == b""
    assert appliance.pid("services") != services


def evicted(appliance: Appliance) -> int:
    """Return how many connections to the right station made room for others."""
    name = f"ams-tcp {RIGHT}:48898"
    rows: list[dict[str, Any]] = appliance.status()["listeners"]
    return sum(row["evicted"] for row in rows if row["name"] == name)


def test_bad_clients_are_counted_and_the_others_served(appliance: Appliance) -> None:
    before = {name: Counter(appliance.station(name)["discarded"]) for name in ("left", "right")}
    evicted_before = evicted(appliance)
    with AmsClient(RIGHT) as good:
        with AmsClient(RIGHT) as bad:
            bad.socket.sendall(b"GET / HTTP/1.1\r\n\r\n")
            assert bad.socket.recv(1) == b""
        with AmsClient(RIGHT) as bad:
            bad.send(aoe.packet(THIRD, aoe.READ, b"") + b"more than it says")
            bad._number = 1
            assert bad.receive() == (0xE, b"")
            bad.send(aoe.packet(THIRD, aoe.READ, b"", flags=5))
            assert good.net_id(THIRD) == THIRD
        idle = [socket.create_connection((RIGHT, 48898)) for _ in range(200)]
        # Programs of this host may have all places.
        wait_until(lambda: evicted(appliance) - evicted_before >= 72)
        assert good.net_id(THIRD) == THIRD
        for connection in idle:
            connection.close()
        for _ in range(5):
            discover(RIGHT, SERVER_INFO, 1)
    discarded = Counter(appliance.station("right")["discarded"]) - before["right"]
    assert [discarded[f"ams_{name}"] for name in ("type", "length", "unasked")] == [1, 1, 1]
    assert 72 <= evicted(appliance) - evicted_before <= 74
    assert "ams_full" not in discarded
    assert appliance.station("left")["discarded"] == before["left"]


def test_flood_leaves_memory_and_engine_alone(appliance: Appliance) -> None:
    """Clients that send ahead without reading, and one that is answered all the same."""
    before = appliance.status()["processes"]["services"]["rss"]
    restarts = appliance.status()["processes"]["engine"]["restarts"]
    packet = aoe.packet(FIRST, aoe.WRITE, aoe.write_body(0x2000 << 16, bytes(200_000)))
    flood = struct.pack("<HI", 0, len(packet)) + packet
    crowd = [socket.create_connection((LEFT, 48898)) for _ in range(20)]
    try:
        for each in crowd:
            each.setblocking(False)
        end = time.monotonic() + 1.5
        with AmsClient(LEFT) as good:
            while time.monotonic() < end:
                for each in crowd:
                    try:
                        each.send(flood)
                    except BlockingIOError:
                        pass
                    except OSError:
                        continue
                assert good.net_id(FIRST) == FIRST
        grown = appliance.status()["processes"]["services"]["rss"] - before
        assert grown < 32 << 20
    finally:
        for each in crowd:
            each.close()
    assert appliance.status()["processes"]["engine"]["restarts"] == restarts


def test_port_that_is_taken_is_named_with_what_to_do(farm: Plants) -> None:
    wait_until(lambda: is_free(LONE))
    with socket.create_server((LONE, 48898)):
        code, _, text = farm.start(farm.write(ALONE)).finish()
        assert code == 2
        assert f"TCP {LONE}:48898 is in use by process {os.getpid()}" in text
        assert "`ams: false`" in text
        without = ALONE.replace("}\n", ", ams: false}\n")
        farm.run(farm.write(without, "without.yaml"))


@pytest.mark.root
def test_other_hosts_read_and_do_not_write(farm: Plants) -> None:
    with cable(addresses=True) as (here, there):
        address = "10.88.164.1"
        plant = farm.write(ALONE.replace(LONE, address))
        appliance = farm.run(plant, prefix=here.prefix)
        target = f"{address}.2.1"
        write = aoe.write_body(0xF200 << 16 | 1, struct.pack("<H", 2))
        with AmsClient(address, there.socket(socket.AF_INET, socket.SOCK_STREAM)) as client:
            assert client.net_id(target) == target
            assert client.ask(target, aoe.WRITE, write) == (0x723, b"")
            assert client.net_id(target) == target
        assert appliance.station("left")["discarded"] == {}
        with AmsClient(address, here.socket(socket.AF_INET, socket.SOCK_STREAM)) as client:
            assert client.ask(target, aoe.WRITE, write) == (0, bytes(4))
        assert appliance.station("left")["state"] == "PREOP"


@pytest.mark.root
def test_other_host_does_not_take_all_places(farm: Plants) -> None:
    with cable(addresses=True) as (here, there), ExitStack() as stack:
        address = "10.88.164.1"
        appliance = farm.run(farm.write(ALONE.replace(LONE, address)), prefix=here.prefix)
        target = f"{address}.2.1"

        def connect(host: Namespace) -> AmsClient:
            sock = host.socket(socket.AF_INET, socket.SOCK_STREAM)
            return stack.enter_context(AmsClient(address, sock))

        share = LIMITS.per_host
        greedy = [connect(there) for _ in range(share)]
        assert [each.net_id(target) for each in greedy] == [target] * share
        refused = [connect(there) for _ in range(3)]  # all of its own are in use
        assert all(each.socket.recv(1) == b"" for each in refused)
        assert appliance.station("left")["discarded"] == {"ams_full": 3}
        assert connect(here).net_id(target) == target
        greedy[0].socket.close()
        wait_until(lambda: _is_served(connect(there), target))


def _is_served(client: AmsClient, target: str) -> bool:
    try:
        return client.net_id(target) == target
    except (AssertionError, OSError):
        return False
