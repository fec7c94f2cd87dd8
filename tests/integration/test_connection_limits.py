"""Connections of many silent clients: others are served, and nothing runs out of descriptors."""

from __future__ import annotations

import socket
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from tests.support import aoe
from tests.support.amsclient import AmsClient
from tests.support.appliance import Appliance, Plants
from tests.support.namespaces import cable

pytestmark = pytest.mark.net

ADDRESS = "127.9.54.1"
PLANT = """\
plant: limits
defaults: {{cycle_us: 10000}}
stations:
  - name: left
    net_id: {address}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{address}", net_id: {address}.2.1, tcp: true}}
"""
PORTS = (48898, 34980)


def read_by_ams(sock: socket.socket, target: str) -> bool:
    with AmsClient(target, sock) as client:
        return client.net_id(f"{target}.2.1") == f"{target}.2.1"


def read_by_frames(sock: socket.socket, target: str) -> bool:
    with sock:
        sock.settimeout(10)
        sock.connect((target, 34980))
        sock.sendall(aoe.frame(aoe.packet(f"{target}.2.1", 4, b"")))
        head = sock.recv(2)
        return len(head) == 2


READS: dict[int, Callable[[socket.socket, str], bool]] = {
    48898: read_by_ams,
    34980: read_by_frames,
}


def listener(appliance: Appliance, name: str) -> dict[str, int]:
    return next(row for row in appliance.status()["listeners"] if row["name"].startswith(name))


@pytest.fixture
def silent() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.parametrize("port", PORTS)
def test_services_with_few_descriptors_serve_on_among_silent_connections(
    farm: Plants, silent: ExitStack, port: int
) -> None:
    plant = farm.write(PLANT.format(address=ADDRESS))
    appliance = farm.run(plant, prefix=["prlimit", "--nofile=60"])
    before = appliance.status()["processes"]
    for number in range(200):
        peer = silent.enter_context(socket.socket())
        peer.bind((f"127.9.55.{number % 12 + 1}", 0))
        peer.connect((ADDRESS, port))
    for _ in range(3):
        assert READS[port](silent.enter_context(socket.socket()), ADDRESS)
    after = appliance.status()["processes"]
    assert [after[each]["pid"] for each in after] == [before[each]["pid"] for each in before]
    assert after["services"]["descriptors"]["limit"] == 60
    row = listener(appliance, "ams-tcp" if port == 48898 else "tcp")
    assert row["evicted"] + row["refused"] > 150
    assert row["open"] < 45
    assert "closed in favour of others" in appliance.command("status", "--full")


def test_soft_limit_of_descriptors_is_raised_to_the_hard_one(farm: Plants) -> None:
    plant = farm.write(PLANT.format(address=ADDRESS))
    appliance = farm.run(plant, prefix=["prlimit", "--nofile=200:3000"])
    processes = appliance.status()["processes"]
    limits = [each["descriptors"]["limit"] for each in processes.values()]
    assert limits == [3000] * 3


@pytest.mark.root
@pytest.mark.parametrize("port", PORTS)
def test_held_connections_lock_out_neither_other_hosts_nor_this_one(
    farm: Plants, silent: ExitStack, port: int
) -> None:
    address = "10.88.164.1"
    with cable(addresses=True) as (here, there):
        there.ip("addr", "add", "10.88.164.3/24", "dev", "line0")
        appliance = farm.run(farm.write(PLANT.format(address=address)), prefix=here.prefix)
        start = b"\x04" if port == 34980 else struct.pack("<HI", 0, 50)
        for number in range(130):
            peer = silent.enter_context(there.socket(socket.AF_INET, socket.SOCK_STREAM))
            peer.connect((address, port))
            if number % 2:
                peer.sendall(start)
        other = there.socket(socket.AF_INET, socket.SOCK_STREAM)
        other.bind(("10.88.164.3", 0))
        assert READS[port](other, address)
        own = here.socket(socket.AF_INET, socket.SOCK_STREAM)
        assert READS[port](own, address)
        row = listener(appliance, "ams-tcp" if port == 48898 else "tcp")
        assert row["open"] <= 34
        assert row["evicted"] + row["refused"] >= 98
