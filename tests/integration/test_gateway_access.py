"""Hosts on the cable read through the gateway, and change nothing without a rule."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from tests.support.appliance import Appliance, Plants, wait_until
from tests.support.gatewayplant import BUS, DRIVE, plant_of
from tests.support.gatewaywire import COE, FOE, PORT, SOE, VENDOR, VOE, Wire
from tests.support.namespaces import Namespace, cable

pytestmark = [pytest.mark.net, pytest.mark.root]

STATION, TOOL, OTHER = "10.88.164.1", "10.88.164.2", "10.88.164.3"
RULE = f"""\
    access:
      - name: recipes
        allow: [write]
        from: [{TOOL}/32]
        to: [mill/bus0/{DRIVE}]
        objects: [0x6065]
"""
OPEN, CLOSED = "0020 23 6560 00 d2040000", "0020 23 6760 00 d2040000"
MASTER = "0020 2b 00a0 02 08000000"
FILE = "02 00 00000000" + b"parameters.bin".hex()


@pytest.fixture(scope="module")
def there(module_farm: Plants) -> Iterator[Namespace]:
    with cable(addresses=True) as (here, there):
        there.ip("addr", "add", f"{OTHER}/24", "dev", "line0")
        module_farm.write(BUS, "gateway.yaml")
        plant = module_farm.write(plant_of(STATION, RULE))
        appliance = module_farm.run(plant, prefix=here.prefix)
        wait_until(lambda: is_up(appliance))
        yield there


def is_up(appliance: Appliance) -> bool:
    answer = appliance.request("read", station="mill", names=["bus0.state"])
    return bool(answer["values"]["bus0.state"] == 8)


def refused(client: Wire, kind: int, address: int, body: str) -> str:
    """Return what a refusal says behind what it repeats."""
    answer, data = client.talk(kind, address, bytes.fromhex(body))
    if kind == COE and data[2] == 0x80:
        return data[6:10].hex()
    return data.hex(" ") if answer == kind else f"mailbox {data[2]}"


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_STREAM])
def test_others_read_and_one_writes_as_a_rule_allows(there: Namespace, kind: int) -> None:
    clients = {}
    with there.socket(socket.AF_INET, kind) as first, there.socket(socket.AF_INET, kind) as second:
        for name, sock in ((TOOL, first), (OTHER, second)):
            sock.bind((name, 0))
            sock.connect((STATION, PORT))
            clients[name] = Wire(sock, kind == socket.SOCK_STREAM)
        for client in clients.values():
            assert client.talk(COE, DRIVE, VENDOR)[1][2:3] == b"\x43"
            assert client.talk(COE, 0, VENDOR)[1][2:3] == b"\x43"
            assert client.talk(SOE, DRIVE, bytes.fromhex("01 40 2000"))[1][:1] == b"\x02"
            for address, body in ((DRIVE, CLOSED), (0, MASTER), (0xC000 | 1, CLOSED)):
                assert refused(client, COE, address, body) in {"00000106", "00000206"}
            assert refused(client, SOE, DRIVE, "03 40 2000 02000000") == "14 40 20 00 05 70"
            assert refused(client, FOE, DRIVE, FILE).startswith("05 00 0a 80")
            assert refused(client, VOE, DRIVE, "64110000 0100 01") == "mailbox 4"
        assert refused(clients[OTHER], COE, DRIVE, OPEN) == "00000106"
        assert clients[TOOL].talk(COE, DRIVE, bytes.fromhex(OPEN))[1][2] == 0x60
        assert clients[OTHER].talk(COE, DRIVE, bytes.fromhex("0020 40 6560 00 00000000"))[1][
            6:10
        ] == bytes.fromhex("d2040000")
