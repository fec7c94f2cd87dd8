"""Gateways to several buses of a plant: where they are served, whom addresses mean, stop and start.

The client is plain sockets and octets.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.appliance import Appliance, plants, wait_until

pytestmark = pytest.mark.net

BUSES = Path(__file__).parents[2] / "config" / "buses"
PLANT = """\
plant: doors
stations:
  - name: mill
    net_id: 127.9.88.1.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.88.1", net_id: 127.9.88.1.2.1}}
      - name: bus0
        kind: bus
        interface: "sim://{buses}/drive.yaml"
        net_id: 127.9.88.1.3.1
        gateway:
          addresses: {{0x9000: drive, 0x9001: press/bus0/1001, 0x9002: press/bus0,
                      0x9010: [1001, 0x9001]}}
      - name: bus1
        kind: bus
        interface: "sim://{buses}/coe.yaml"
        net_id: 127.9.88.1.4.1
        gateway: {{full: true}}
  - name: press
    net_id: 127.9.88.2.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://127.9.88.2", net_id: 127.9.88.2.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://{buses}/drive.yaml", net_id: 127.9.88.2.3.1}}
"""
MILL = "127.9.88.1"
COE, SOE = 3, 5
VENDOR = bytes.fromhex("0020 40 1810 01 00000000")
GIVEN = bytes.fromhex("0030 43 1810 01")


def frame(address: int, body: bytes, kind: int = COE) -> bytes:
    mailbox = struct.pack("<HHBB", len(body), address, 0, kind | 0x10) + body
    return struct.pack("<H", len(mailbox) | 0x5000) + mailbox


class Client:
    """Asks by UDP."""

    def __init__(self, host: str = MILL, port: int = 34980) -> None:
        self._sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sock.connect((host, port))
        self._sock.settimeout(3)

    def ask(self, address: int, body: bytes, kind: int = COE) -> bytes:
        """Return the body of the answer."""
        self._sock.send(frame(address, body, kind))
        return self.answer()[1]

    def answer(self) -> tuple[int, bytes]:
        """Return address and body of the next answer."""
        data = self._sock.recv(2048)
        length, address = struct.unpack_from("<HH", data, 2)
        return address, data[8 : 8 + length]

    def is_silent(self) -> bool:
        self._sock.settimeout(0.3)
        try:
            self._sock.recv(2048)
        except TimeoutError:
            return True
        finally:
            self._sock.settimeout(3)
        return False

    def close(self) -> None:
        self._sock.close()


@pytest.fixture(scope="module")
def plant() -> Iterator[Appliance]:
    with plants() as farm:
        appliance = farm.run(farm.write(PLANT.format(buses=BUSES)))
        for station, states in (("mill", ["bus0.state", "bus1.state"]), ("press", ["bus0.state"])):
            wait_until(
                lambda station=station, states=states: (
                    set(appliance.request("read", station=station, names=states)["values"].values())
                    == {8}
                )
            )
        yield appliance


@pytest.fixture
def client() -> Iterator[Client]:
    client = Client()
    yield client
    client.close()


def test_each_bus_has_a_port_number(plant: Appliance, client: Client) -> None:
    second = Client(port=34981)
    try:
        assert client.ask(1001, VENDOR)[:6] == GIVEN
        assert client.ask(1003, VENDOR)[2] == 0x80  # the drive is alone there
        assert second.ask(1003, VENDOR)[:6] == GIVEN
        assert second.ask(0, bytes.fromhex("0020 40 20f0 00 00000000"))[6] == 3
        assert second.ask(0, bytes.fromhex("0020 40 00a0 00 00000000"))[6] == 19
        assert client.ask(0, bytes.fromhex("0020 40 00a0 00 00000000"))[6] == 17
    finally:
        second.close()


def test_the_second_one_by_tcp(plant: Appliance) -> None:
    with socket.create_connection((MILL, 34981), 3) as sock:
        sock.sendall(frame(1002, VENDOR)[:5])
        sock.sendall(frame(1002, VENDOR)[5:])
        data = b""
        while len(data) < 18:
            data += sock.recv(2048)
        assert data[8:14] == GIVEN


def test_aoe_to_the_station_is_at_34980_alone(plant: Appliance) -> None:
    second = Client(port=34981)
    try:
        ams = bytes((127, 9, 88, 1, 1, 1)) + struct.pack("<H", 10000) + bytes(6) + b"\0\x80"
        request = ams + struct.pack("<HHIII", 4, 4, 0, 0, 7)
        answer = second.ask(0, request, kind=1)
        # An AMS error, for AoE to the master goes to 34980: the service is not supported here.
        assert struct.unpack_from("<HHIII", answer, 16) == (4, 5, 0, 0x701, 7)
    finally:
        second.close()


def test_gateway_answers_at_virtual_addresses(plant: Appliance, client: Client) -> None:
    assert client.ask(0x9000, VENDOR)[:6] == GIVEN
    client._sock.send(frame(0x9010, VENDOR))
    found = dict(client.answer() for _ in range(2))
    assert set(found) == {1001, 0x9001}
    assert found[1001][:6] == GIVEN


def test_a_slave_of_another_station(plant: Appliance, client: Client) -> None:
    there = Client("127.9.88.2")
    try:
        write = bytes.fromhex("0020 23 0080 01 0f000000")
        assert client.ask(0x9001, write).hex() == "0030" + "60" + "0080" + "01" + "00000000"
        read = bytes.fromhex("0020 40 0080 01 00000000")
        assert client.ask(0x9001, read) == there.ask(1001, read)
        idn = bytes.fromhex("01 42 2000")  # name and value of S-0-0032
        assert client.ask(0x9001, idn, SOE) == there.ask(1001, idn, SOE)
        for request in (
            "0080 01 00 0000 0100",
            "0080 05 00 0000 1810 01 00",
            "0080 03 00 0000 5555",
        ):
            octets = bytes.fromhex(request)
            assert client.ask(0x9001, octets)[:6] == there.ask(1001, octets)[:6]
        missing = bytes.fromhex("0020 40 5555 00 00000000")
        assert client.ask(0x9001, missing) == there.ask(1001, missing)
        count = bytes.fromhex("0020 40 20f0 00 00000000")
        assert client.ask(0x9002, count) == there.ask(0, count)
    finally:
        there.close()


def test_stop_and_start(plant: Appliance, client: Client) -> None:
    (before,) = plant.request("gateway_status", station="mill", port="bus0")
    assert before["state"] == "running"
    assert f"udp://{MILL}:34980" in before["served"]
    plant.command("gateway", "stop", "mill/bus0")
    client._sock.send(frame(1001, VENDOR))
    assert client.is_silent()
    (row,) = plant.request("gateway_status", station="mill", port="bus0")
    assert (row["state"], row["dropped"]) == ("stopped", before["dropped"] + 1)
    discarded = {
        station["name"]: station["discarded"] for station in plant.request("status")["stations"]
    }
    assert discarded["mill"]["gateway_off"] == row["dropped"]
    values = plant.request("read", station="mill", names=["bus0.state"])["values"]
    assert values == {"bus0.state": 8}
    plant.command("gateway", "start", "mill")
    assert client.ask(1001, VENDOR)[:6] == GIVEN
    (after,) = plant.request("gateway_status", station="mill", port="bus0")
    assert [each["requests"] for each in after["clients"]] == [1]
