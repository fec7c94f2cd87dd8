"""Sessions with a slave elsewhere, whose station is a table of answers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from eap.aoe.ads_operation import Operation, OperationOutcome, Read, Write
from eap.appliance.services.gateway.remote_session import RemoteSession
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.gateway.refusal import Reason

COE, SOE, FOE, VOE = MailboxType.COE, MailboxType.SOE, MailboxType.FOE, MailboxType.VOE
UPLOAD = "0020 40 0080 01 00000000"


class Station:
    """Gives *data*, or refuses with *result*."""

    def __init__(self, data: bytes = b"", result: int = 0) -> None:
        self.asked: list[Operation] = []
        self.data = data
        self.result = result
        self.hangs = False

    async def perform(self, operation: Operation) -> OperationOutcome:
        self.asked.append(operation)
        if self.hangs:
            await asyncio.Event().wait()
        return OperationOutcome(self.result, self.data)


def play(
    kind: MailboxType,
    station: Station,
    scene: Callable[[Callable[[str], Awaitable[list[str]]], RemoteSession], Awaitable[None]],
) -> None:
    async def run() -> None:
        session = RemoteSession(kind, station.perform, room=100, answer_s=0.05)

        async def ask(body: str) -> list[str]:
            return [each.body.hex() for each in await session.ask(bytes.fromhex(body))]

        await scene(ask, session)
        session.close()

    asyncio.run(run())


def test_a_long_upload_comes_in_segments():
    station = Station(bytes(range(200)))

    async def scene(ask, session) -> None:
        (first,) = await ask(UPLOAD)
        assert first.startswith("0030" + "41" + "0080" + "01" + "c8000000")
        assert session.is_running
        got = bytes.fromhex(first)[10:]
        (again,) = await ask("0020 60 00000000000000")
        assert (await ask("0020 60 00000000000000")) == [again]  # its answer got lost
        got += bytes.fromhex(again)[3:]
        (last,) = await ask("0020 70 00000000000000")
        got += bytes.fromhex(last)[3:]
        assert got[:200] == bytes(range(200))
        assert not session.is_running
        assert station.asked == [Read(IndexGroup.SDO, 0x8000_0001, 0x20002)]

    play(COE, station, scene)


def test_a_long_download_is_one_write():
    station = Station()

    async def scene(ask, session) -> None:
        answer = ["0030" + "60" + "0080" + "01" + "00000000"]
        assert await ask("0020 21 0080 01 0c000000 0102") == answer
        assert not station.asked
        assert await ask("0020 01 0102030405060708090a") == ["0030" + "20" + "00" * 7]
        (written,) = station.asked
        assert written == Write(
            IndexGroup.SDO, 0x8000_0001, bytes.fromhex("0102 0102030405060708090a")
        )

    play(COE, station, scene)


def test_a_download_that_is_refused_in_the_end():
    station = Station(result=AdsError.ACCESS)

    async def scene(ask, session) -> None:
        assert await ask("0020 2b 0080 01 0600 0000") == [
            "0020" + "80" + "0080" + "01" + "02000106"
        ]

    play(COE, station, scene)


def test_who_does_not_say_a_size_writes_as_much_as_there_is():
    station = Station(b"\0\0")

    async def scene(ask, session) -> None:
        await ask("0020 22 0080 01 06000000")
        assert station.asked[-1] == Write(IndexGroup.SDO, 0x8000_0001, b"\6\0")

    play(COE, station, scene)


def test_sdo_information_in_fragments():
    station = Station(bytes(120))

    async def scene(ask, session) -> None:
        first, last = await ask("0080 01 00 0000 0100")
        assert first[4:12] == "82000100"
        assert last[4:12] == "02000000"
        assert len(first) // 2 - 6 + len(last) // 2 - 6 == 120
        station.result = AdsError.NOT_FOUND
        assert await ask("0080 03 00 0000 5555") == ["0080" + "07000000" + "00000206"]

    play(COE, station, scene)


def test_idns():
    station = Station(b"\2\0\0\0")

    async def scene(ask, session) -> None:
        assert await ask("01 40 2000") == ["02402000" + "02000000"]
        assert await ask("0b 40 0100 0102") == []  # one more fragment follows
        assert await ask("03 40 2000 0304") == ["04402000"]
        assert station.asked[-1] == Write(IndexGroup.SOE, 0x0040_0020, b"\1\2\3\4")
        station.result = AdsError.NOT_FOUND
        assert await ask("01 40 2000") == ["12402000" + "0110"]

    play(SOE, station, scene)


def test_messages_of_a_vendor():
    async def scene(ask, session) -> None:
        assert await ask("5a0e0000 0100") == ["616263"]

    play(VOE, Station(b"abc"), scene)


@pytest.mark.parametrize(
    ("kind", "body", "result", "reason"),
    [
        (FOE, "01 00 00000000 61", 0, Reason.NO_PROTOCOL),
        (COE, UPLOAD, AdsError.HOST_UNREACHABLE, Reason.BUS_DOWN),
        (COE, UPLOAD, AdsError.TARGET_PORT, Reason.NO_SLAVE),
        (COE, "00", 0, Reason.TOO_SHORT),
        (COE, "0090 40 0080 01 00000000", 0, Reason.SERVICE),
        (COE, "0080 02 00 0000 0100", 0, Reason.SERVICE),
        (SOE, "05 40 2000", 0, Reason.SERVICE),
        (VOE, "5a0e0000 0100", AdsError.NOT_FOUND, Reason.SERVICE),
    ],
)
def test_what_the_gateway_refuses_itself(kind, body, result, reason):
    async def scene(ask, session) -> None:
        (reply,) = await session.ask(bytes.fromhex(body))
        assert reply.reason is reason

    play(kind, Station(result=result), scene)


def test_a_station_that_does_not_answer():
    station = Station()
    station.hangs = True

    async def scene(ask, session) -> None:
        (reply,) = await session.ask(bytes.fromhex(UPLOAD))
        assert reply.reason is Reason.TIMEOUT

    play(COE, station, scene)
