"""SDOs to a slave elsewhere: what goes there, and what comes back."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import Write
from eap.appliance.services.gateway.remote_objects import RemoteObjects
from eap.codec.ads import AdsError, IndexGroup
from eap.gateway.elsewhere import ElsewhereError
from tests.support.elsewhere import Station


def play(
    station: Station, scene: Callable[[Callable[[str], Awaitable[list[str]]]], Awaitable[None]]
) -> None:
    async def run() -> None:
        speaker = RemoteObjects(station.link(), MailboxSizes.of_data(100))

        async def ask(body: str) -> list[str]:
            return [each.hex() for each in await speaker.answer(bytes.fromhex(body))]

        await scene(ask)

    asyncio.run(run())


def test_a_long_download_is_one_write():
    station = Station()

    async def scene(ask) -> None:
        answer = ["0030" + "60" + "0080" + "01" + "00000000"]
        assert await ask("0020 21 0080 01 0c000000 0102") == answer
        assert not station.asked
        assert await ask("0020 01 0102030405060708090a") == ["0030" + "20" + "00" * 7]
        (written,) = station.asked
        assert written == Write(
            IndexGroup.SDO, 0x8000_0001, bytes.fromhex("0102 0102030405060708090a")
        )

    play(station, scene)


def test_a_download_that_is_refused_in_the_end():
    async def scene(ask) -> None:
        with pytest.raises(ElsewhereError) as caught:
            await ask("0020 2b 0080 01 0600 0000")
        assert caught.value.result == AdsError.ACCESS

    play(Station(result=AdsError.ACCESS), scene)


def test_who_does_not_say_a_size_writes_as_much_as_there_is():
    station = Station(b"\0\0")

    async def scene(ask) -> None:
        await ask("0020 22 0080 01 06000000")
        assert station.asked[-1] == Write(IndexGroup.SDO, 0x8000_0001, b"\6\0")

    play(station, scene)


def test_sdo_information_in_fragments():
    station = Station(bytes(120))

    async def scene(ask) -> None:
        first, last = await ask("0080 01 00 0000 0100")
        assert first[4:12] == "82000100"
        assert last[4:12] == "02000000"
        assert len(first) // 2 - 6 + len(last) // 2 - 6 == 120
        station.result = AdsError.NOT_FOUND
        assert await ask("0080 03 00 0000 5555") == ["0080" + "07000000" + "00000206"]

    play(station, scene)
