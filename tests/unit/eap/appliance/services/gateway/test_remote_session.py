"""Sessions with a slave elsewhere, whose station is a table of answers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest
from msgspec.structs import replace

from eap.aoe.ads_operation import Read, Write
from eap.appliance.services.gateway.remote_session import RemoteSession
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason
from tests.support.elsewhere import Station

COE, SOE, FOE, VOE, AOE, EOE = (
    MailboxType[name] for name in ("COE", "SOE", "FOE", "VOE", "AOE", "EOE")
)
UPLOAD = "0020 40 0080 01 00000000"


def play(
    kind: MailboxType,
    station: Station,
    scene: Callable[[Callable[[str], Awaitable[list[str]]], RemoteSession], Awaitable[None]],
) -> None:
    async def run() -> None:
        session = RemoteSession(kind, station.link(), room=100, idle_s=0.05)

        async def ask(body: str) -> list[str]:
            return [each.body.hex() for each in await session.ask(bytes.fromhex(body))]

        await scene(ask, session)
        session.close()

    asyncio.run(run())


def test_a_repeated_segment_is_answered_once_more():
    station = Station(bytes(range(200)))

    async def scene(ask, session) -> None:
        (first,) = await ask(UPLOAD)
        assert first.startswith("0030" + "41" + "0080" + "01" + "c8000000")
        assert session.is_running
        got = bytes.fromhex(first)[10:]
        (part,) = await session.ask(bytes.fromhex("0020 60 00000000000000"))
        (again,) = await session.ask(bytes.fromhex("0020 60 00000000000000"))
        assert (part.is_again, again) == (False, replace(part, is_again=True))
        got += part.body[3:]
        (last,) = await ask("0020 70 00000000000000")
        got += bytes.fromhex(last)[3:]
        assert got[:200] == bytes(range(200))
        assert not session.is_running
        assert station.asked == [Read(IndexGroup.SDO, 0x8000_0001, 0x20002)]

    play(COE, station, scene)


def test_a_transfer_that_nobody_goes_on_with_is_ended():
    async def scene(ask, session) -> None:
        await ask(UPLOAD)
        await asyncio.sleep(0.1)
        assert not session.is_running
        assert (await ask("0020 60 00000000000000"))[0][4:6] == "80"

    play(COE, Station(bytes(200)), scene)


def test_what_a_slave_refuses():
    async def scene(ask, session) -> None:
        assert await ask("0020 2b 0080 01 0600 0000") == [
            "0020" + "80" + "0080" + "01" + "02000106"
        ]

    play(COE, Station(result=AdsError.ACCESS), scene)


def test_idns_in_fragments():
    station = Station(b"\2\0\0\0")

    async def scene(ask, session) -> None:
        assert await ask("0b 40 0100 0102") == []  # one more fragment follows
        assert await ask("03 40 2000 0304") == ["04402000"]
        assert station.asked[-1] == Write(IndexGroup.SOE, 0x0040_0020, b"\1\2\3\4")
        station.result = AdsError.NOT_FOUND
        assert await ask("01 40 2000") == ["12402000" + "0110"]

    play(SOE, station, scene)


@pytest.mark.parametrize(
    ("kind", "body", "result", "reason"),
    [
        (EOE, "00 00 0000 61", 0, Reason.NO_PROTOCOL),
        (COE, UPLOAD, AdsError.HOST_UNREACHABLE, Reason.UNREACHABLE),
        (COE, UPLOAD, AdsError.TARGET_PORT, Reason.NO_SLAVE),
        (COE, "00", 0, Reason.TOO_SHORT),
        (COE, "0090 40 0080 01 00000000", 0, Reason.SERVICE),
        (COE, "0080 02 00 0000 0100", 0, Reason.SERVICE),
        (SOE, "05 40 2000", 0, Reason.SERVICE),
        (VOE, "5a0e0000 0100", AdsError.NOT_FOUND, Reason.SERVICE),
        (AOE, "00" * 31, 0, Reason.TOO_SHORT),
        (AOE, "00" * 16 + "0600 0400" + "00" * 12, 0, Reason.SERVICE),
    ],
)
def test_what_the_gateway_refuses_itself(kind, body, result, reason):
    async def scene(ask, session) -> None:
        (reply,) = await session.ask(bytes.fromhex(body))
        assert reply.reason is reason

    play(kind, Station(result=result), scene)


@pytest.mark.parametrize(("kind", "body"), [(COE, UPLOAD), (FOE, "01 00 00000000 61")])
def test_a_station_that_does_not_answer(kind, body):
    station = Station()
    station.hangs = True

    async def scene(ask, session) -> None:
        (reply,) = await session.ask(bytes.fromhex(body))
        assert reply.reason is Reason.TIMEOUT
        assert not session.is_running

    play(kind, station, scene)


def test_who_waits_for_a_turn_is_answered_in_time_too():
    station = Station()
    station.hangs = True

    async def scene(ask, session) -> None:
        async with asyncio.timeout(0.4):  # not ten times as long as an answer may take
            asked = [session.ask(bytes.fromhex(UPLOAD)) for _ in range(10)]
            answers = await asyncio.gather(*asked)
        assert {reply.reason for (reply,) in answers} == {Reason.TIMEOUT}

    play(COE, station, scene)
