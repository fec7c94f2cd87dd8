"""pyads, and AdsLib inside it, as the client of running stations.

``EAP_LONG=1`` makes the clients that run side by side ask 10,000 times each.
"""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import ExitStack

import pytest

from eap.od.profiles.eap1000 import Tx
from tests.support.appliance import Appliance, Plants

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

REQUESTS = 10_000 if os.environ.get("EAP_LONG") else 2000
ADDRESS, GATE, TCP_GATE = (f"127.9.49.{number}" for number in (1, 2, 3))
ROUTER, FIRST, SECOND = (f"{ADDRESS}.{end}" for end in ("1.1", "2.1", "2.2"))
DEVICE, SDO = 0xFFFF, 0xF302
PLANT = f"""\
plant: pyads
defaults: {{cycle_us: 10000}}
stations:
  - name: tower
    net_id: {ROUTER}
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{ADDRESS}", net_id: {FIRST}}}
      - {{name: eap1, kind: eap, interface: "udp://{ADDRESS}:5000", net_id: {SECOND}}}
    variables:
      level: {{type: UDINT, default: 4711}}
    frames:
      - {{name: out, port: eap0, to: 127.9.49.9}}
    publish:
      - {{name: state, frame: out, id: 77, variables: [level]}}
  - name: gate
    net_id: {GATE}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{GATE}", net_id: {GATE}.2.1}}
  - name: tcp-gate
    net_id: {TCP_GATE}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{TCP_GATE}", net_id: {TCP_GATE}.2.1}}
    routes: [{{to: tower, ams_tcp: tower/eap0}}]
"""
CLIENT = """
import ctypes, random, sys
import pyads
from pyads import constants
address, first, second, count, seed = sys.argv[1:]
pick = random.Random(int(seed))
octets = ctypes.c_uint8 * 6
def own(connection):
    return ".".join(map(str, connection.read(0xF302, 0xF9200001, octets)))
one, two = (pyads.Connection(net_id, 0xFFFF, address) for net_id in (first, second))
with one, two:
    questions = (
        lambda: own(one) == first,
        lambda: own(two) == second,
        lambda: one.read(0xF302, 0x10000000, pyads.PLCTYPE_UDINT) == 1000 << 16 | 5001,
        lambda: one.read_device_info()[0] == "tower/eap0",
        lambda: two.read_state() == (5, 8),
    )
    print("asking", flush=True)
    wrong = sum(not pick.choice(questions)() for _ in range(int(count)))
    print(wrong, "wrong of", count, flush=True)
"""

SUBSCRIBER = """
import sys, threading
import pyads
address, own, target = sys.argv[1:]
pyads.open_port()
pyads.set_local_address(own)
came = threading.Semaphore(0)
with pyads.Connection(target, 0xFFFF, address) as device:
    cyclic = pyads.NotificationAttrib(4, pyads.ADSTRANS_SERVERCYCLE, cycle_time=50)
    handles = device.add_device_notification("level", cyclic, lambda *_: came.release())
    samples = sum(came.acquire(timeout=20) for _ in range(5))
    device.del_device_notification(*handles)
print(samples, flush=True)
"""


@pytest.fixture(scope="module")
def appliance(module_farm: Plants) -> Appliance:
    return module_farm.run(module_farm.write(PLANT))


def start_client(
    count: int, seed: int, stack: ExitStack, address: str = ADDRESS
) -> subprocess.Popen[str]:
    """Start a client that checks each of *count* answers; return when it asks."""
    words = [address, FIRST, SECOND, str(count), str(seed)]
    client = subprocess.Popen(
        [sys.executable, "-c", CLIENT, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    stack.callback(end, client)
    assert client.stdout is not None
    assert client.stdout.readline() == "asking\n", client.communicate()[1]
    return client


def end(client: subprocess.Popen[str]) -> None:
    client.kill()
    client.communicate()


def test_reads_and_writes(appliance: Appliance) -> None:
    assert pyads.pyads_ex.adsGetNetIdForPLC(ADDRESS) == ROUTER
    with pyads.Connection(FIRST, DEVICE, ADDRESS) as device:
        assert device.read_device_info()[0] == "tower/eap0"
        assert device.read_state()[0] == 5
        assert device.read(SDO, 0xD000 << 16 | Tx.PD_ID, pyads.PLCTYPE_UINT) == 77
        device.write(SDO, 0xF2000001, 2, pyads.PLCTYPE_UINT)
        assert appliance.station("tower")["state"] == "PREOP"
        device.write(SDO, 0xF2000001, 8, pyads.PLCTYPE_UINT)
        with pytest.raises(pyads.ADSError) as refused:
            device.read(SDO, 0x20000000, pyads.PLCTYPE_UINT)
        assert refused.value.err_code == 0x70C
    for net_id, port, code in ((ROUTER, 851, 6), (FIRST, 851, 6), ("9.9.9.9.1.1", DEVICE, 7)):
        with pyads.Connection(net_id, port, ADDRESS) as nobody:
            with pytest.raises(pyads.ADSError) as refused:
                nobody.read_device_info()
            assert refused.value.err_code == code
    assert appliance.station("tower")["state"] == "OP"


def test_clients_of_one_address_keep_apart_while_others_die(appliance: Appliance) -> None:
    assert_all_are_answered(ADDRESS)
    assert appliance.station("tower")["discarded"] == {}


@pytest.mark.parametrize(
    ("station", "gate"),
    [("gate", GATE), ("tcp-gate", TCP_GATE)],
    ids=["type-5", "ams-tcp"],
)
def test_clients_of_one_address_keep_apart_through_another_station(
    appliance: Appliance, station: str, gate: str
) -> None:
    assert_all_are_answered(gate)
    for own in (f"{gate}.1.1", f"{gate}.2.1", ROUTER):  # those of the routers and of a port
        words = [sys.executable, "-c", SUBSCRIBER, gate, own, FIRST]
        run = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
        assert (run.returncode, run.stdout) == (0, "5\n"), run.stderr
    for name in ("tower", station):
        assert appliance.station(name)["discarded"] == {}


def assert_all_are_answered(address: str) -> None:
    """Have some clients ask the station at *address* at the same time, and kill others of them."""
    with ExitStack() as stack:
        dying = [start_client(10_000_000, seed, stack, address) for seed in (1, 2, 3)]
        clients = [start_client(REQUESTS, seed, stack, address) for seed in (4, 5)]
        for client in dying:
            assert client.poll() is None
            client.kill()
            client.wait()
        for client in clients:
            out, errors = client.communicate(timeout=120)
            assert (client.returncode, out) == (0, f"0 wrong of {REQUESTS}\n"), errors
