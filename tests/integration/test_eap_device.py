"""EAP devices of running stations, reached by AoE in frames of type 5 and by the control socket.

The client is written apart from our codec, and tshark reads what both sides send.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path

import msgspec
import pytest
from scapy.layers.inet import IP, UDP
from scapy.layers.l2 import Ether

from eap.codec.ethercat import EAP_PORT
from eap.errors import ControlError
from eap.ids import encode_value
from eap.od.profiles.eap1000 import Tx, Var
from eap.runtime.store import StationStore
from tests.support import aoe
from tests.support.aoe import UdpClient
from tests.support.appliance import Appliance, Plants, SharedAppliance, wait_until
from tests.support.tshark import dissect, write_pcap

pytestmark = pytest.mark.net

LEFT, RIGHT, BLANK = "127.9.41.1", "127.9.41.2", "127.9.41.3"
PLANT = f"""\
plant: devices
defaults: {{cycle_us: 10000}}
stations:
  - name: left
    net_id: {LEFT}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{LEFT}", net_id: {LEFT}.2.1}}
    variables:
      ticks: UDINT
      setpoint: {{type: UINT, unit: degC, default: 900}}
    sources:
      ticks: {{kind: counter}}
    frames:
      - {{name: out, port: eap0, to: right/eap0}}
    publish:
      - {{name: state, frame: out, id: 1, variables: [ticks, setpoint]}}
  - name: right
    net_id: {RIGHT}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{RIGHT}", net_id: {RIGHT}.2.1}}
    subscribe:
      - {{name: left-state, port: eap0, from: left/state}}
"""
OWN = "127.9.42"
"""Of a plant that one test has to itself, beside the one that the others share."""
PREOP, OP = 2, 8


def is_free(address: str) -> bool:
    """Tell whether nobody has the EAP port of *address*."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind((address, EAP_PORT))
        except OSError:
            return False
    return True


def wait_free(*addresses: str) -> None:
    """Wait for the end of processes whose supervisor was killed: they follow it a moment later."""
    wait_until(lambda: all(map(is_free, addresses)))


@pytest.fixture
def plant(farm: Plants) -> Path:
    return farm.write(PLANT.replace("127.9.41", OWN))


@pytest.fixture(scope="module")
def shared(module_farm: Plants) -> SharedAppliance:
    plant = module_farm.write(PLANT)

    def begin() -> Appliance:
        wait_free(LEFT, RIGHT)
        return module_farm.run(plant)

    return SharedAppliance(begin)


@pytest.fixture
def appliance(shared: SharedAppliance) -> Appliance:
    return shared.running()


@pytest.fixture
def left() -> UdpClient:
    with UdpClient(LEFT, f"{LEFT}.2.1", source="127.0.0.1") as client:
        yield client


def bring(client: UdpClient, state: int) -> aoe.Answer:
    return client.write(0xF200, 1, struct.pack("<H", state))


def with_version(spec: dict, version: int) -> dict:
    """Return a station's specification whose only PD has another version."""
    spec = json.loads(json.dumps(spec))
    spec["frames"][0]["pds"][0]["version"] = version
    return spec


def test_aoe_reads_the_running_configuration(appliance: Appliance, left: UdpClient) -> None:
    assert left.read(0x1000).data == struct.pack("<HH", 5001, 1000)
    assert left.read(0xF920, 1).data == aoe.net_id(f"{LEFT}.2.1")
    assert left.read(0xD000, Tx.NAME).data == b"state"
    first = int.from_bytes(left.read(0x6000, Var.VALUE).data, "little")
    wait_until(lambda: int.from_bytes(left.read(0x6000, Var.VALUE).data, "little") > first)
    whole = left.read(0xF000, complete=True).data
    assert whole[:2] == b"\2\0"
    listed = left.ask(aoe.READ, aoe.read_body(1 << 16, group=0xF3FC)).data
    indexes = struct.unpack(f"<{len(listed) // 2}H", listed)[1:]
    assert {0x1000, 0x1A00, 0x6000, 0x6001, 0x8000, 0xD000} <= set(indexes)
    for index in indexes:
        described = left.ask(aoe.READ, aoe.read_body(index << 16, group=0xF3FD))
        assert described.result == 0, f"0x{index:04X}"
        top = described.data[4]
        for subindex in range(1 if top else 0, top + 1):
            offset = index << 16 | 0x7F << 8 | subindex
            entry = left.ask(aoe.READ, aoe.read_body(offset, group=0xF3FE))
            assert entry.result in {0, 0x70C}
            assert left.read(index, subindex).result == entry.result


def test_eap_device_refuses_by_aoe_with_ads_codes(appliance: Appliance, left: UdpClient) -> None:
    assert left.read(0x2000).result == 0x70C
    assert left.read(0xD000, 200).result == 0x70C
    assert left.write(0xD000, Tx.PD_ID, b"\2\0").result == 0x712
    assert left.write(0xD000, Tx.PDO_LENGTH, b"\2\0").result == 0x704
    assert bring(left, 3).result == 0x706
    assert bring(left, PREOP).result == 0
    assert left.write(0xD000, Tx.PD_ID, b"\2").result == 0x705
    assert left.ask(aoe.READ, aoe.read_body(0x1000 << 16, 3)).result == 0x705
    assert left.ask(aoe.READ, aoe.read_body(0, group=0x4020)).result == 0x702
    assert left.ask(6, bytes(40)).result == 0x702
    assert left.ask(77, b"").error == 8
    assert left.ask(aoe.READ, aoe.read_body(0), port=1001).error == 6
    left.target = f"{LEFT}.1.1"
    assert left.read(0x1000).data == (9000 << 16 | 5001).to_bytes(4, "little")
    assert left.ask(aoe.READ, aoe.read_body(0), port=851).error == 6
    left.target = "9.9.9.9.2.1"
    assert left.read(0x1000).error == 7
    left.target = f"{RIGHT}.2.1"
    assert left.read(0x1000).error == 0  # by a route
    left.target = f"{LEFT}.2.1"
    assert bring(left, OP).result == 0


def test_configuration_by_aoe_comes_into_force(appliance: Appliance, left: UdpClient) -> None:
    before = appliance.request("export", station="left")["spec"]
    assert bring(left, PREOP).result == 0
    assert appliance.station("left")["state"] == "PREOP"
    assert left.write(0xD000, Tx.PDO_INDEX, bytes(2)).result == 0
    assert bring(left, OP).result == 0x712
    word, code, text, where = (left.read(0xF100, sub).data for sub in (1, 2, 3, 4))
    assert (word, code) == (b"\x12\0", b"\x02\x80")
    assert text.startswith(b"0xD000:01: PD has no PDO")
    assert where == struct.pack("<I", 0xD000_0100)
    assert left.write(0xD000, Tx.PDO_INDEX, struct.pack("<H", 0x1A00)).result == 0
    assert left.write(0xD000, Tx.PD_ID, b"\x05\0").result == 0
    assert bring(left, OP).result == 0
    wait_until(lambda: appliance.station("right")["discarded"].get("unknown_id", 0) > 5)
    assert json.loads(appliance.command("od", "read", "left", "0xD000:3", "--json"))["value"] == 5
    assert appliance.request("apply", station="left", spec=before)["ok"]


def test_both_ways_and_many_clients_at_a_time(appliance: Appliance) -> None:
    """Each client gets its own answers; downloads of one are seen by the others."""
    wrong: list[object] = []

    def read(number: int) -> None:
        with UdpClient(LEFT, f"{LEFT}.2.1", source="127.0.0.1") as client:
            for round_ in range(60):
                index, expected = [(0xF920, aoe.net_id(f"{LEFT}.2.1")), (0xF000, b"\1\0")][
                    (number + round_) % 2
                ]
                answer = client.read(index, 1)
                if answer.data != expected:
                    wrong.append(answer)

    threads = [threading.Thread(target=read, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    with socket.create_connection((LEFT, 34980)) as stream:
        for number in range(40):
            body = aoe.read_body(0xD000 << 16 | Tx.PD_ID)
            stream.sendall(aoe.frame(aoe.packet(f"{LEFT}.2.1", aoe.READ, body, invoke_id=number)))
        octets = b""
        stream.settimeout(5)
        while len(octets) < 40 * (2 + 6 + 32 + 8 + 2):
            octets += stream.recv(4096)
    for thread in threads:
        thread.join()
    assert wrong == []
    size = len(octets) // 40
    answers = [aoe.answer(octets[at : at + size]) for at in range(0, len(octets), size)]
    assert [(each.invoke_id, each.data) for each in answers] == [(n, b"\1\0") for n in range(40)]


def test_long_answer_comes_in_fragments(appliance: Appliance, left: UdpClient) -> None:
    """Of a dictionary with more objects than one datagram can list."""
    bring(left, PREOP)
    for number in range(800):
        assert left.write(0x6100 + number, Var.COMMENT, b"").result == 0
    body = aoe.read_body(1 << 16, 1 << 16, group=0xF3FC)
    left.socket.sendto(aoe.frame(aoe.packet(left.target, aoe.READ, body)), left.peer)
    content = b""
    for number in range(2):
        ams = aoe.opened(left.socket.recv(2048))
        command, flags, length, error, invoke = struct.unpack_from("<HHIII", ams, 16)
        assert (command, flags, error, invoke & 0xFFFF) == (0x0902, 6, 0, number)
        assert length == len(ams) - 32
        content += ams[32:]
    command, flags, length, error, invoke = struct.unpack_from("<HHIII", content)
    assert (command, flags, error, invoke) == (aoe.READ, 5, 0, 1)
    assert length == len(content) - 16
    result, size = struct.unpack_from("<II", content, 16)
    assert (result, size) == (0, len(content) - 24)
    assert size > 2 * 800
    appliance.close()  # and with it all these objects


@pytest.mark.tshark
def test_tshark_reads_both_directions(
    appliance: Appliance, left: UdpClient, tmp_path: Path
) -> None:
    questions = [
        aoe.packet(left.target, aoe.READ, aoe.read_body(0x1018 << 16 | 2)),
        aoe.packet(left.target, aoe.READ, aoe.read_body(0x2000 << 16)),
        aoe.packet(left.target, aoe.WRITE, aoe.write_body(0xF200 << 16 | 1, b"\x08\0")),
        aoe.packet("9.9.9.9.9.9", aoe.READ, aoe.read_body(0x1018 << 16)),
    ]
    frames = []
    for question in questions:
        sent = aoe.frame(question)
        left.socket.sendto(sent, left.peer)
        received = left.socket.recv(2048)
        there = Ether() / IP(src="127.0.0.1", dst=LEFT) / UDP(sport=4000, dport=34980)
        back = Ether() / IP(src=LEFT, dst="127.0.0.1") / UDP(sport=34980, dport=4000)
        frames += [bytes(there / sent), bytes(back / received)]
    seen = dissect(write_pcap(tmp_path / "aoe.pcap", frames))
    assert [packet["type"] for packet in seen] == [5] * 8
    assert not any(packet["malformed"] for packet in seen)
    headers = [packet["layers"]["ecat_mailbox"]["ams"] for packet in seen]
    codes = [int(ams["ams.errorcode"], 0) for ams in headers]
    assert codes == [0, 0, 0, 0, 0, 0, 0, 7]


def test_damaged_configuration_is_put_aside_and_the_plant_file_runs(
    farm: Plants, plant: Path
) -> None:
    appliance = farm.run(plant)
    spec = appliance.request("export", station="left")["spec"]
    assert appliance.request("apply", station="left", spec=with_version(spec, 3))["ok"]
    assert appliance.stop()[0] == 0
    path = StationStore("devices", "left").configuration.path
    octets = bytearray(path.read_bytes())
    octets[len(octets) // 2] ^= 1
    path.write_bytes(octets)

    again = farm.start(plant)
    again.wait_ready()
    assert again.request("export", station="left")["spec"] == spec
    wait_until(lambda: again.rx("right", "left-state")["received"] > 5)
    code, _, err = again.stop()
    assert code == 0
    assert str(path) in err
    assert path.with_suffix(".damaged").read_bytes() == octets
    assert not path.exists()


def test_applied_configuration_outlives_engine_services_and_supervisor(
    farm: Plants, plant: Path
) -> None:
    appliance = farm.run(plant)
    spec = appliance.request("export", station="left")["spec"]
    changed = with_version(spec, 3)
    assert appliance.request("apply", station="left", spec=changed)["ok"]

    def holds(running: Appliance) -> bool:
        dictionary = running.request("od_read", target="left", index=0xD000, subindex=4)
        (row,) = running.request("pd_list", station="left")
        exported = running.request("export", station="left")["spec"]
        return (dictionary["data"], row["version"], exported) == ("0300", 3, changed)

    assert holds(appliance)
    for process in ("engine", "services"):
        pid = appliance.pid(process)
        os.kill(pid, signal.SIGKILL)
        appliance.wait_for_another(process, pid)
        wait_until(lambda: holds(appliance))
    os.kill(appliance.process.pid, signal.SIGKILL)
    appliance.finish()
    wait_free(f"{OWN}.1", f"{OWN}.2")
    again = farm.run(plant)
    assert holds(again)
    assert again.request("rollback", station="left")["ok"]
    assert again.request("export", station="left")["spec"] == spec


@pytest.mark.parametrize("victim", ["engine", "services", "supervisor"])
def test_kill_in_the_middle_of_apply_leaves_a_whole_configuration(
    farm: Plants, plant: Path, victim: str
) -> None:
    """The old one or the new one, and the same in dictionary, engine and store."""
    appliance = farm.run(plant)
    runtime = appliance.runtime
    spec = appliance.request("export", station="left")["spec"]
    for version in range(1, 5):
        wanted = with_version(spec, version)
        before = appliance.request("export", station="left")["spec"]
        pid = appliance.pid(victim)
        applying = threading.Thread(target=_try_apply, args=(appliance, wanted))
        applying.start()
        time.sleep(0.004 * version)  # another moment of the change each time
        os.kill(pid, signal.SIGKILL)
        applying.join()
        if victim == "supervisor":
            appliance.finish()
            wait_free(f"{OWN}.1", f"{OWN}.2")
            appliance = farm.start(plant, runtime=runtime)
            appliance.wait_ready()
        else:
            appliance.wait_for_another(victim, pid)
        now = _settled(appliance)
        assert now in (before, wanted)
    left = appliance.rx("right", "left-state")
    assert left["received"] + left["discarded"].get("version", 0) > 0


def _try_apply(appliance: Appliance, spec: dict) -> None:
    with suppress(ControlError, ValueError):  # the appliance went away meanwhile
        appliance.request("apply", station="left", spec=spec)


def _settled(appliance: Appliance) -> dict:
    """Return what the left station runs, once all that know it agree."""
    found: dict = {}

    def agree() -> bool:
        try:
            exported = appliance.request("export", station="left")["spec"]
            read = appliance.request("od_read", target="left", index=0xD000, subindex=4)["data"]
            (row,) = appliance.request("pd_list", station="left")
        except (ControlError, ValueError):
            return False
        stored = StationStore("devices", "left").configuration.read()
        kept = (
            exported
            if stored is None
            else json.loads(msgspec.json.encode(stored.spec, enc_hook=encode_value))
        )
        version = exported["frames"][0]["pds"][0]["version"]
        found.update(exported)
        return kept == exported and row["version"] == version == int(read[:2], 16)

    wait_until(agree)
    return found
