"""The sequence of a public ETG.1510 client (pyetg1510): a list, descriptions, whole objects.

A socket for each request, value info 0x7F, eight surplus octets behind an upload, answers in one
datagram.  What stands behind the rights in a description it takes for a name, so nothing else may.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from itertools import count

import pytest

from eap.gateway.client import GatewayClient
from tests.support.appliance import Appliance, wait_until
from tests.support.gatewayplant import (
    COUPLER,
    DRIVE,
    LAST,
    MUTE,
    SENSOR,
    gateway_plant,
    state_of,
)
from tests.support.gatewaywire import COE, Wire, frame, wire

pytestmark = pytest.mark.net

HOST = "127.9.86.5"
STATIONS = (DRIVE, COUPLER, SENSOR, MUTE, LAST)
SLAVES = [*range(0x8000, 0x8005), *range(0x9000, 0x9005), *range(0xA000, 0xA005)]
FIXED = [0x1000, 0x1008, 0x1009, 0x100A, 0x1018]
CONFIGURED = tuple(range(9)) + tuple(range(33, 38))
DIAGNOSIS = tuple(range(18))
COUNTER = count()


@pytest.fixture(scope="module")
def running() -> Iterator[Appliance]:
    with gateway_plant(HOST) as appliance:
        yield appliance


@pytest.fixture
def client(running: Appliance) -> Iterator[Wire]:
    """A client that gets one answer to each request; at first the bus is in OP.

    A busy machine may have cost it that for a moment.
    """
    wait_until(lambda: state_of(running) == 8)
    with wire(HOST) as client:
        yield client
        assert not client.rest()


def ask(client: Wire, body: bytes) -> bytes:
    """Return what answers a message to the master."""
    answer = client.ask(frame(COE, 0, body, next(COUNTER) % 7 + 1))
    assert len(answer) == 2 + (int.from_bytes(answer[:2], "little") & 0x7FF) <= 1472
    return answer[8:]


def info(client: Wire, opcode: int, body: bytes) -> bytes:
    answer = ask(client, struct.pack("<HBBH", 8 << 12, opcode, 0, 0) + body)
    assert answer[2] == opcode + 1, answer.hex()
    assert answer[4:6] == bytes(2)
    return answer[6:]


def upload(client: Wire, index: int, *, complete: bool) -> bytes:
    command = 0x50 if complete else 0x40
    request = struct.pack("<HBHBI", 2 << 12, command, index, 0, 0)
    answer = ask(client, request + bytes(8))
    assert answer[3:6] == request[3:6]
    if answer[2] & 2:
        return answer[6 : 10 - (answer[2] >> 2 & 3)]
    (size,) = struct.unpack_from("<I", answer, 6)
    assert len(answer) == 10 + size
    return answer[10:]


def object_list(client: Wire) -> list[int]:
    kind, *indexes = [each[0] for each in struct.iter_unpack("<H", info(client, 1, b"\1\0"))]
    assert kind == 1
    return indexes


def test_objects_and_descriptions(client: Wire) -> None:
    wanted = {*FIXED, *SLAVES, 0xF000, 0xF002, 0xF020, 0xF040, 0xF120, 0xF200}
    # The master is told of its slaves a moment after the bus is in OP.
    wait_until(lambda: wanted <= set(object_list(client)))
    for index in (0x1018, 0x8000, 0x9004, 0xA000, 0xF120):
        described = info(client, 3, struct.pack("<H", index))
        last = described[4]
        assert struct.unpack_from("<H", described) == (index,)
        subindexes = {0x8000: CONFIGURED, 0xA000: DIAGNOSIS}.get(index, (0, last))
        assert last == max(subindexes)
        for subindex in subindexes:
            entry = info(client, 5, struct.pack("<HBB", index, subindex, 0x7F))
            assert entry[:3] == struct.pack("<HB", index, subindex)
            assert entry[3] == 7, "only what has a fixed place"
            assert entry[10:].decode("ascii").isprintable()


def test_gaps_are_errors_of_sdo_information(client: Wire) -> None:
    for subindex in (9, 32, 38):
        request = struct.pack("<HBBHHBB", 8 << 12, 5, 0, 0, 0x8000, subindex, 0x7F)
        answer = ask(client, request)
        assert answer[2] == 7
        assert len(answer) == 10


def test_gateway_client_reads_whole_objects_of_the_master(client: Wire) -> None:
    with GatewayClient(HOST) as tool:
        known = {each.station: each for each in tool.slaves()}
    assert tuple(known) == STATIONS
    for number, station in enumerate(STATIONS):
        slave = known[station]
        told = struct.unpack("<BxH16s32s5I2H3B", upload(client, 0x8000 + number, complete=True))
        assert told[:2] == (37, station)
        assert told[3].rstrip(b"\0").decode() == slave.name
        assert told[5:9] == (slave.vendor, slave.product, slave.revision, slave.serial)
        assert told[9:11] == (slave.to_slave, slave.to_master)
        found = struct.unpack("<BxH4IH", upload(client, 0x9000 + number, complete=True))
        assert found[:6] == (32, station, slave.vendor, slave.product, slave.revision, slave.serial)
        how = struct.unpack("<BxHHHBB4H4I3I?", upload(client, 0xA000 + number, complete=True))
        assert how[:2] == (17, 8)


def test_lists_figures_and_the_command(client: Wire) -> None:
    assert struct.unpack("<Bx5H", upload(client, 0xF020, complete=True)) == (5, *STATIONS)
    figures = struct.unpack("<Bx4IH", upload(client, 0xF120, complete=True))
    assert (figures[0], figures[5] & 0x0F) == (16, 8)
    assert upload(client, 0xF200, complete=True)[0] == 16
    assert upload(client, 0x1000, complete=False)
    assert upload(client, 0x1008, complete=False) == b"EtherCAT master mill/bus0"
    assert struct.unpack("<Bx4I", upload(client, 0x1018, complete=True))[0] == 4
    refused = ask(client, struct.pack("<HBHBI", 2 << 12, 0x50, 0xF002, 0, 0) + bytes(8))
    assert (refused[2], refused[6:10].hex()) == (0x80, "43000406")
