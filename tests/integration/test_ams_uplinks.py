"""Routes by AMS/TCP: between stations, and to the test server that comes with pyads."""

from __future__ import annotations

import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.support import aoe
from tests.support.appliance import Appliance, Plants, wait_until

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

LEFT, RIGHT, PLC = "127.9.51.1", "127.9.51.2", "127.9.51.9"
CONTROLLER, BEHIND = "5.51.9.1.1.1", "5.51.9.2.1.1"
DEVICE, SDO, RUNTIME = 0xFFFF, 0xF302, 851
HOST_UNREACHABLE = 0x1B
PLANT = f"""\
plant: uplinks
defaults: {{cycle_us: 10000}}
stations:
  - name: left
    net_id: {LEFT}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{LEFT}", net_id: {LEFT}.2.1}}
    routes:
      - {{to: right, ams_tcp: right/eap0}}
      - {{to: plc, net_id: {CONTROLLER}, ams_tcp: {PLC}, probe: false}}
      - {{to: behind, net_id: {BEHIND}, ams_tcp: "{PLC}:48898", probe: false}}
  - name: right
    net_id: {RIGHT}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{RIGHT}", net_id: {RIGHT}.2.1}}
"""
SERVER = f"""
import time
from pyads.testserver import AdsTestServer, AdvancedHandler, PLCVariable
handler = AdvancedHandler()
handler.add_variable(PLCVariable("level", (4711).to_bytes(4, "little"), ads_type=19,
                                 symbol_type="UDINT", index_group=0x4020, index_offset=8))
with AdsTestServer(handler=handler, ip_address="{PLC}", logging=False) as server:
    print("ready", flush=True)
    time.sleep(600)
"""


@contextmanager
def controller() -> Iterator[None]:
    """Run pyads' own server, in a process that can be killed."""
    server = subprocess.Popen([sys.executable, "-c", SERVER], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        yield
    finally:
        server.kill()
        server.communicate()


@pytest.fixture(scope="module")
def appliance(module_farm: Plants) -> Appliance:
    return module_farm.run(module_farm.write(PLANT))


def own_net_id(target: str) -> str:
    """Return the NetID that a far dictionary says, asked at the left station."""
    with pyads.Connection(target, DEVICE, LEFT) as client:
        return ".".join(map(str, client.read(SDO, 0xF9200001, pyads.PLCTYPE_BYTE * 6)))


def level(target: str = CONTROLLER) -> int:
    with pyads.Connection(target, RUNTIME, LEFT) as client:
        return client.read(0x4020, 8, pyads.PLCTYPE_UDINT)


def failure(target: str = CONTROLLER) -> int:
    try:
        level(target)
    except pyads.ADSError as error:
        return error.err_code
    return 0


def test_station_reaches_the_dictionary_of_another(appliance: Appliance) -> None:
    assert own_net_id(f"{RIGHT}.2.1") == f"{RIGHT}.2.1"
    assert own_net_id(f"{LEFT}.2.1") == f"{LEFT}.2.1"
    with pyads.Connection(f"{RIGHT}.2.1", DEVICE, LEFT) as client:
        client.write(SDO, 0xF2000001, 2, pyads.PLCTYPE_UINT)
        assert appliance.station("right")["state"] == "PREOP"
        client.write(SDO, 0xF2000001, 8, pyads.PLCTYPE_UINT)


def test_controller_with_several_net_ids_that_comes_and_goes(appliance: Appliance) -> None:
    wait_until(lambda: failure() == HOST_UNREACHABLE)
    for _ in range(2):
        with controller():
            wait_until(lambda: failure() == 0)
            assert [level(CONTROLLER), level(BEHIND)] == [4711, 4711]
            assert own_net_id(f"{RIGHT}.2.1") == f"{RIGHT}.2.1"
        wait_until(lambda: failure() == HOST_UNREACHABLE)
        assert failure(BEHIND) == HOST_UNREACHABLE


def test_peer_has_one_connection_and_may_ask_on_it(appliance: Appliance) -> None:
    """As routers do that have no other connection to us."""
    del appliance
    with socket.create_server((PLC, 48898)) as listener:
        listener.settimeout(20)
        sock, address = listener.accept()
        with sock:
            sock.settimeout(20)
            assert address[0] == LEFT
            ask = aoe.packet(f"{LEFT}.2.1", aoe.READ, aoe.read_body(0xF9200001), invoke_id=5)
            sock.sendall(struct.pack("<HI", 0, len(ask)) + ask)
            head = sock.recv(6, socket.MSG_WAITALL)
            answer = sock.recv(int.from_bytes(head[2:], "little"), socket.MSG_WAITALL)
            assert answer[24:32] == b"\0\0\0\0\5\0\0\0"
            assert answer[40:] == aoe.net_id(f"{LEFT}.2.1")
            listener.settimeout(1.5)
            with pytest.raises(TimeoutError):
                listener.accept()
