"""pyads at slaves of running stations: the same as by ``eapctl bus``, near and through a hop."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from eap.codec.ads import AdsRange
from tests.support.appliance import Appliance, plants, wait_until
from tests.support.npm import needs_npm, node_environment
from tests.support.slavetool import SDO, SOE, Slave

pyads = pytest.importorskip("pyads", reason="needs pyads: pip install pyads")

pytestmark = pytest.mark.net

MILL, SAW = "127.9.50.1", "127.9.50.2"
DRIVE = f"{MILL}.3.1", 1001
SENSOR = f"{SAW}.3.1", 1003
ROOT = Path(__file__).parents[2]
BUSES = ROOT / "config" / "buses"
# Without a watchdog: a cycle that a busy machine delays takes no slave out of OP.
PATIENT = "watchdog: {process_data_ms: 0}"
PLANT = f"""\
plant: slaves
defaults: {{cycle_us: 25000}}
stations:
  - name: mill
    net_id: {MILL}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{MILL}", net_id: {MILL}.2.1}}
      - name: bus0
        kind: bus
        interface: "sim://{BUSES}/drive.yaml"
        net_id: {MILL}.3.1
        slaves: {{drive: {{{PATIENT}}}}}
  - name: saw
    net_id: {SAW}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{SAW}", net_id: {SAW}.2.1}}
      - name: bus0
        kind: bus
        interface: "sim://{BUSES}/coe.yaml"
        net_id: {SAW}.3.1
        slaves: {{buttons: {{{PATIENT}}}}}
"""


@pytest.fixture(scope="module")
def plant() -> Iterator[Appliance]:
    with plants() as farm:
        appliance = farm.run(farm.write(PLANT))
        for station in ("mill", "saw"):
            wait_until(lambda name=station: state_of(appliance, name) == 8)
        yield appliance


def state_of(appliance: Appliance, station: str) -> int:
    answer = appliance.request("read", station=station, names=["bus0.state"])
    return int(answer["values"]["bus0.state"])


def locally(appliance: Appliance, *words: str) -> Any:
    return json.loads(appliance.command("bus", *words, "--json"))


@contextmanager
def slave(target: tuple[str, int], via: str) -> Iterator[Slave]:
    with pyads.Connection(*target, via) as connection:
        yield Slave(connection)


@pytest.mark.parametrize("via", [MILL, SAW])
def test_same_values_as_locally(plant: Appliance, via: str, tmp_path: Path) -> None:
    with slave(DRIVE, via) as drive:
        for subindex in (1, 2, 3, 4):
            place = f"0x1018:{subindex}"
            here = locally(plant, "sdo", "read", "mill/bus0", "1001", place)
            assert drive.u32(SDO, 0x1018 << 16 | subindex) == here["value"]
        drive.write(SDO, 0x6065 << 16, (1234).to_bytes(4, "little"))
        here = locally(plant, "sdo", "read", "mill/bus0", "1001", "0x6065:0")
        assert here["value"] == 1234
        mode = locally(plant, "idn", "read", "mill/bus0", "1001", "S-0-0032")
        assert drive.u32(SOE, 0x40 << 16 | 32) == mode["value"]
        content = os.urandom(250_000)
        drive.store("firmware.bin", content)
        target = tmp_path / "firmware.bin"
        locally(plant, "foe", "get", "mill/bus0", "1001", "firmware.bin", str(target))
        assert target.read_bytes() == content
        assert drive.fetch("firmware.bin") == content
        head = bytes.fromhex("5a0e0000 0100")
        assert drive.ask(0xF430, 0, head + b"echo", 10) == head + b"echo"


def test_sum_command_reads_objects_of_a_slave(plant: Appliance) -> None:
    items = b"".join(
        AdsRange(SDO, offset, 4).encode() for offset in (0x1018_0001, 0x5555_0000, 0x1018_0002)
    )
    with slave(SENSOR, SAW) as sensor:
        found = sensor.ask(0xF080, 3, items, 3 * 4 + 3 * 4)
        results = [int.from_bytes(found[at : at + 4], "little") for at in range(0, 12, 4)]
        assert results == [0, 0x70C, 0]
        assert found[12:16] == sensor.u32(SDO, 0x1018_0001).to_bytes(4, "little")
        assert found[20:24] == b"\x52\x30\xbc\x0b"


def test_master_answers_groups_of_its_bus(plant: Appliance) -> None:
    with slave((SENSOR[0], 0xFFFF), MILL) as master:
        assert master.read(6, 0, 2) == b"\3\0"
        assert master.read(7, 0, 6) == bytes.fromhex("e903 ea03 eb03")
        assert master.read(9, 0, 6) == b"\x08\0" * 3
        command = bytes.fromhex("01ff 0000 0000 0400 0000 00000000 0000")
        assert master.ask(0x2C, 0, command, 16)[2:4] == b"\3\0"
        assert master.u32(SDO, 0x1000 << 16) == 1100 << 16 | 5001  # its dictionary
        with pytest.raises(pyads.ADSError) as refused:
            master.u32(SOE, 0)
        assert refused.value.err_code == 0x702


@pytest.mark.parametrize("via", [MILL, SAW])
def test_request_to_unknown_slave_is_refused(plant: Appliance, via: str) -> None:
    with slave((DRIVE[0], 1777), via) as nobody, pytest.raises(pyads.ADSError) as refused:
        nobody.u32(SDO, 0x1018_0001)
    assert refused.value.err_code == 6


def test_silent_slave_is_answered_before_clients_give_up(plant: Appliance) -> None:
    plant.command("sim", "fault", "saw/bus0", "mailbox", "slave=sensor")
    try:
        with slave(SENSOR, MILL) as sensor, slave((SENSOR[0], 1001), MILL) as coupler:
            start = time.monotonic()
            with pytest.raises(pyads.ADSError) as refused:
                sensor.u32(SDO, 0x1018_0001)
            assert (refused.value.err_code, time.monotonic() - start < 4.5) == (0x719, True)
            assert coupler.u32(SDO, 0x1018_0001) == 3674
        traced = json.loads(plant.command("trace", "saw/bus0/sensor", "--json"))
        (fault,) = traced["hops"][-1]["faults"]
        assert fault.startswith("saw/bus0: sensor (")
        assert "without reply in time" in fault
        assert (traced["ok"], traced["why"]) == (True, "")
    finally:
        plant.command("sim", "fault", "saw/bus0", "mailbox", "slave=sensor", "--end")


WRITER = """
import os, sys
import pyads
from tests.support.slavetool import Slave
with pyads.Connection(sys.argv[1], int(sys.argv[2]), sys.argv[3]) as connection:
    slave, content = Slave(connection), os.urandom(500_000)
    print("stores", flush=True)
    slave.store("firmware.bin", content)
    print(slave.fetch("firmware.bin") == content, flush=True)
"""


def test_file_does_not_keep_others_waiting(plant: Appliance) -> None:
    net_id, port = DRIVE
    words = [sys.executable, "-c", WRITER, net_id, str(port), SAW]
    writer = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        assert writer.stdout.readline() == "stores\n"
        longest_s, count = 0.0, 0
        with slave(DRIVE, MILL) as drive, slave(SENSOR, MILL) as sensor:
            while writer.poll() is None:
                for each in (drive, sensor):
                    start_s = time.monotonic()
                    assert each.u32(SDO, 0x1018_0001) == 3674
                    longest_s = max(longest_s, time.monotonic() - start_s)
                    count += 1
        assert writer.stdout.read() == "True\n"
        assert (longest_s < 1, count > 20) == (True, True)
    finally:
        writer.kill()
        writer.wait()
        writer.stdout.close()


WINDOW = SDO, 0x6065 << 16
"""0x6065:00 of the drive, which nothing but a client changes."""


class Watch:
    """Notifications of one connection of pyads on values of a slave."""

    def __init__(self, connection: Any) -> None:
        self._connection = connection
        self._handles: list[tuple[int, int]] = []

    def add(self, group: int, offset: int, mode: int, cycle_s: float) -> list[int]:
        """Return the list to which each notification adds its value."""
        told: list[int] = []

        def receive(notification: Any, _: Any) -> None:
            told.append(self._connection.parse_notification(notification, pyads.PLCTYPE_UDINT)[2])

        attributes = pyads.NotificationAttrib(4, mode, max_delay=0, cycle_time=cycle_s)
        self._handles.append(
            self._connection.add_device_notification((group, offset), attributes, receive)
        )
        return told

    def close(self) -> None:
        # AdsLib crashes when it closes a port that still has notifications.
        while self._handles:
            self._connection.del_device_notification(*self._handles.pop())


@contextmanager
def watching(target: tuple[str, int], via: str) -> Iterator[tuple[Slave, Watch]]:
    with pyads.Connection(*target, via) as connection:
        watch = Watch(connection)
        try:
            yield Slave(connection), watch
        finally:
            watch.close()


@pytest.mark.parametrize("via", [MILL, SAW])
def test_objects_of_slaves_are_watched_by_several_clients(plant: Appliance, via: str) -> None:
    with watching(DRIVE, via) as (drive, here), watching(DRIVE, via) as (_, there):
        drive.write(*WINDOW, (1000).to_bytes(4, "little"))
        changes = [each.add(*WINDOW, pyads.ADSTRANS_SERVERONCHA, 0.02) for each in (here, there)]
        cyclic = here.add(*WINDOW, pyads.ADSTRANS_SERVERCYCLE, 0.05)
        vendor = there.add(SDO, 0x1018_0001, pyads.ADSTRANS_SERVERCYCLE, 0.05)
        wait_until(lambda: all(told == [1000] for told in changes))
        drive.write(*WINDOW, (2345).to_bytes(4, "little"))
        wait_until(lambda: all(told == [1000, 2345] for told in changes))
        wait_until(lambda: len(cyclic) > 5 and cyclic[-1] == 2345 and len(vendor) > 5)
        assert set(vendor) == {3674}
        with pytest.raises(pyads.ADSError) as refused:
            here.add(SDO, 0x5555 << 16, pyads.ADSTRANS_SERVERCYCLE, 0.05)
        assert refused.value.err_code == 0x70C


SUBSCRIBER = """
const { Client } = require("ads-client");
const [netId, port, address] = process.argv.slice(1);
const client = new Client({
  targetAmsNetId: netId, targetAdsPort: Number(port), localAmsNetId: "192.168.5.5.1.1",
  localAdsPort: 40001, routerAddress: address, rawClient: true, autoReconnect: false,
});
(async () => {
  await client.connect();
  const told = [];
  const subscription = await client.subscribeRaw(0xF302, 0x60650000, 4, (data) => {
    told.push(data.value.readUInt32LE(0));
    console.log(JSON.stringify(told));
  }, 50);
  process.stdin.on("data", async () => {
    await subscription.unsubscribe();
    await client.disconnect();
    process.exit(0);
  });
})().catch((error) => { console.error(error); process.exit(1); });
"""


@needs_npm("ads-client")
@pytest.mark.parametrize("via", [MILL, SAW])
def test_ads_client_watches_objects_of_slaves(plant: Appliance, via: str) -> None:
    with slave(DRIVE, MILL) as drive:
        drive.write(*WINDOW, (500).to_bytes(4, "little"))
        words = ["node", "-e", SUBSCRIBER, "--", DRIVE[0], str(DRIVE[1]), via]
        with subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=node_environment(),
        ) as node:
            assert node.stdout.readline() == "[500]\n"
            drive.write(*WINDOW, (501).to_bytes(4, "little"))
            assert node.stdout.readline() == "[500,501]\n"
            node.communicate("end\n")
        assert node.returncode == 0
