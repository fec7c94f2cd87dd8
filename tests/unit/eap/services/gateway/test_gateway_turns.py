"""The gateway where requests meet: repeated, too many, too fast, and clients that leave."""

from __future__ import annotations

import asyncio

import pytest

from eap.codec.mailbox import (
    MailboxHeader,
    encode_frame,
    encode_plain_frame,
)
from eap.gateway.request_tracker import ClientLimits
from eap.ids import Endpoint
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
    decoded,
    play,
)


def test_repeated_request_on_a_connection_is_answered_twice() -> None:
    request = encode_frame(
        MailboxHeader(0, 1001, type=COE, counter=3), bytes.fromhex("0020 40 1810 01 00000000")
    )

    async def answers(harness: GatewayHarness, endpoint: Endpoint) -> int:
        return sum(
            map(len, await asyncio.gather(*(harness.ask_frame(request, endpoint) for _ in "123")))
        )

    async def scene(harness: GatewayHarness) -> None:
        assert await answers(harness, HERE) == 1
        assert await answers(harness, Endpoint("tcp:eap0", "127.0.0.1:1")) == 3

    play(scene)


def test_a_repeated_step_of_a_transfer_is_answered_and_counted() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.one(FOE, 1001, "02 00 00000000" + FILE)
        packet = "03 00 01000000" + "61" * 1012
        first = await harness.one(FOE, 1001, packet)
        assert await harness.one(FOE, 1001, packet) == first
        counts = harness.gateway.tracker.counts_of(HERE)
        assert (counts.requests, counts.repeated) == (3, 1)
        await harness.one(FOE, 1001, "03 00 02000000")

    play(scene)


def test_client_over_its_rate_gets_an_error() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.one(COE, 1001, VENDOR)
        assert await harness.one(COE, 1001, VENDOR) == "00 20 80 18 10 01 21 00 00 08"
        assert harness.gateway.statistics.report()[0]["errors"] == {"too_fast": 1}

    play(scene, settings=Settings(NET_ID, limits=ClientLimits(rate=1)))


def test_two_clients_transfers_do_not_mix() -> None:
    first, second = b"a" * 3000, b"b" * 2500

    async def write(harness: GatewayHarness, name: bytes, data: bytes, endpoint: Endpoint) -> None:
        body = bytes.fromhex("02 00 00000000") + name
        while (await harness.one(FOE, 1001, body, endpoint))[:2] == "06":
            pass
        room = 1024 - 12
        for number, at in enumerate(range(0, len(data) + 1, room), 1):
            packet = bytes((3, 0)) + number.to_bytes(4, "little") + data[at : at + room]
            answer = await harness.one(FOE, 1001, packet, endpoint)
            assert answer == (bytes((4, 0)) + number.to_bytes(4, "little")).hex(" ")

    async def read(harness: GatewayHarness, name: bytes) -> bytes:
        content = b""
        body = bytes.fromhex("01 00 00000000") + name
        while True:
            ((_, packet),) = await harness.handle(FOE, 1001, body)
            content += packet[6:]
            body = bytes((4, 0)) + packet[2:6]
            if len(packet) < 1024 - 6:
                await harness.handle(FOE, 1001, body)
                return content

    async def scene(harness: GatewayHarness) -> None:
        await asyncio.gather(
            write(harness, b"firmware.bin", first, HERE),
            write(harness, b"parameters.bin", second, ALSO_HERE),
        )
        assert await read(harness, b"firmware.bin") == first
        assert await read(harness, b"parameters.bin") == second

    play(scene, settings=Settings(NET_ID, answer_s=0.2))


def test_client_that_waits_too_long_gets_busy() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.one(FOE, 1001, "02 00 00000000" + FILE)
        answer = await harness.one(FOE, 1001, "01 00 00000000" + FILE, ALSO_HERE)
        assert answer.startswith("06 00 00 00 64 00")
        await harness.handle(FOE, 1001, "05 00 00800000")
        assert (await harness.begin_file("01 00 00000000" + FILE, ALSO_HERE)).startswith("03")

    play(scene, settings=Settings(NET_ID, answer_s=0.2))


def test_a_step_that_comes_twice_gets_the_same_answer_and_goes_no_further() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.one(FOE, 1001, "02 00 00000000" + FILE)
        packet = bytes.fromhex("03 00 01000000") + bytes(1024 - 12)
        answers = [await harness.one(FOE, 1001, packet) for _ in range(2)]
        assert answers == ["04 00 01 00 00 00"] * 2
        assert (await harness.one(FOE, 1001, "03 00 02000000 01")) == "04 00 02 00 00 00"
        assert (await harness.one(FOE, 1001, "03 00 02000000 01")) == "04 00 02 00 00 00"

    play(scene)


def test_a_step_of_no_transfer_does_not_reach_the_slave() -> None:
    async def scene(harness: GatewayHarness) -> None:
        assert (await harness.one(FOE, 1001, "03 00 01000000 01"))[:2] == "05"
        answer = await harness.one(COE, 1001, "0020 60 00000000000000")
        assert answer.startswith("00 20 80")

    play(scene)


def test_a_client_that_leaves_leaves_no_transfer_behind() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.one(FOE, 1001, "02 00 00000000" + FILE)
        harness.gateway.connection_closed(HERE)
        assert (await harness.begin_file("01 00 00000000" + FILE, ALSO_HERE)).startswith("03")

    play(scene)


def test_stopped_gateway_aborts_all_transfers() -> None:
    async def scene(harness: GatewayHarness) -> None:
        await harness.one(FOE, 1001, "01 00 00000000" + FILE)
        (running,) = harness.gateway.transfers()
        assert (running.endpoint, running.address, running.kind) == (HERE, 1001, FOE)
        await harness.gateway.stop()
        assert not harness.gateway.is_open
        assert not harness.gateway.transfers()
        assert not harness.gateway.tracker.table()
        harness.gateway.start()
        assert harness.gateway.is_open
        assert (await harness.one(FOE, 1001, "01 00 00000000" + FILE)).startswith("03")

    play(scene)


def test_the_same_request_is_answered_once_until_then() -> None:
    async def scene(harness: GatewayHarness) -> None:
        frame = encode_frame(MailboxHeader(0, 1001, type=COE, counter=1), bytes.fromhex(VENDOR))
        answers: list[bytes] = []
        for _ in range(3):
            harness.gateway.receive(frame, HERE, answers.append)
        await harness.gateway.wait_below(HERE, 1)
        assert len(answers) == 1
        assert len(await harness.ask_frame(frame)) == 1

    play(scene)


def test_client_over_its_pending_limit_gets_an_error() -> None:
    async def scene(harness: GatewayHarness) -> None:
        answers: list[bytes] = []
        for index in range(4):
            body = b"\0\x20\x40" + bytes((index, 0x60)) + bytes(5)
            harness.gateway.receive(encode_plain_frame(COE, 1001, 0, body), HERE, answers.append)
        assert [decoded(each)[1][-4:].hex() for each in answers] == ["05000405"] * 2
        await harness.gateway.wait_below(HERE, 1)
        assert len(answers) == 4

    play(scene, settings=Settings(NET_ID, limits=ClientLimits(in_flight=2)))


@pytest.mark.parametrize("address", [0, 1001])
def test_the_same_octets_right_behind_the_answer_are_a_new_request(address: int) -> None:
    async def scene(harness: GatewayHarness) -> None:
        answers: list[bytes] = []
        frame = encode_plain_frame(COE, address, 3, bytes.fromhex(VENDOR))

        def ask_again(octets: bytes) -> None:
            answers.append(octets)
            if len(answers) < 6:
                harness.gateway.receive(frame, HERE, ask_again)

        harness.gateway.receive(frame, HERE, ask_again)
        await harness.gateway.wait_below(HERE, 1)
        assert len(answers) == 6
        assert harness.gateway.tracker.waiting(HERE) == 0

    play(scene)
