"""Clients that are slow or stop in the middle of a transfer, beside others at the same slave."""

from __future__ import annotations

import pytest

from eap.codec.coe import SEGMENT_MINIMUM, CoeHeader, SdoHeader
from eap.codec.mailbox import MailboxType
from eap.gateway.request_tracker import MemoryBudget, MemoryShare
from eap.services.gateway import gateway
from eap.services.gateway.gateway import Settings
from tests.unit.eap.services.gateway.test_gateway import (
    ALSO_HERE,
    COE,
    FILE,
    FOE,
    HERE,
    NET_ID,
    VENDOR,
    GatewayHarness,
    play,
)

SENSOR, CALIBRATION, SIZE = 1003, "0180 00", 2048
IDENTITY = "00 30 43 18 10 01 5a 0e 00 00"
DATA = CoeHeader.SIZE + SdoHeader.SIZE
SETTINGS = Settings(NET_ID, answer_s=1.0)
"""A slave that another client holds is reported, also on a busy machine."""


async def read_identity(harness: GatewayHarness, count: int) -> list[str]:
    """Return the answers to reads of another client."""
    return [await harness.one(COE, SENSOR, VENDOR, ALSO_HERE) for _ in range(count)]


async def fetch_segments(harness: GatewayHarness, toggle: int, count: int) -> bytes:
    """Return the data of the next segments of an upload."""
    content = b""
    for _ in range(count):
        answer = bytes.fromhex(
            await harness.one(COE, SENSOR, bytes((0, 0x20, 0x60 | toggle << 4)) + bytes(7))
        )
        command, data = answer[2], answer[3:]
        content += data[: len(data) - (command >> 1 & 7 if len(data) == SEGMENT_MINIMUM else 0)]
        toggle ^= 1
        if command & 1:
            break
    return content


def test_upload_fetched_slowly_leaves_the_slave_to_other_clients() -> None:
    async def scene(harness: GatewayHarness) -> None:
        first = await harness.one(COE, SENSOR, f"0020 40 {CALIBRATION} 00000000")
        assert first.startswith("00 30 41 01 80 00 00 08 00 00")
        assert await read_identity(harness, 7) == [IDENTITY] * 7
        content = bytes.fromhex(first)[DATA:] + await fetch_segments(harness, 0, 1)
        assert await read_identity(harness, 7) == [IDENTITY] * 7
        content += await fetch_segments(harness, 1, SIZE)
        assert await read_identity(harness, 7) == [IDENTITY] * 7
        assert content == bytes(SIZE)

    play(scene, bus="coe", settings=SETTINGS)


def test_download_brought_slowly_leaves_the_slave_to_other_clients() -> None:
    data = bytes(range(256)) * (SIZE // 256)
    first, step = 128 - 16, 128 - 9

    async def scene(harness: GatewayHarness) -> None:
        begin = bytes.fromhex(f"0020 21 {CALIBRATION}") + SIZE.to_bytes(4, "little")
        assert (await harness.one(COE, SENSOR, begin + data[:first])).startswith("00 30 60")
        for number, at in enumerate(range(first, SIZE, step)):
            assert await read_identity(harness, 2) == [IDENTITY] * 2
            toggle, is_last = number % 2, at + step >= SIZE
            command = bytes((0, 0x20, toggle << 4 | is_last))
            answer = await harness.one(COE, SENSOR, command + data[at : at + step])
            assert answer.startswith("00 30 30" if toggle else "00 30 20")
        found = bytes.fromhex(await harness.one(COE, SENSOR, f"0020 40 {CALIBRATION} 00000000"))
        assert found[DATA:] + await fetch_segments(harness, 0, SIZE) == data

    play(scene, bus="coe", settings=SETTINGS)


def test_file_read_slowly_leaves_the_slave_to_other_clients() -> None:
    content = bytes(range(251)) * 20

    async def scene(harness: GatewayHarness) -> None:
        await harness.write_file(FILE, content)
        first = await harness.begin_file("01 00 00000000" + FILE)
        for _ in range(3):
            other = await harness.begin_file("01 00 00000000" + FILE, ALSO_HERE)
            assert other == first
            assert await harness.handle(FOE, 1001, "05 00 00800000", ALSO_HERE) == []
        second = await harness.one(FOE, 1001, "04 00 01000000")
        assert bytes.fromhex(first)[6:] + bytes.fromhex(second)[6:] == content[: 2 * 1012]

    play(scene, settings=SETTINGS)


def test_file_left_in_the_middle_gives_way_to_another_client(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert await harness.begin_file("02 00 00000000" + FILE) == "04 00 00 00 00 00"
        begin = "01 00 00000000" + FILE
        assert (await harness.one(FOE, 1001, begin, ALSO_HERE)).startswith("06")
        (held, waiting) = harness.gateway.transfers()
        assert (held.endpoint, waiting.endpoint) == (HERE, ALSO_HERE)
        monkeypatch.setattr(gateway, "STALL_S", 0.0)
        assert (await harness.begin_file(begin, ALSO_HERE)).startswith("03 00 01 00 00 00")
        late = await harness.one(FOE, 1001, "03 00 01000000 61")
        assert bytes.fromhex(late)[6:] == b"no active transfer\0"

    play(scene, settings=SETTINGS)


def test_file_that_is_fetched_ahead_does_not_give_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gateway, "STALL_S", 0.0)
    content = bytes(range(251)) * 20

    async def scene(harness: GatewayHarness) -> None:
        await harness.write_file(FILE, content)
        await harness.begin_file("01 00 00000000" + FILE)
        await harness.write_file(b"parameters.bin".hex(), content, ALSO_HERE)
        second = await harness.one(FOE, 1001, "04 00 01000000")
        assert bytes.fromhex(second)[6:] == content[1012 : 2 * 1012]

    play(scene, settings=SETTINGS)


@pytest.mark.parametrize(
    ("bus", "kind", "address", "begin"),
    [
        ("coe", COE, SENSOR, "0020 40 0180 00 00000000"),
        ("coe", COE, SENSOR, "0020 21 0180 00 00080000"),
        ("drive", FOE, 1001, "01 00 00000000" + FILE),
    ],
)
def test_client_that_leaves_keeps_nothing(
    bus: str, kind: MailboxType, address: int, begin: str
) -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.one(kind, address, begin)
        assert harness.gateway.transfers()
        assert harness.gateway.memory.held + harness.gateway.file_memory.held > 0
        await harness.gateway.stop()
        assert not harness.gateway.transfers()
        assert harness.gateway.memory.held == harness.gateway.file_memory.held == 0

    play(scene, bus=bus, settings=SETTINGS)


def test_memory_budget_is_shared_by_the_ports_of_a_host() -> None:
    budget = MemoryBudget(100, 60)
    first, second, other = (MemoryShare(budget, host) for host in ("a", "a", "b"))
    assert first.hold(40)
    assert not second.hold(30)
    assert second.hold(20)
    assert not other.hold(50)
    assert other.hold(40)
    assert not first.hold(41)
    assert first.hold(0)
    assert budget.held == 60
    assert not second.hold(61)
    assert second.hold(60)
