"""Tasks of the dialect for a slave elsewhere: what is asked there, and what goes wrong."""

from __future__ import annotations

import asyncio

import pytest

from eap.aoe.ads_operation import Operation, Read, ReadWrite, Write
from eap.appliance.services.gateway.dialect_elsewhere import perform_elsewhere
from eap.appliance.services.gateway.dialect_task import DialectError
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.soe import Element
from eap.gateway.dialect import (
    Failure,
    ReadFile,
    ReadIdn,
    ReadSdo,
    TalkVoe,
    Task,
    WriteIdn,
    WriteSdo,
)
from eap.gateway.elsewhere import ROOM
from eap.gateway.refusal import Reason
from tests.support import busads
from tests.support.elsewhere import Bus, Station

UPLOAD = ReadSdo(0x1018, 1, complete=False)
MESSAGE = bytes.fromhex("5a0e0000 0100")


def perform(task: Task, station: Station, room: int = 100) -> bytes:
    return asyncio.run(perform_elsewhere(task, station.link(), room))


def failure(task: Task, station: Station, room: int = 100) -> DialectError:
    with pytest.raises(DialectError) as caught:
        perform(task, station, room)
    return caught.value


@pytest.mark.parametrize(
    ("task", "operation"),
    [
        (UPLOAD, Read(IndexGroup.SDO, 0x1018_0001, ROOM)),
        (ReadSdo(0x1018, 0, complete=True), Read(IndexGroup.SDO, 0x1018_0100, ROOM)),
        (WriteSdo(0x6040, 0, b"\6\0"), Write(IndexGroup.SDO, 0x6040_0000, b"\6\0")),
        (ReadIdn(32, 1, Element.NAME), Read(IndexGroup.SOE, 0x0102_0020, ROOM)),
        (WriteIdn(32, 0, Element.VALUE, b"1"), Write(IndexGroup.SOE, 0x0040_0020, b"1")),
        (TalkVoe(MESSAGE), ReadWrite(IndexGroup.VOE, 0, ROOM, MESSAGE)),
    ],
)
def test_each_task_is_one_operation(task: Task, operation: Operation) -> None:
    station = Station(b"abcd")
    assert perform(task, station) == b"abcd"
    assert station.asked == [operation]


@pytest.mark.parametrize(
    ("task", "result", "told", "code", "reason"),
    [
        (UPLOAD, AdsError.NOT_FOUND, Failure.MISSING, 0x06020000, Reason.SERVICE),
        (UPLOAD, AdsError.HOST_UNREACHABLE, Failure.GENERAL, None, Reason.UNREACHABLE),
        (UPLOAD, AdsError.TARGET_PORT, Failure.MISSING, None, Reason.NO_SLAVE),
        (ReadIdn(1, 0, Element.VALUE), AdsError.ACCESS, Failure.READ_ONLY, None, Reason.SERVICE),
        (TalkVoe(MESSAGE), 0x7FF, Failure.GENERAL, None, Reason.SERVICE),
        (ReadFile(""), 0, Failure.FILE_NAME, None, Reason.SERVICE),
    ],
)
def test_what_is_refused(
    task: Task, result: int, told: Failure, code: int | None, reason: Reason
) -> None:
    error = failure(task, Station(result=result))
    assert (error.failure, error.code, error.reason) == (told, code, reason)


def test_a_station_that_does_not_answer() -> None:
    station = Station()
    station.hangs = True
    assert failure(UPLOAD, station).failure is Failure.NO_RESPONSE


def test_what_is_too_long_for_a_packet() -> None:
    assert "more than 3 octets" in str(failure(UPLOAD, Station(b"abcd"), 3))


@pytest.mark.parametrize(
    ("name", "room", "told"),
    [("a.bin", 10, None), ("a.bin", 9, Failure.GENERAL), ("none.bin", 100, Failure.MISSING)],
)
def test_files(name: str, room: int, told: Failure | None) -> None:
    async def scene(client: busads.Client, engine: object) -> None:
        bus = Bus(client)
        task = perform_elsewhere(ReadFile(name), bus.link(), room)
        if told is None:
            assert await task == b"first file"
        else:
            with pytest.raises(DialectError) as caught:
                await task
            assert caught.value.failure is told

    busads.play(scene, "files")
