"""Files, AMS packets and the dialect to a slave of a station that another appliance runs."""

from __future__ import annotations

import os
import signal
import struct
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from ipaddress import IPv4Address
from pathlib import Path

import pytest
from scapy.layers.inet import ICMP, IP
from scapy.layers.l2 import Ether

from devicebus.errors import FoeError
from devicebus.mailbox.eoe import FrameAssembler, iter_fragments
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.eoe import EoeType, IpSettings
from eap.codec.eoe import encode_message as encode_eoe
from eap.codec.foe import FoeErrorCode
from eap.gateway.client import GatewayClient
from eap.ids import MacAddr
from tests.support.appliance import Appliance, Plants, plants, wait_until
from tests.support.gatewaywire import AOE, COE, EOE, ERR, FOE, VENDOR, Wire, frame, wire

pytestmark = pytest.mark.net

MILL, PRESS = "127.9.89.1", "127.9.89.2"
VIRTUAL, MASTER = 0x9001, 0x9002
BUS = """\
bus: {name}
slaves:
  - name: drive
    kind: drive
    product: 0x5621
    mailbox: {{size: 1024, coe: true, soe: true, foe: true, voe: true, eoe: true, aoe: true}}
    files:
      - {{name: firmware.bin, max_size: 4194304, content: "firmware 1.0 of a simulated drive"}}
      - {{name: locked.bin, password: 7, content: secret}}
  - name: second
    kind: drive
    product: 0x5621
    mailbox: {{size: 512, foe: true}}
    files: [{{name: firmware.bin, max_size: 4194304}}]
"""
PLANT = f"""\
plant: elsewhere
defaults: {{cycle_us: 10000}}
stations:
  - name: mill
    net_id: {MILL}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{MILL}", net_id: {MILL}.2.1}}
      - name: bus0
        kind: bus
        interface: "sim://mill.yaml"
        target: PREOP  # mailboxes alone: no watchdog ends files where the processors are busy
        net_id: {MILL}.3.1
        gateway:
          addresses: {{0x9001: press/bus0/1001, 0x9002: press/bus0, 0x9003: press/bus0/1002}}
  - name: press
    net_id: {PRESS}.1.1
    ports:
      - {{name: eap0, kind: eap, interface: "udp://{PRESS}", net_id: {PRESS}.2.1}}
      - {{name: bus0, kind: bus, interface: "sim://press.yaml", net_id: {PRESS}.3.1, target: PREOP}}
"""
SIZES = {VIRTUAL: MailboxSizes(1024, 1024), 0x9003: MailboxSizes(512, 512)}
MEGABYTE = bytes(range(251)) * 4178
BUSY = 6


@pytest.fixture(scope="module")
def farm() -> Iterator[Plants]:
    with plants() as made:
        for name in ("mill", "press"):
            made.write(BUS.format(name=name), f"{name}.yaml")
        made.write(PLANT)
        yield made


@pytest.fixture(scope="module")
def press(farm: Plants) -> Appliance:
    return started(farm, "press")


@pytest.fixture(scope="module")
def mill(farm: Plants, press: Appliance) -> Appliance:
    appliance = started(farm, "mill")
    wait_until(is_near)
    return appliance


def started(farm: Plants, station: str) -> Appliance:
    appliance = farm.run(farm.folder / "plant.yaml", "--station", station)
    wait_until(lambda: appliance.values(station)["bus0.state"] == 2)
    return appliance


def is_near() -> bool:
    """Say whether the stations have found each other."""
    with wire(MILL) as udp:
        return udp.talk(COE, VIRTUAL, VENDOR)[1][2] == 0x43


@contextmanager
def client(host: str = MILL, *, tcp: bool = False) -> Iterator[GatewayClient]:
    with GatewayClient(host, tcp=tcp) as found:
        found.mailboxes.update(SIZES)
        yield found


@pytest.fixture
def udp(mill: Appliance, press: Appliance) -> Iterator[Wire]:
    with wire(MILL) as found:
        yield found


@pytest.mark.parametrize(
    ("tcp", "content"), [(False, MEGABYTE), (True, MEGABYTE[:100_000])], ids=["udp", "tcp"]
)
def test_a_megabyte_both_ways(mill: Appliance, press: Appliance, tcp: bool, content: bytes) -> None:
    with client(tcp=tcp) as far, client(PRESS) as near:
        far.foe_write(VIRTUAL, "firmware.bin", content)
        assert near.foe_read(1001, "firmware.bin") == content
        assert far.foe_read(VIRTUAL, "firmware.bin") == content
        assert far.foe_read(VIRTUAL, "locked.bin", password=7) == b"secret"


def test_two_clients_at_once(mill: Appliance, press: Appliance) -> None:
    contents = {VIRTUAL: MEGABYTE[:200_001], 0x9003: MEGABYTE[7:90_000]}

    def move(address: int, name: str) -> bytes:
        with client() as own:
            own.foe_write(address, name, contents[address])
            return own.foe_read(address, name)

    with ThreadPoolExecutor(4) as pool:
        moved = [pool.submit(move, address, "firmware.bin") for address in (*contents, *contents)]
        found = [each.result(60) for each in moved]
    assert found == [*contents.values(), *contents.values()]


def test_refusal_of_the_slave_has_a_text(mill: Appliance, press: Appliance) -> None:
    with client() as far:
        with pytest.raises(FoeError) as missing:
            far.foe_read(VIRTUAL, "none.bin")
        with pytest.raises(FoeError) as locked:
            far.foe_read(VIRTUAL, "locked.bin")
    assert (missing.value.code, missing.value.text) == (
        FoeErrorCode.NOT_FOUND, "file not found: ADS error 0x70c (NOT_FOUND)"
    )  # fmt: skip
    assert locked.value.code == FoeErrorCode.ACCESS_DENIED


def begin(udp: Wire) -> tuple[int, bytes]:
    body = struct.pack("<BxI", 2, 0) + b"firmware.bin"
    while (answer := udp.talk(FOE, VIRTUAL, body))[1][0] == BUSY:
        pass
    return answer


def packet(number: int, data: bytes) -> bytes:
    return struct.pack("<BxI", 3, number) + data


def test_a_repeated_packet_and_a_session_that_shows(mill: Appliance, udp: Wire) -> None:
    assert begin(udp) == (FOE, struct.pack("<BxI", 4, 0))
    first = packet(1, bytes(1012))
    confirmed = udp.talk(FOE, VIRTUAL, first)
    assert udp.talk(FOE, VIRTUAL, first, counter=3) == confirmed
    (row,) = mill.request("gateway_status", station="mill")
    (mine,) = [each for each in row["clients"] if each["transfers"]]
    assert mine["transfers"] == [{"address": VIRTUAL, "protocol": "FOE"}]
    assert mine["repeated"] == 1
    wrong = udp.talk(FOE, VIRTUAL, packet(7, b""))[1]
    assert struct.unpack_from("<BxI", wrong) == (5, FoeErrorCode.PACKET_NUMBER)
    assert b"packet 7, expected 2" in wrong


def test_a_station_that_vanishes(mill: Appliance, press: Appliance, udp: Wire) -> None:
    begin(udp)
    services = press.pid("services")
    os.kill(services, signal.SIGSTOP)
    try:
        slowest, number, answer = 0.0, 0, b"\4"
        while answer[0] in {4, BUSY}:
            number += answer[0] == 4
            start = time.monotonic()
            answer = udp.talk(FOE, VIRTUAL, packet(number, bytes(1012)))[1]
            slowest = max(slowest, time.monotonic() - start)
    finally:
        os.kill(services, signal.SIGCONT)
    assert answer[0] == 5
    assert answer[6:].rstrip(b"\0") == b"it did not answer in time"
    assert slowest < 1.3
    with client() as far:
        far.foe_write(VIRTUAL, "firmware.bin", b"again")
        assert far.foe_read(VIRTUAL, "firmware.bin") == b"again"


def test_gateway_answers_ams_packets_for_remote_slaves(udp: Wire) -> None:
    def ask(address: int, group: int, offset: int, length: int) -> bytes:
        header = (
            bytes(6) + struct.pack("<H", 1) + bytes((7, 7, 7, 7, 1, 1)) + struct.pack("<H", 900)
        )
        header += struct.pack("<HHIII", 2, 4, 12, 0, 77)
        kind, body = udp.talk(AOE, address, header + struct.pack("<III", group, offset, length))
        assert kind == AOE
        assert body[:8] == bytes((7, 7, 7, 7, 1, 1)) + struct.pack("<H", 900)
        assert struct.unpack_from("<I", body, 28) == (77,)
        return body[32:]

    vendor = ask(VIRTUAL, 0xF302, 0x1018_0001, 4)
    assert vendor == struct.pack("<III", 0, 4, 0x0E5A)
    assert ask(VIRTUAL, 0xF302, 0x5555_0000, 4)[:4] == struct.pack("<I", 0x70C)
    assert struct.unpack("<IIH", ask(MASTER, 6, 0, 2)) == (0, 2, 2)


def test_host_behind_a_remote_slave_answers_ping(udp: Wire) -> None:
    mac, own = "02:00:00:00:00:02", "02:00:00:00:00:01"
    settings = IpSettings(MacAddr.parse(mac), IPv4Address("10.0.0.2"), IPv4Address("255.255.255.0"))
    request = encode_eoe(EoeType.SET_IP_REQUEST, settings.encode())
    assert udp.talk(EOE, VIRTUAL, request) == (EOE, bytes.fromhex("0300 0000"))
    # Longer than the mailbox of the slave: client and slave have other fragments.
    ping = Ether(src=own, dst=mac) / IP(src="10.0.0.1", dst="10.0.0.2") / ICMP() / bytes(1400)
    for piece in iter_fragments(bytes(ping), 0, 512):
        udp.send(frame(EOE, VIRTUAL, piece))
    assembler, answer = FrameAssembler(), None
    while answer is None or ICMP not in answer:
        received = udp.receive(20.0)
        assert (received[4:6], received[7] & 0x0F) == (struct.pack("<H", VIRTUAL), EOE)
        whole = assembler.receive(received[8:])
        answer = None if whole is None else Ether(whole)
    assert (answer[IP].src, answer[ICMP].type, len(answer[ICMP].payload)) == ("10.0.0.2", 0, 1400)
    kind, body = udp.talk(EOE, VIRTUAL, encode_eoe(EoeType.GET_IP_REQUEST))
    assert (kind, IpSettings.decode(body[4:]).ip) == (EOE, IPv4Address("10.0.0.2"))
    udp.rest()


@pytest.mark.parametrize("message", ["0040 00", "0050 00", "0060", "0070"])
def test_pdos_by_mailbox_are_refused(udp: Wire, message: str) -> None:
    assert udp.talk(COE, VIRTUAL, bytes.fromhex(message)) == (ERR, bytes.fromhex("0100 0400"))


def test_remote_slave_without_ethernet_refuses_it(udp: Wire) -> None:
    assert udp.talk(EOE, 0x9003, bytes.fromhex("0600 0000")) == (ERR, bytes.fromhex("0100 0200"))


def test_the_command_line(mill: Appliance, press: Appliance, tmp_path: Path) -> None:
    source, target = tmp_path / "a", tmp_path / "b"
    source.write_bytes(MEGABYTE[:5000])
    at = ("gw", "--mailbox", "1024", MILL, "foe")
    mill.command(*at, "put", "0x9001", str(source), "firmware.bin")
    mill.command(*at, "get", "0x9001", "firmware.bin", str(target))
    assert target.read_bytes() == source.read_bytes()


@pytest.mark.parametrize(
    ("kind", "body", "answer"),
    [
        (0x30, "0020 40 1810 01 0000", "0030 43 1810 01 5a0e0000"),
        (0x30, "0020 40 5555 00 0000", "0020 80 5555 00 00000206"),
        (0x40, "01 28 2000", "12 28 2000 0910"),
        (0x50, "01 00000000" + b"none.bin\0".hex(), "05 00000000 02800000"),
        (0xF0, "64110000 0100 0102", "64110000 0100 0102"),
    ],
)
def test_gateway_answers_the_dialect_for_remote_slaves(
    udp: Wire, kind: int, body: str, answer: str
) -> None:
    octets = bytes.fromhex(body)
    mailbox = struct.pack("<HHBB", len(octets), VIRTUAL, 0, kind) + octets
    found = udp.ask(struct.pack("<H", len(mailbox) | 0x5000) + mailbox)
    assert found[4:8] == struct.pack("<HBB", VIRTUAL, 0, kind)
    assert found[8:].startswith(bytes.fromhex(answer))


def test_a_file_in_one_packet_of_the_dialect(udp: Wire) -> None:
    with client() as far:
        far.foe_write(VIRTUAL, "firmware.bin", b"content")
    body = b"\1" + bytes(4) + b"firmware.bin\0"
    mailbox = struct.pack("<HHBB", len(body), VIRTUAL, 0, 0x50) + body
    found = udp.ask(struct.pack("<H", len(mailbox) | 0x5000) + mailbox)
    assert found[8:] == b"\3" + bytes(4) + b"content"
