"""EoE at a TAP interface: a web page, ping and slave-to-slave frames in a network namespace."""

from __future__ import annotations

import http.client
import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from scapy.layers.inet import ICMP, IP

from tests.support.appliance import Appliance, Plants, wait_until
from tests.support.namespaces import Namespace, cable

pytestmark = [pytest.mark.net, pytest.mark.root]

MILL = "127.9.61.1"
LEFT, RIGHT = "192.168.77.10", "192.168.77.11"
BUS = """\
bus: drives
slaves:
  - {name: left, kind: drive, product: 0x5621, mailbox: {size: 128, eoe: true}}
  - {name: right, kind: drive, product: 0x5622, mailbox: {size: 1024, eoe: true}}
"""
PLANT = f"""\
plant: web
stations:
  - name: mill
    net_id: {MILL}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{MILL}", net_id: {MILL}.2.1}}
      - name: bus0
        kind: bus
        interface: sim://drives.yaml
        net_id: {MILL}.3.1
        eoe:
          address: 192.168.77.1/24
          slaves:
            left: {{ip: {LEFT}/24, gateway: {RIGHT}, name: left-drive}}
            right: {{ip: {RIGHT}/24}}
"""


@pytest.fixture(scope="module", autouse=True)
def _device() -> None:
    try:
        os.close(os.open("/dev/net/tun", os.O_RDWR))
    except OSError:
        pytest.skip("needs /dev/net/tun: load the kernel module tun")


@pytest.fixture(scope="module")
def host() -> Iterator[Namespace]:
    with cable() as (left, _):
        yield left


@pytest.fixture(scope="module")
def plant(module_farm: Plants, host: Namespace) -> Appliance:
    (module_farm.folder / "drives.yaml").write_text(BUS)
    appliance = module_farm.start(module_farm.write(PLANT), prefix=host.prefix)
    assert appliance.wait_ready() == ["mill"]
    wait_until(lambda: {each["ip"] for each in ports_of(appliance)} == {LEFT, RIGHT})
    return appliance


def eoe_of(appliance: Appliance) -> dict:
    port = next(p for p in appliance.station("mill")["ports"] if p["name"] == "bus0")
    return port["bus"]["eoe"]


def ports_of(appliance: Appliance) -> list[dict]:
    return eoe_of(appliance)["slaves"]


@contextmanager
def page(host: Namespace, address: str, path: str = "/") -> Iterator[http.client.HTTPResponse]:
    with host.socket(socket.AF_INET, socket.SOCK_STREAM) as sock:
        sock.settimeout(30)
        sock.connect((address, 80))
        connection = http.client.HTTPConnection(address)
        connection.sock = sock
        connection.request("GET", path)
        with connection.getresponse() as response:
            yield response


def ping(host: Namespace, address: str, data: bytes) -> bytes:
    """Return the data of the answer to an ICMP echo request."""
    with host.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP) as sock:
        sock.settimeout(30)
        sock.sendto(bytes(ICMP(type=8, id=7) / data), (address, 0))
        while (answer := IP(sock.recv(65536)))[ICMP].type != 0:
            pass
        return bytes(answer[ICMP].payload)


@pytest.mark.parametrize(("address", "name"), [(LEFT, "left"), (RIGHT, "right")])
def test_web_page_of_a_slave_opens(
    plant: Appliance, host: Namespace, address: str, name: str
) -> None:
    with page(host, address) as response:
        text = response.read().decode()
        assert (response.status, f"<h1>{name}</h1>" in text, address in text) == (200, True, True)
    with page(host, address, "/other") as response:
        assert response.status == 404
    # Its settings are those of the plant file.
    ports = {each["name"]: each for each in ports_of(plant)}
    assert ports[name]["ip"] == address
    assert ports[name]["addresses"] == [f"02:01:05:30:03:{0xE9 + (name == 'right'):02x}"]


@pytest.mark.parametrize("size", [0, 1400])
@pytest.mark.parametrize("address", [LEFT, RIGHT])
def test_slave_answers_ping(plant: Appliance, host: Namespace, address: str, size: int) -> None:
    assert ping(host, address, bytes(size)) == bytes(size)


def test_page_opens_beside_sdos_which_do_not_starve(plant: Appliance, host: Namespace) -> None:
    start_s = time.monotonic()
    reads = pages = 0
    while pages < 3:
        with page(host, LEFT) as response:
            assert len(response.read()) > 100
        pages += 1
        for _ in range(5):
            row = json.loads(
                plant.command("bus", "sdo", "read", "mill/bus0", "1001", "0x1018:1", "--json")
            )
            assert row["value"] == 3674
            reads += 1
    assert (reads, time.monotonic() - start_s < 60) == (15, True)
    assert all(each["failed"] == each["invalid"] == 0 for each in ports_of(plant))


def test_slaves_reach_each_other(plant: Appliance, host: Namespace) -> None:
    # "left" looks for its gateway by ARP, and "right" answers it alone.
    def have_met() -> bool:
        ports = {each["name"]: each for each in ports_of(plant)}
        return ports["right"]["received"] >= 2 and ports["left"]["sent"] >= 2

    wait_until(have_met)


@pytest.mark.parametrize("process", ["services", "engine"])
def test_page_opens_again_after_a_restart(plant: Appliance, host: Namespace, process: str) -> None:
    pid = plant.pid(process)
    os.kill(pid, signal.SIGKILL)
    plant.wait_for_another(process, pid)

    def is_connected() -> bool:
        bus = plant.station("mill")["ports"][1].get("bus", {})
        return {each["ip"] for each in bus.get("eoe", {"slaves": []})["slaves"]} == {LEFT, RIGHT}

    wait_until(is_connected)
    with page(host, LEFT) as response:
        assert response.status == 200


def test_diagnosis_shows_the_ports_and_a_dead_interface(plant: Appliance, host: Namespace) -> None:
    text = plant.command("bus", "diag", "mill/bus0")
    assert "eoe-bus0    192.168.77.1/24" in text
    assert f"1001 left   {LEFT}" in text
    host.ip("link", "set", "eoe-bus0", "down")
    wait_until(lambda: "eoe-bus0 is down" in plant.command("bus", "diag", "mill/bus0"))
    assert "`ip link set eoe-bus0 up` as root" in plant.command("status")
    host.ip("link", "delete", "eoe-bus0")
    wait_until(lambda: not eoe_of(plant)["fault"])
    with page(host, RIGHT) as response:
        assert response.status == 200


def test_second_program_at_one_interface_is_told_why(
    plant: Appliance, module_farm: Plants, host: Namespace
) -> None:
    text = PLANT.replace("plant: web", "plant: second").replace(MILL, "127.9.61.2")
    other = module_farm.start(module_farm.write(text, "second.yaml"), prefix=host.prefix)
    assert other.wait_ready() == ["mill"]
    wait_until(lambda: "it is open already" in eoe_of(other)["fault"])
    # A bus that is being brought up has that finding alone.
    found = "EoE: TAP interface eoe-bus0: it is open already"
    wait_until(lambda: found in other.command("status"))
