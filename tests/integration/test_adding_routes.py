"""Routes that tools add by UDP 48899, and routers that are found by broadcast."""

from __future__ import annotations

import json
import socket
import struct
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.integration.test_ams_listeners import is_free
from tests.support.appliance import (
    Appliance,
    Plants,
    SharedAppliance,
    run_eapctl,
    wait_until,
)
from tests.support.namespaces import Namespace, cable
from tests.support.vectors import load

pytestmark = pytest.mark.net

OPEN, CLOSED = "127.9.71.1", "127.9.71.2"
TOOL = "192.168.0.10.1.1"
PLANT = """\
plant: adding
stations:
  - name: open
    net_id: 127.9.71.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.71.1", net_id: 127.9.71.1.2.1}
  - name: closed
    net_id: 127.9.71.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.71.2", net_id: 127.9.71.2.2.1}
    users: [{name: Administrator, password_file: password}]
"""
ALONE = """\
plant: alone
stations:
  - name: alone
    net_id: 10.88.164.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://10.88.164.1", net_id: 10.88.164.1.2.1}
"""
ADD_ROUTE, SERVER_INFO = (vector.octets for vector in load("ams_discovery"))


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> SharedAppliance:
    plant = module_farm.write(PLANT)
    (plant.parent / "password").write_text("secret\n")

    def begin() -> Appliance:
        wait_until(lambda: all(map(is_free, (OPEN, CLOSED))))
        return module_farm.run(plant)

    return SharedAppliance(begin)


@pytest.fixture
def appliance(shared: SharedAppliance) -> Appliance:
    return shared.running()


def added(appliance: Appliance, station: str) -> list[str]:
    (row,) = json.loads(appliance.command("routes", "list", station, "--json"))["stations"]
    return [route["name"] for route in row["routes"] if route["origin"] == "added"]


def state(appliance: Appliance, station: str, name: str) -> str:
    (row,) = appliance.request("routes_list", station=station, match=name)
    return str(row["routes"][0]["state"])


def test_pyads_adds_a_route_that_is_there_after_a_new_start(appliance, shared):
    pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

    def add(address: str, password: str, name: str = "tool") -> bool:
        return bool(
            pyads.add_route_to_plc(TOOL, "127.0.0.1", address, "Administrator", password, name)
        )

    assert pyads.pyads_ex.adsGetNetIdForPLC(CLOSED) == "127.9.71.2.1.1"
    assert add(OPEN, "whatever")  # from this host, and nobody has a password
    assert add(CLOSED, "secret")
    with pytest.raises(RuntimeError, match="Unexpected response") as refused:
        add(CLOSED, "guessed", "other")
    assert r"\x04\x07\x00\x00" in str(refused.value)  # which pyads 3.6 looks for one octet off
    assert [added(appliance, name) for name in ("open", "closed")] == [["tool"], ["tool"]]
    wait_until(lambda: state(appliance, "open", "tool") == "client")  # which listens nowhere
    tested = run_eapctl(appliance.runtime, "routes", "test")
    assert "is a client, not listening" in " ".join(tested.stdout.split())
    assert tested.returncode == 0
    with socket.create_server(("127.0.0.1", 48898)):
        wait_until(lambda: state(appliance, "open", "tool") != "client")
    appliance.command("routes", "remove", "open", "tool")
    appliance.stop()
    again = shared.running()
    assert [added(again, name) for name in ("open", "closed")] == [[], ["tool"]]


def test_routers_of_a_network_find_each_other(appliance):
    del appliance
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as tool:
        tool.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        tool.bind(("127.0.0.1", 0))
        tool.settimeout(5)
        tool.sendto(SERVER_INFO, ("127.255.255.255", 48899))
        missing = {(OPEN, 48899), (CLOSED, 48899)}
        while missing:  # whatever else runs on this machine answers too
            missing.discard(tool.recvfrom(400)[1])


def test_scan_lists_the_stations(appliance):
    lines = appliance.command("routes", "scan", "open", "--wait", "300", "--json").splitlines()
    rows = {row["name"]: row for row in map(json.loads, lines)}
    assert rows["closed"] == {
        "station": "open",
        "name": "closed",
        "net_id": "127.9.71.2.1.1",
        "address": CLOSED,
        "version": rows["closed"]["version"],
        "route": "closed",
        "is_learned": False,
    }
    refused = run_eapctl(appliance.runtime, "routes", "scan", "--address", "there")
    assert refused.returncode == 1
    assert "address: Expected 4 octets in 'there'" in refused.stderr


@pytest.fixture(scope="module")
def hosts(module_farm: Plants) -> Iterator[tuple[Appliance, Namespace, Namespace]]:
    """A station on one host, and another host beside it."""
    with cable(addresses=True) as (near, far):
        plant = module_farm.write(ALONE, "alone.yaml")
        yield module_farm.run(plant, prefix=near.prefix), near, far


@pytest.mark.root
def test_another_host_finds_a_router_by_broadcast_and_adds_no_route(hosts):
    appliance, _, far = hosts
    with far.socket(socket.AF_INET, socket.SOCK_DGRAM) as tool:
        tool.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        tool.bind(("10.88.164.2", 0))
        tool.settimeout(5)
        for address in ("10.88.164.255", "255.255.255.255", "10.88.164.1"):
            tool.sendto(SERVER_INFO, (address, 48899))
            answer, sender = tool.recvfrom(400)
            assert sender == ("10.88.164.1", 48899)
            assert answer[12:18] == bytes((10, 88, 164, 1, 1, 1))
        tool.sendto(ADD_ROUTE, ("10.88.164.1", 48899))
        assert tool.recv(400)[-4:] == struct.pack("<I", 0x704)
    assert added(appliance, "alone") == []


@pytest.mark.root
def test_a_router_of_another_host_is_found_and_its_route_is_learned(hosts):
    appliance, _, far = hosts
    kind = socket.AF_INET, socket.SOCK_DGRAM
    with far.socket(*kind) as asked, far.socket(*kind) as other, ThreadPoolExecutor(1) as thread:
        asked.bind(("10.88.164.255", 48899))
        asked.settimeout(5)
        other.bind(("10.88.164.2", 48899))
        rows = thread.submit(appliance.request, "routes_scan", station="alone", wait_ms=1000)
        question, sender = asked.recvfrom(400)
        head = question[:8] + struct.pack("<I", 0x8000_0001)
        answer = head + bytes((5, 1, 2, 3, 1, 1)) + struct.pack("<HIHH", 10000, 1, 5, 3) + b"cx\0"
        other.sendto(answer, sender)
        (row,) = rows.result()
    assert (row["name"], row["route"], row["is_learned"]) == ("cx", "cx", True)
    listed = json.loads(appliance.command("routes", "list", "alone", "--json"))
    (route,) = listed["stations"][0]["routes"]
    assert (route["origin"], route["address"]) == ("learned", "10.88.164.2:48898")
    assert 590 < route["expires_s"] <= 600
