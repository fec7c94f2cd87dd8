"""SDOs of a client in front of a slave, in memory or of another station."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from devicebus.mailbox import coe_client
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.request import Write
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, OdState, variable
from eap.services.gateway.transfer_codecs import ObjectCodec
from tests.support.elsewhere import Station
from tests.support.eventually import eventually
from tests.support.memoryslave import MemoryMailbox, lead, memory_share, memory_slave
from tests.support.virtualtime import run_virtual

COE = MailboxType.COE
SIZES = MailboxSizes(32, 40)
TEXT, NUMBER = 0x2000, 0x2001
UPLOAD_SEGMENT = "0020 60 00000000000000"


def objects(memory: int = 1 << 20) -> tuple[ObjectCodec, MemoryMailbox]:
    dictionary = ObjectDictionary(
        [variable(TEXT, "Text", "STRING(300)", RW, ""), variable(NUMBER, "N", "UDINT", RW)]
    )
    server = CoeServer(dictionary, lambda: OdState.OP, SIZES)
    slave, mailbox = memory_slave(COE, server, SIZES)
    return ObjectCodec(slave, SIZES, memory_share(memory)), mailbox


async def handle(codec: ObjectCodec, body: str) -> list[str]:
    return [each.hex() for each in await codec.answer(bytes.fromhex(body))]


def play(scene: Callable[[ObjectCodec, MemoryMailbox], Awaitable[None]]) -> None:
    async def run() -> None:
        codec, mailbox = objects()
        await scene(codec, mailbox)
        codec.reset()

    run_virtual(run())


def play_remote(
    station: Station, scene: Callable[[Callable[[str], Awaitable[list[str]]]], Awaitable[None]]
) -> None:
    async def run() -> None:
        codec = ObjectCodec(station.link(), MailboxSizes.of_data(100), memory_share())
        await scene(lambda body: handle(codec, body))
        codec.reset()

    run_virtual(run())


@pytest.mark.parametrize("size", [0, 1, 4, 5, 16, 17, 24, 25, 100, 300])
def test_object_codec_carries_objects_of_any_size(size: int) -> None:
    data = bytes(range(1, size + 1)) if size < 255 else b"x" * size

    async def scene(codec: ObjectCodec, mailbox: MemoryMailbox) -> None:
        written: list[bool] = []
        await lead(codec, coe_client.download(TEXT, 0, data, SIZES), written)
        running: list[bool] = []
        found = await lead(codec, coe_client.upload(TEXT, 0), running)
        assert found.rstrip(b"\0") == data
        for steps in (written, running):
            assert steps == [True] * (len(steps) - 1) + [False]

    play(scene)


def test_object_codec_reads_to_the_end_before_the_client_does() -> None:
    async def scene(codec: ObjectCodec, mailbox: MemoryMailbox) -> None:
        await lead(codec, coe_client.download(TEXT, 0, b"y" * 300, SIZES))
        mailbox.asked.clear()
        (first,) = await handle(codec, "0020 40 0020 00 00000000")
        assert first.startswith("00304100200" + "02c010000")
        for _ in range(50):
            await asyncio.sleep(0)
        sent = len(mailbox.asked)
        assert sent == 10
        await handle(codec, UPLOAD_SEGMENT)
        assert len(mailbox.asked) == sent
        assert codec.is_running

    play(scene)


def test_object_codec_writes_when_the_last_segment_is_there() -> None:
    async def scene(codec: ObjectCodec, mailbox: MemoryMailbox) -> None:
        assert await handle(codec, "0020 21 0020 00 0a000000 0102") == ["00306000200000000000"]
        assert not mailbox.asked
        last = "0020 01 030405060708090a"
        assert codec.completes_write(bytes.fromhex(last))
        assert await handle(codec, last) == ["0030" + "20" + "00" * 7]
        assert mailbox.asked
        assert not codec.is_running

    play(scene)


@pytest.mark.parametrize(
    ("steps", "code"),
    [
        (["0020 40 5555 00 00000000"], AbortCode.NO_OBJECT),
        (["0020 20 0020 00 00000000"], AbortCode.COMMAND),
        (["0020 a0 0020 00 00000000"], AbortCode.COMMAND),
        (["0020 21 0020 00 02000000 010203"], AbortCode.LENGTH),
        (["0020 21 0020 00 00100000"], AbortCode.OUT_OF_MEMORY),
        (["0020 21 0020 00 09000000", "0020 10 01020304050607"], AbortCode.TOGGLE),
        (["0020 21 0020 00 09000000", "0020 01 01020304050607"], AbortCode.TOO_SHORT),
        (["0020 21 0020 00 09000000", "0020 01 0102030405060708090a"], AbortCode.TOO_LONG),
        (["0020 21 0020 00 09000000", UPLOAD_SEGMENT], AbortCode.COMMAND),
        (["0020 21 5555 00 09000000", "0020 01 010203040506070809"], AbortCode.NO_OBJECT),
        ([UPLOAD_SEGMENT], AbortCode.COMMAND),
    ],
)
def test_object_codec_aborts_with_the_code_of_the_slave_or_its_own(
    steps: list[str], code: AbortCode
) -> None:
    async def run() -> None:
        codec, _ = objects(memory=1000)
        for step in steps[:-1]:
            await handle(codec, step)
        (answer,) = await handle(codec, steps[-1])
        assert answer[:6] == "002080"
        assert bytes.fromhex(answer)[6:] == code.to_bytes(4, "little")
        assert not codec.is_running

    run_virtual(run())


def test_object_codec_is_given_up_by_an_abort() -> None:
    async def scene(codec: ObjectCodec, mailbox: MemoryMailbox) -> None:
        await lead(codec, coe_client.download(TEXT, 0, b"y" * 300, SIZES))
        await handle(codec, "0020 40 0020 00 00000000")
        assert codec.is_running
        assert await handle(codec, "0020 80 0020 00 00000000") == []
        assert not codec.is_running
        await eventually(lambda: mailbox.is_abandoned)

    play(scene)


def test_object_codec_describes_objects_without_a_transfer() -> None:
    async def scene(codec: ObjectCodec, mailbox: MemoryMailbox) -> None:
        running: list[bool] = []
        assert await lead(codec, coe_client.object_list(), running) == [TEXT, NUMBER]
        found = await lead(codec, coe_client.object_description(TEXT), running)
        assert found.name == "Text"
        entry = await lead(codec, coe_client.entry_description(NUMBER, 0), running)
        assert entry.bit_length == 32
        assert not any(running)
        with pytest.raises(SdoAbortError) as refused:
            await lead(codec, coe_client.object_description(0x5555))
        assert refused.value.code == AbortCode.NO_OBJECT

    play(scene)


@pytest.mark.parametrize(
    ("body", "is_step"),
    [(UPLOAD_SEGMENT, True), ("0020 00", True), ("0020 40 00", False), ("0080 60", False)],
)  # fmt: skip
def test_object_codec_knows_segments(body: str, is_step: bool) -> None:
    assert objects()[0].is_step(bytes.fromhex(body)) is is_step


def test_remote_download_in_segments_is_one_write() -> None:
    station = Station()

    async def scene(handle: Callable[[str], Awaitable[list[str]]]) -> None:
        answer = ["0030" + "60" + "0080" + "01" + "00000000"]
        assert await handle("0020 21 0080 01 0c000000 0102") == answer
        assert not station.asked
        assert await handle("0020 01 0102030405060708090a") == ["0030" + "20" + "00" * 7]
        (written,) = station.asked
        assert written == Write(
            IndexGroup.SDO, 0x8000_0001, bytes.fromhex("0102 0102030405060708090a")
        )

    play_remote(station, scene)


def test_remote_download_that_is_refused_is_aborted() -> None:
    async def scene(handle: Callable[[str], Awaitable[list[str]]]) -> None:
        answer = ["0020" + "80" + "0080" + "01" + "02000106"]
        assert await handle("0020 2b 0080 01 0600 0000") == answer

    play_remote(Station(result=AdsError.ACCESS), scene)


def test_remote_download_without_size_has_the_size_of_the_entry() -> None:
    station = Station(b"\0\0")

    async def scene(handle: Callable[[str], Awaitable[list[str]]]) -> None:
        await handle("0020 22 0080 01 06000000")
        assert station.asked[-1] == Write(IndexGroup.SDO, 0x8000_0001, b"\6\0")

    play_remote(station, scene)


def test_remote_sdo_information_comes_in_fragments() -> None:
    station = Station(bytes(120))

    async def scene(handle: Callable[[str], Awaitable[list[str]]]) -> None:
        first, last = await handle("0080 01 00 0000 0100")
        assert first[4:12] == "82000100"
        assert last[4:12] == "02000000"
        assert len(first) // 2 - 6 + len(last) // 2 - 6 == 120
        station.result = AdsError.NOT_FOUND
        assert await handle("0080 03 00 0000 5555") == ["0080" + "07000000" + "00000206"]

    play_remote(station, scene)
