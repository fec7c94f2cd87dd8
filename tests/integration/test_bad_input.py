"""Bad input to a running station: every frame is counted, and nothing else is disturbed."""

from __future__ import annotations

import random
import socket
from collections import Counter
from collections.abc import Iterator

import pytest

from eap.codec.ethercat import EAP_PORT, ETHERTYPE, EtherCatHeader
from eap.codec.mailbox import MailboxHeader, MailboxType
from eap.codec.mailbox import encode_frame as encode_mailbox_frame
from eap.codec.pd import FIRST_PD, PdFrameHeader, PdHeader, encode_frame
from eap.ids import NetId
from tests.support.appliance import Appliance, Plants, troubles, wait_until
from tests.support.namespaces import cable

pytestmark = pytest.mark.net

ADDRESS = "127.9.5.1"
LENGTH = 6
PLANT = """\
plant: target
defaults: {cycle_us: 10000}
stations:
  - name: target
    net_id: 127.9.5.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "INTERFACE", net_id: 127.9.5.1.2.1, TCP}
    variables: {ticks: UDINT, flags: UINT}
    sources:
      ticks: {kind: counter}
    frames:
      - {name: out, port: eap0, to: DESTINATION}
    publish:
      - {name: state, frame: out, id: 1, version: 7, variables: [ticks, flags]}
  - name: reader
    net_id: 127.9.5.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "SECOND", net_id: 127.9.5.2.2.1}
    subscribe:
      - {name: sender, port: eap0, from: target/state, timeout_ms: 500}
"""
UDP_PLANT = (
    PLANT.replace("INTERFACE", f"udp://{ADDRESS}")
    .replace("SECOND", "udp://127.9.5.2")
    .replace("DESTINATION", "reader/eap0")
    .replace("TCP", "tcp: true")
)
ETHERNET_PLANT = (
    PLANT.replace("INTERFACE", "ethernet://line0")
    .replace("SECOND", "ethernet://line0")
    .replace("DESTINATION", "multicast")
    .replace(", TCP", "")
)
SENDER, STRANGER = NetId.parse("127.9.5.1.2.1"), NetId.parse("9.9.9.9.9.9")


def pd_frame(publisher: NetId, pd: PdHeader, data: bytes) -> bytes:
    return encode_frame(PdFrameHeader(publisher, 1, 1), [(pd, data)])


def hostile_frames() -> dict[str, list[bytes]]:
    """Frames by the reason under which the reader has to count each of them."""
    good = pd_frame(SENDER, PdHeader(1, 7, LENGTH), bytes(LENGTH))
    too_many = bytearray(good)
    too_many[8:10] = b"\xff\xff"
    too_long = bytearray(good)
    too_long[FIRST_PD + 4 : FIRST_PD + 6] = (LENGTH + 1).to_bytes(2, "little")
    announced = bytearray(good)
    announced[0] += 1
    return {
        "truncated": [good[:size] for size in range(len(good))]
        + [bytes(too_long), bytes(announced)],
        "count_too_large": [bytes(too_many)],
        "wrong_type": [EtherCatHeader(21, 0, kind).encode() + bytes(21) for kind in (0, 1, 7, 15)],
        "mailbox": [
            EtherCatHeader(6, 0, 5).encode() + bytes(6),
            encode_mailbox_frame(MailboxHeader(0, type=MailboxType.COE), bytes(10)),
        ],
        "wrong_publisher": [pd_frame(STRANGER, PdHeader(1, 7, LENGTH), bytes(LENGTH))],
        "unknown_id": [pd_frame(SENDER, PdHeader(2, 7, LENGTH), bytes(LENGTH))],
        "version": [pd_frame(SENDER, PdHeader(1, 8, LENGTH), bytes(LENGTH))],
        "length": [pd_frame(SENDER, PdHeader(1, 7, LENGTH + 1), bytes(LENGTH + 1))],
    }


class Target:
    """The running plant, and what it counted since the test began."""

    def __init__(self, appliance: Appliance) -> None:
        self.appliance = appliance
        wait_until(lambda: appliance.rx("reader", "sender")["received"] > 20)
        self.first = appliance.status()
        self.before = {s["name"]: Counter(s["discarded"]) for s in self.first["stations"]}
        self._before_of_pd = Counter(appliance.rx("reader", "sender")["discarded"])

    def counted(self, station: str) -> Counter[str]:
        now = Counter(self.appliance.station(station)["discarded"])
        return now - self.before[station]

    def counted_of_pd(self) -> Counter[str]:
        now = Counter(self.appliance.rx("reader", "sender")["discarded"])
        return now - self._before_of_pd

    def wait_for(self, station: str, total: int) -> None:
        wait_until(lambda: self.counted(station).total() >= total)

    def assert_undisturbed(self) -> None:
        rx = self.appliance.rx("reader", "sender")
        wait_until(lambda: self.appliance.rx("reader", "sender")["received"] > rx["received"] + 20)
        rx = self.appliance.rx("reader", "sender")
        assert (*troubles(rx), rx["timeouts"], rx["state"]) == (0, 0, 0, 0, "running")
        assert self.appliance.tx("target", "state")["skipped"] == 0
        now = self.appliance.status()["processes"]
        for name, process in self.first["processes"].items():
            assert now[name]["pid"] == process["pid"]


@pytest.fixture(scope="module")
def appliance(module_farm: Plants) -> Appliance:
    return module_farm.run(module_farm.write(UDP_PLANT))


@pytest.fixture
def target(appliance: Appliance) -> Target:
    return Target(appliance)


@pytest.fixture
def sock() -> Iterator[socket.socket]:
    """Yield a socket at the publisher's own address: what it sends is judged by its content."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((ADDRESS, 0))
        yield sock


def test_each_kind_is_counted_under_its_reason(target: Target, sock: socket.socket) -> None:
    expected: Counter[str] = Counter()
    for reason, frames in hostile_frames().items():
        for frame in frames:
            sock.sendto(frame, ("127.9.5.2", EAP_PORT))
            expected[reason] += 1
    wait_until(lambda: target.counted("reader") == expected)
    assert target.counted_of_pd() == {"wrong_publisher": 1, "version": 1, "length": 1}
    target.assert_undisturbed()


def test_values_from_another_address_are_dropped_and_their_source_named(target: Target) -> None:
    values = (666).to_bytes(4, "little") + (31337).to_bytes(2, "little")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.9.5.99", 0))
        for _ in range(5):
            other.sendto(pd_frame(SENDER, PdHeader(1, 7, LENGTH), values), ("127.9.5.2", EAP_PORT))
        wait_until(lambda: target.counted("reader") == {"wrong_source": 5})
    assert target.counted_of_pd() == {"wrong_source": 5}
    row = target.appliance.rx("reader", "sender")
    assert row["wrong_source"]["address"] == "127.9.5.99"
    assert row["source"] == ADDRESS
    target.assert_undisturbed()


def test_ten_thousand_random_datagrams_are_all_counted(target: Target, sock: socket.socket) -> None:
    dice = random.Random(2)
    pool = [frame for frames in hostile_frames().values() for frame in frames if len(frame) > 10]
    for sent in range(100, 10_001, 100):
        for _ in range(100):
            sock.sendto(noise(dice, pool), (ADDRESS, EAP_PORT))
        # The buffers of an ordinary user's sockets hold a few hundred: wait for them to empty.
        target.wait_for("target", sent)
    assert target.counted("target").total() == 10_000
    assert len(target.counted("target")) >= 5  # of the reasons, none of them rare
    target.assert_undisturbed()


def noise(dice: random.Random, pool: list[bytes]) -> bytes:
    """Octets that are nothing, or begin like a frame, or are a frame with one octet changed.

    None carries a PD that counts more or less than once.
    """
    kind = dice.randrange(3)
    if kind == 0:
        return dice.randbytes(dice.choice((0, 1, 2, 13, 14, 60, 600, 1472)))
    if kind == 1:
        return EtherCatHeader(dice.randrange(2048), 0, 4).encode() + dice.randbytes(
            dice.randrange(100)
        )
    frame = bytearray(dice.choice(pool))
    frame[dice.randrange(2, 8)] = dice.randrange(256)
    return bytes(frame)


def test_oversized_datagrams_and_garbage_over_tcp(target: Target, sock: socket.socket) -> None:
    good = hostile_frames()["unknown_id"][0]
    sock.sendto(bytes(40_000), (ADDRESS, EAP_PORT))
    wait_until(lambda: target.counted("target") == {"wrong_type": 1})
    sock.sendto(good + bytes(40_000), (ADDRESS, EAP_PORT))  # octets behind the frame do no harm
    wait_until(lambda: target.counted("target") == {"wrong_type": 1, "unknown_id": 1})
    with socket.create_connection((ADDRESS, EAP_PORT)) as first:
        first.sendall(bytes.fromhex("1570") + bytes(21))
        assert read_to_end(first) == b""
    with socket.create_connection((ADDRESS, EAP_PORT)) as second:
        second.sendall(good + good + b"\xff" * 100)
        assert read_to_end(second) == b""
    wait_until(lambda: target.counted("target").get("tcp_type") == 1)
    counted = target.counted("target")
    assert counted == {"wrong_type": 2, "unknown_id": 3, "tcp_type": 1}
    target.assert_undisturbed()


def read_to_end(connection: socket.socket) -> bytes:
    connection.settimeout(5)
    try:
        return connection.recv(16)
    except ConnectionResetError:
        return b""


@pytest.mark.root
def test_bad_frames_over_ethernet(farm: Plants) -> None:
    with cable() as (here, there):
        target = Target(farm.run(farm.write(ETHERNET_PLANT), prefix=here.prefix))
        multicast = bytes.fromhex("010105040000")
        header = multicast + bytes.fromhex("020000000001") + ETHERTYPE.to_bytes(2, "big")
        foreign = header[:12] + b"\x08\x00"
        expected: Counter[str] = Counter()
        with there.socket(socket.AF_PACKET, socket.SOCK_RAW) as wire:
            wire.bind(("line0", 0))
            for reason, frames in hostile_frames().items():
                for frame in frames:
                    if len(frame) < 2:
                        continue  # too short for an interface to send
                    wire.send(header + frame)
                    wire.send(foreign + frame)
                    expected[reason] += 1
            wire.send(header + bytes.fromhex("1570") + bytes(44))
            expected["wrong_type"] += 1
            wait_until(lambda: target.counted("reader") == expected)
        target.assert_undisturbed()
