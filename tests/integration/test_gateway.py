"""The mailbox gateway of a running station: whatever is sent to it is answered as it should be."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import pytest

from eap.gateway.client import GatewayClient
from tests.support.appliance import Appliance, wait_until
from tests.support.gatewayplant import (
    COUPLER,
    DRIVE,
    FILE,
    LAST,
    MUTE,
    SENSOR,
    gateway_plant,
    state_of,
)
from tests.support.gatewaywire import AOE, COE, EOE, ERR, FOE, SOE, VENDOR, VOE, Wire, frame, wire
from tests.support.machine import slowness
from tests.support.vectors import load

pytestmark = pytest.mark.net

HOST = "127.9.86.1"
SILENT = None
IDENTITY = bytes.fromhex("0030 43 1810 01 5a0e0000")
NO_OBJECT, TIMED_OUT, LOCAL, UNSUPPORTED = "00000206", "00000405", "21000008", "00000106"
GATEWAY = {
    "igh_req": ("0400", COE, "0020 80 1810 01 00000206"),
    "igh_resp": ("0400", ERR, "0100 0500"),
    "ldr_req1": ("e903", COE, "0020 80 80f9 02 00000206"),
    "ldr_resp1": ("e903", ERR, "0100 0400"),
    "ldr_req2": ("e903", COE, "0020 80 80f9 01 00000206"),
    "ldr_resp2": ("e903", ERR, "0100 0400"),
    "ldr_req3": ("e903", COE, "0020 80 01fe 00 00000206"),
    "ldr_resp3": SILENT,
}
"""Address, type and data of each answer; a message that is no request has a mailbox error."""
DIALECT = {
    "coe_read_master_0x1018_01": ("0000", 0x30, "0030 43 1810 01 00000000"),
    "coe_read_slave_0x03e9_0x6040_00": ("e903", 0x30, "0030 4b 4060 00 00000000"),
    "coe_write_slave_0x03e9_0x6040_00_06_00": ("e903", 0x30, "0030 60 4060 00 00000000"),
    "soe_read_idn_32_drive0_element_5_value": ("e903", 0x40, "02 05 2000 02000000"),
    "soe_read_idn_32_drive1_element_0_name": ("e903", 0x40, "12 08 2000 0910"),
    "soe_write_idn_32_1000": ("e903", 0x40, "04 05 2000"),
    "foe_read_firmware_bin": ("e903", 0x50, "03 00000000" + FILE.hex()),
    "voe_vendor_0x1164_type_1_data_01_02": ("e903", 0xF0, "64110000 0100 0102"),
}


@pytest.fixture(scope="module")
def running() -> Iterator[Appliance]:
    with gateway_plant(HOST) as appliance:
        yield appliance


@pytest.fixture
def plant(running: Appliance) -> Appliance:
    """The plant with its bus in OP, which a busy machine may have cost it for a moment."""
    wait_until(lambda: state_of(running) == 8)
    return running


@pytest.fixture(params=["udp", "tcp"])
def gateway(plant: Appliance, request: pytest.FixtureRequest) -> Iterator[Wire]:
    with wire(HOST, tcp=request.param == "tcp") as found:
        yield found


def abort(index: int, subindex: int, code: str) -> tuple[int, bytes]:
    return COE, bytes.fromhex("002080") + struct.pack("<HB", index, subindex) + bytes.fromhex(code)


def test_every_request_that_real_tools_sent(gateway: Wire) -> None:
    vectors = [each for each in load("type5_gateway") if each.layer == "frame"]
    assert {each.name.partition("/")[2] for each in vectors} == set(GATEWAY)
    for vector in vectors:
        expected = GATEWAY[vector.name.partition("/")[2]]
        if expected is SILENT:  # a frame that was cut off
            assert gateway.is_silent(vector.octets)
            continue
        address, kind, body = expected
        answer = gateway.ask(vector.octets)
        assert answer[7] & 0x0F == kind
        assert answer[2:6] == struct.pack("<H", len(answer) - 8) + bytes.fromhex(address)
        assert answer[8:] == bytes.fromhex(body), vector.name
        assert 1 <= answer[7] >> 4 <= 7


def test_every_request_of_the_high_nibble_dialect(gateway: Wire) -> None:
    vectors = load("high_nibble_dialect")
    assert {each.name.partition("/")[2] for each in vectors} == set(DIALECT)
    for vector in vectors:
        address, kind, body = DIALECT[vector.name.partition("/")[2]]
        answer = gateway.ask(vector.octets)
        assert answer[4:8] == bytes.fromhex(address) + bytes((0, kind))
        assert answer[8:] == bytes.fromhex(body), vector.name
    # As it was, for whoever comes next: a cycle may be over by then or not.
    gateway.talk(SOE, DRIVE, bytes.fromhex("03 40 2000 02000000"))
    gateway.talk(COE, DRIVE, bytes.fromhex("0020 2b 4060 00 00000000"))


def test_surplus_octets_and_any_upload_command(gateway: Wire) -> None:
    assert gateway.talk(COE, DRIVE, VENDOR + bytes(8)) == (COE, IDENTITY)
    assert gateway.talk(COE, DRIVE, bytes.fromhex("0020 4f 1810 01 00000000")) == (COE, IDENTITY)


def test_octets_behind_the_frame_of_a_datagram(plant: Appliance) -> None:
    with wire(HOST) as udp:
        assert udp.ask(frame(COE, DRIVE, VENDOR) + bytes(40))[8:] == IDENTITY


def test_bit_15_means_the_slave(gateway: Wire) -> None:
    assert gateway.talk(COE, DRIVE | 0x8000, VENDOR) == (COE, IDENTITY)


def test_one_request_for_all_slaves(plant: Appliance) -> None:
    with wire(HOST) as udp:
        udp.send(frame(COE, 0xFFFF, VENDOR))
        answers = {int.from_bytes(each[4:6], "little"): each[8:] for each in udp.rest()}
        udp.send(frame(COE, 0xFFFF, VENDOR))
        late = [each for _ in range(4) for each in udp.rest()]
    answers |= {int.from_bytes(each[4:6], "little"): each[8:] for each in late}
    assert answers == {
        DRIVE: IDENTITY,
        SENSOR: IDENTITY,
        LAST: IDENTITY,
        COUPLER: abort(0x1018, 1, LOCAL)[1],
        MUTE: abort(0x1018, 1, TIMED_OUT)[1],
    }


def test_writing_to_all_needs_a_rule(gateway: Wire) -> None:
    gateway.send(frame(COE, 0xFFFF, bytes.fromhex("0020 2f 4060 00 00000000")))
    denied = abort(0x6040, 0, UNSUPPORTED)[1]
    assert [gateway.receive()[8:] for _ in range(5)] == [denied] * 5


def test_missing_host_and_silent_host_differ(gateway: Wire) -> None:
    assert gateway.talk(COE, 1777, VENDOR) == abort(0x1018, 1, NO_OBJECT)
    assert gateway.talk(COE, COUPLER, VENDOR) == abort(0x1018, 1, LOCAL)
    for _ in range(2):
        start = time.monotonic()
        assert gateway.talk(COE, MUTE, VENDOR) == abort(0x1018, 1, TIMED_OUT)
        assert 0.5 < time.monotonic() - start < 1 * slowness()
    assert gateway.talk(COE, LAST, VENDOR) == (COE, IDENTITY)


def test_protocols_that_are_not_offered_and_messages_that_are_too_long(gateway: Wire) -> None:
    no_protocol = ERR, bytes.fromhex("0100 0200")
    words = b"it does not speak this protocol\0"
    requests = {
        SOE: ("01 40 2000", (SOE, bytes.fromhex("12 40 2000 0110"))),
        FOE: ("01 00 00000000 66", (FOE, bytes.fromhex("05 00 00800000") + words)),
        VOE: ("64110000 0100", no_protocol),
        EOE: ("06000000", no_protocol),
    }
    for kind, (body, answer) in requests.items():
        assert gateway.talk(kind, SENSOR, bytes.fromhex(body)) == answer
        assert gateway.talk(kind, 0, bytes.fromhex(body)) == answer
    assert gateway.talk(6, DRIVE, bytes(8)) == (ERR, bytes.fromhex("0100 0200"))
    long = bytes.fromhex("0020 21 0180 00 00020000") + bytes(512)
    assert gateway.talk(COE, SENSOR, long) == abort(0x8001, 0, "05000106")
    assert gateway.talk(VOE, DRIVE, bytes(1100)) == (ERR, bytes.fromhex("0100 0800"))


def test_pdos_by_mailbox_are_answered_or_refused(plant: Appliance) -> None:
    with wire(HOST) as udp:
        kind, body = udp.talk(COE, SENSOR, bytes.fromhex("0060"))
        assert (kind, body) == (COE, bytes.fromhex("0040 f503"))  # 1013
        kind, control_word = udp.talk(COE, DRIVE, bytes.fromhex("0070"))
        assert (kind, control_word[:2]) == (COE, bytes.fromhex("0050"))
        # An RxPDO has no confirmation.
        udp.send(frame(COE, DRIVE, control_word))
        refused = ERR, bytes.fromhex("0100 0400")
        # No such PDO, TxPDO and emergency to a slave, and a service that does not exist.
        for message in ("3360", "3370", "0040 f503", "0010 0000000000000000", "0090 00"):
            assert udp.talk(COE, SENSOR, bytes.fromhex(message)) == refused
        # The master has no PDOs.
        for message in ("0060", "0070", "0050 00"):
            assert udp.talk(COE, 0, bytes.fromhex(message)) == refused


def test_pdo_that_a_slave_sends_by_mailbox_is_named_in_the_log(plant: Appliance) -> None:
    plant.command("sim", "fault", "mill/bus0", "tx-pdo", "slave=sensor", "object=0x1A00")
    line = "mill/bus0/sensor: slave 1003 sends by mailbox: CoE TxPDO 0 (2 bytes), not used"
    wait_until(lambda: line in plant.log())


def test_a_request_that_waits_is_answered_once_and_later_it_is_a_new_one(plant: Appliance) -> None:
    asked = frame(COE, MUTE, VENDOR)
    with wire(HOST) as udp:
        for _ in range(3):
            udp.send(asked)
        assert udp.receive()[8:] == abort(0x1018, 1, TIMED_OUT)[1]
        assert udp.rest() == []
        assert udp.ask(asked)[8:] == abort(0x1018, 1, TIMED_OUT)[1]
        polled = frame(COE, DRIVE, VENDOR)
        assert {udp.ask(polled)[8:] for _ in range(20)} == {IDENTITY}


def test_frames_in_halves_and_many_at_once(plant: Appliance) -> None:
    asked = frame(COE, DRIVE, VENDOR)
    with wire(HOST, tcp=True) as tcp:
        for cut in range(1, len(asked)):
            tcp.send(asked[:cut])
            time.sleep(0.002)  # so that the halves come apart
            tcp.send(asked[cut:])
            assert tcp.receive()[8:] == IDENTITY
        crowd = [frame(COE, 0, VENDOR, counter) for counter in range(8)] * 20
        tcp.send(b"".join(crowd))
        found = [tcp.receive()[8:13] for _ in range(8)]
        assert {each[:3] for each in found} == {bytes.fromhex("0030 43")}


@pytest.mark.parametrize("octets", ["1010" + "00" * 16, "0250" + "00" * 2, "0050"])
def test_a_stream_of_something_else_is_closed(plant: Appliance, octets: str) -> None:
    with wire(HOST, tcp=True) as tcp:
        tcp.send(bytes.fromhex(octets))
        with pytest.raises(ConnectionError):
            tcp.receive()


def test_reader_that_takes_nothing_delays_no_other(plant: Appliance) -> None:
    names = bytes.fromhex("0080 01 00 0000 0100")
    requests = b"".join(frame(COE, 0, names, counter) for counter in range(8)) * 50
    with wire(HOST, tcp=True) as lazy, wire(HOST) as other:
        lazy.sock.setblocking(False)
        end = time.monotonic() + 1.5
        slowest = 0.0
        while time.monotonic() < end:
            with suppress(OSError):
                lazy.sock.send(requests)
            start = time.monotonic()
            assert other.talk(COE, DRIVE, VENDOR) == (COE, IDENTITY)
            slowest = max(slowest, time.monotonic() - start)
        assert slowest < 0.3 * slowness()


def test_two_clients_move_different_files_at_once(plant: Appliance) -> None:
    contents = {"one.bin": os.urandom(60_000), "two.bin": os.urandom(61_000)}

    def move(name: str, *, tcp: bool) -> bytes:
        with GatewayClient(HOST, tcp=tcp) as client:
            client.foe_write(DRIVE, name, contents[name])
            return client.foe_read(DRIVE, name)

    names = {"one.bin": "firmware.bin", "two.bin": "parameters.bin"}
    contents = {names[name]: content for name, content in contents.items()}
    with ThreadPoolExecutor() as pool:
        works = {
            name: pool.submit(move, name, tcp=number == 1) for number, name in enumerate(contents)
        }
        for name, work in works.items():
            assert work.result(60) == contents[name]
    with GatewayClient(HOST) as client:
        client.foe_write(DRIVE, "firmware.bin", FILE)


def test_a_transfer_in_segments_beside_another_clients_requests(plant: Appliance) -> None:
    content = os.urandom(2048)
    with GatewayClient(HOST) as one, GatewayClient(HOST, tcp=True) as two:
        one.sdo_write(SENSOR, 0x8001, 0, content)
        with ThreadPoolExecutor() as pool:
            works = [pool.submit(client.sdo_read, SENSOR, 0x8001) for client in (one, two)]
            assert [work.result(20) for work in works] == [content, content]


def test_slow_upload_leaves_the_slave_to_other_clients(plant: Appliance) -> None:
    content = os.urandom(2048)
    with wire(HOST) as slow, GatewayClient(HOST) as other:
        other.sdo_write(SENSOR, 0x8001, 0, content)
        begun = slow.talk(COE, SENSOR, bytes.fromhex("0020 40 0180 00 00000000"))[1]
        found, toggle, last = begun[10:], 0, 0
        while not last:
            assert other.sdo_read(SENSOR, 0x1018, 1) == IDENTITY[6:]
            step = bytes((0, 0x20, 0x60 | toggle << 4)) + bytes(7)
            segment = slow.talk(COE, SENSOR, step)[1]
            found, toggle, last = found + segment[3:], toggle ^ 1, segment[2] & 1
        assert found[:2048] == content


def test_slow_readers_and_writers_leave_the_slave_to_other_clients(plant: Appliance) -> None:
    with wire(HOST) as slow, GatewayClient(HOST) as other:
        begin = struct.pack("<BBBHBI", 0, 0x20, 0x21, 0x8001, 0, 2048) + bytes(100)
        assert slow.talk(COE, SENSOR, begin)[1][2] == 0x60
        assert other.sdo_read(SENSOR, 0x8001) != b""
        slow.send(frame(COE, SENSOR, bytes.fromhex("0020 80 0180 00 00000008")))
        content = os.urandom(50_000)
        other.foe_write(DRIVE, "parameters.bin", content)
        first = slow.talk(FOE, DRIVE, struct.pack("<BxI", 1, 0) + b"parameters.bin")[1]
        assert other.foe_read(DRIVE, "parameters.bin") == content
        second = slow.talk(FOE, DRIVE, struct.pack("<BxI", 4, 1))[1]
        assert first[6:] + second[6:] == content[: 2 * 1012]
        slow.send(frame(FOE, DRIVE, struct.pack("<BxI", 5, 0x8000)))


def test_a_step_that_is_repeated_gets_the_same_reply(plant: Appliance) -> None:
    with wire(HOST) as udp:
        first = udp.talk(COE, SENSOR, bytes.fromhex("0020 40 0180 00 00000000"))[1]
        assert first[2] == 0x41
        step = bytes.fromhex("0020 60 00000000 000000")
        answers = {udp.talk(COE, SENSOR, step) for _ in range(3)}
        assert len(answers) == 1
        following = udp.talk(COE, SENSOR, bytes.fromhex("0020 70 00000000 000000"))
        assert following[1][2] & 0xF0 == 0x10
        udp.send(frame(COE, SENSOR, bytes.fromhex("0020 80 0180 00 00000008")))


def test_aoe_message_that_is_none_gets_an_error(gateway: Wire) -> None:
    assert gateway.talk(AOE, DRIVE, b"short")[0] in {ERR, AOE}
