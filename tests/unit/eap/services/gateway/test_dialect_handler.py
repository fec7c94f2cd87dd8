"""Requests of the dialect, and what goes wrong with them; answers are in test_gateway."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from devicebus.errors import (
    FoeError,
    MailboxRefusedError,
    MailboxSizeError,
    MailboxTimeoutError,
    SoeError,
)
from devicebus.mailbox.foe_server import FoeServer, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.request import Operation, Read, ReadWrite, Write
from eap.ams.access import AccessList, service_of
from eap.ams.spec import AccessRule, AccessService
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.codec.soe import Element
from eap.gateway.dialect import (
    DialectFailure,
    ExchangeVoe,
    ReadFile,
    ReadIdn,
    ReadSdo,
    Task,
    WriteIdn,
    WriteSdo,
)
from eap.gateway.error_table import Cause
from eap.gateway.requests import GatewayError
from eap.ids import Endpoint, NetId
from eap.od.abort import SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, variable
from eap.services.gateway.admission import GatewayAdmission, RuleTarget
from eap.services.gateway.dialect_handler import (
    DialectError,
    DialectHandler,
    DialectTarget,
    operation_of,
)
from eap.services.gateway.sessions import MasterSession
from eap.services.slaves.access import SlaveAccess
from eap.services.slaves.remote_slave import LONGEST_ANSWER
from tests.support import busads
from tests.support.elsewhere import Bus, Station
from tests.support.memoryslave import memory_slave
from tests.support.virtualtime import run_virtual

HEAD = 10
"""Octets in front of the data of an answer."""
UPLOAD = ReadSdo(0x1018, 1, complete=False)
MESSAGE = bytes.fromhex("5a0e0000 0100")
BUS = RuleTarget(NetId(bytes(6)), 1001)
HERE = Endpoint("udp:eap0", "127.0.0.1:1")


def handler(room: int = 100, answer_s: float = 1.0, *rules: AccessRule) -> DialectHandler:
    return DialectHandler(GatewayAdmission(lambda: AccessList(rules)), room + HEAD, answer_s)


def perform(task: Task, subject: DialectTarget, room: int = 100, answer_s: float = 1.0) -> bytes:
    return run_virtual(handler(room, answer_s)._perform(task, subject))


def failure(task: Task, subject: Any, room: int = 100, answer_s: float = 1.0) -> DialectError:
    with pytest.raises(DialectError) as caught:
        perform(task, subject, room, answer_s)
    return caught.value


@pytest.mark.parametrize(
    ("task", "service"),
    [
        (ReadSdo(0x1018, 1, complete=True), AccessService.READ),
        (WriteSdo(0x1018, 1, b"1"), AccessService.WRITE),
        (ReadIdn(32, 1, Element.VALUE), AccessService.READ),
        (WriteIdn(32, 1, Element.VALUE, b"1"), AccessService.WRITE),
        (ReadFile("f"), AccessService.READ),
        (ExchangeVoe(b""), AccessService.RAW),
    ],
)
def test_operation_of_a_task_names_its_service(task: Task, service: AccessService) -> None:
    assert service_of(operation_of(task)) is service


@pytest.mark.parametrize(
    ("task", "operation"),
    [
        (UPLOAD, Read(IndexGroup.SDO, 0x1018_0001, LONGEST_ANSWER)),
        (ReadSdo(0x1018, 0, complete=True), Read(IndexGroup.SDO, 0x1018_0100, LONGEST_ANSWER)),
        (WriteSdo(0x6040, 0, b"\6\0"), Write(IndexGroup.SDO, 0x6040_0000, b"\6\0")),
        (ReadIdn(32, 1, Element.NAME), Read(IndexGroup.SOE, 0x0102_0020, LONGEST_ANSWER)),
        (WriteIdn(32, 0, Element.VALUE, b"1"), Write(IndexGroup.SOE, 0x0040_0020, b"1")),
        (ExchangeVoe(MESSAGE), ReadWrite(IndexGroup.VOE, 0, LONGEST_ANSWER, MESSAGE)),
    ],
)
def test_dialect_task_is_one_operation_at_a_remote_slave(task: Task, operation: Operation) -> None:
    station = Station(b"abcd")
    is_write = isinstance(operation, Write)
    assert perform(task, station.link()) == (b"" if is_write else b"abcd")
    assert station.asked == [operation]


class Failing:
    """A slave that fails to give an object; None lets the client wait."""

    def __init__(self, error: Exception | None) -> None:
        self._error = error

    async def read_object(self, index: int, subindex: int, **_: object) -> bytes:
        if self._error is None:
            await asyncio.Event().wait()
        raise self._error or AssertionError


@pytest.mark.parametrize(
    ("error", "expected", "code", "cause"),
    [
        (SdoAbortError(0x06090011, 0x1018, 9), DialectFailure.GENERAL, 0x06090011, Cause.SERVICE),
        (SoeError("x", code=0x1001), DialectFailure.MISSING, None, Cause.SERVICE),
        (SoeError("x", code=0x7004), DialectFailure.READ_ONLY, None, Cause.SERVICE),
        (SoeError("x", code=0x9999), DialectFailure.GENERAL, None, Cause.SERVICE),
        (FoeError("x", code=0x8001), DialectFailure.MISSING, None, Cause.SERVICE),
        (FoeError("x", code=0x8003), DialectFailure.GENERAL, None, Cause.SERVICE),
        (MailboxTimeoutError("x"), DialectFailure.NO_RESPONSE, None, Cause.TIMEOUT),
        (MailboxSizeError("x"), DialectFailure.SIZE, None, Cause.TOO_LONG),
        (MailboxRefusedError("x", detail=2), DialectFailure.NOT_SUPPORTED, None, Cause.SERVICE),
        (None, DialectFailure.NO_RESPONSE, None, Cause.TIMEOUT),
    ],
)
def test_dialect_failure_of_an_error(
    error: Exception | None, expected: DialectFailure, code: int | None, cause: Cause
) -> None:
    found = failure(UPLOAD, Failing(error), answer_s=0.01)
    assert (found.failure, found.code, found.cause) == (expected, code, cause)


@pytest.mark.parametrize(
    ("task", "result", "expected", "code", "cause"),
    [
        (UPLOAD, AdsError.NOT_FOUND, DialectFailure.GENERAL, 0x06020000, Cause.SERVICE),
        (UPLOAD, AdsError.HOST_UNREACHABLE, DialectFailure.GENERAL, None, Cause.UNREACHABLE),
        (UPLOAD, AdsError.TARGET_PORT, DialectFailure.MISSING, None, Cause.NO_SLAVE),
        (
            ReadIdn(1, 0, Element.VALUE),
            AdsError.ACCESS,
            DialectFailure.READ_ONLY,
            None,
            Cause.SERVICE,
        ),
        (ExchangeVoe(MESSAGE), 0x7FF, DialectFailure.GENERAL, None, Cause.SERVICE),
        (ReadFile(""), 0, DialectFailure.FILE_NAME, None, Cause.SERVICE),
    ],
)
def test_dialect_failure_of_a_remote_slave(
    task: Task, result: int, expected: DialectFailure, code: int | None, cause: Cause
) -> None:
    error = failure(task, Station(result=result).link())
    assert (error.failure, error.code, error.cause) == (expected, code, cause)


def test_dialect_station_that_does_not_answer() -> None:
    station = Station()
    station.hangs = True
    assert failure(UPLOAD, station.link(), answer_s=0.05).failure is DialectFailure.NO_RESPONSE


def test_dialect_answer_has_to_fit_one_packet() -> None:
    assert perform(UPLOAD, Station(bytes(80)).link(), 80) == bytes(80)
    error = failure(UPLOAD, Station(bytes(81)).link(), 80)
    assert "more than 80 bytes do not fit one packet" in str(error)


@pytest.mark.parametrize(
    ("name", "room", "expected"),
    [
        ("a.bin", 10, None),
        ("a.bin", 9, DialectFailure.GENERAL),
        ("none.bin", 100, DialectFailure.MISSING),
    ],
)
def test_dialect_file_of_a_remote_slave(
    name: str, room: int, expected: DialectFailure | None
) -> None:
    async def scene(client: busads.Client, engine: object) -> None:
        task = handler(room)._perform(ReadFile(name), Bus(client).link())
        if expected is None:
            assert await task == b"first file"
        else:
            with pytest.raises(DialectError) as caught:
                await task
            assert caught.value.failure is expected

    busads.play(scene, "files")


@pytest.mark.parametrize(("size", "room"), [(72, 80), (80, 80), (104, 80)])
def test_dialect_file_of_a_slave_of_this_bus(size: int, room: int) -> None:
    sizes = MailboxSizes(64, 64)
    store = MemoryStore([MemoryFile("f", bytes(range(size)))])

    def slave() -> SlaveAccess:
        return memory_slave(MailboxType.FOE, FoeServer(store, sizes), sizes)[0]

    if size <= room:
        assert perform(ReadFile("f"), slave(), room) == bytes(range(size))
    else:
        error = failure(ReadFile("f"), slave(), room)
        assert f"more than {room} bytes do not fit one packet" in str(error)
    assert failure(ReadFile("none"), slave(), room).failure is DialectFailure.MISSING


async def up_to_date(index: int) -> None:
    """The master's values are never old."""


def master() -> MasterSession:
    objects = ObjectDictionary([variable(0x2000, "A", "UDINT", RW)])
    return MasterSession(objects, 100, up_to_date, lambda index: True)


def test_dialect_tasks_of_the_master() -> None:
    one = master()
    assert perform(WriteSdo(0x2000, 0, bytes(4)), one) == b""
    assert perform(ReadSdo(0x2000, 0, complete=False), one) == bytes(4)
    error = failure(ReadSdo(0x3000, 0, complete=False), one)
    assert (error.failure, error.code) == (DialectFailure.GENERAL, 0x06020000)
    error = failure(ReadIdn(32, 0, Element.VALUE), one)
    assert "only a CoE dictionary" in str(error)
    assert error.failure is DialectFailure.NOT_SUPPORTED


def test_dialect_request_that_is_refused_reaches_nothing() -> None:
    station = Station(b"abcd")
    reached: list[bool] = []

    async def find() -> DialectTarget:
        reached.append(True)
        return station.link()

    async def handle(body: str, *rules: AccessRule) -> tuple[bytes, Cause | None]:
        octets = bytes.fromhex(body)
        return await handler(100, 1.0, *rules).answer(MailboxType.COE, octets, HERE, BUS, find)

    async def run() -> None:
        rule = AccessRule("no", allow=False)
        answer, cause = await handle("0020 40 1810 01 0000", rule)
        assert (answer.hex(), cause) == ("00208018100102000106", Cause.DENIED)
        answer, cause = await handle("0020 e0 1810 01 0000")
        assert (answer.hex(), cause) == ("00208018100101000405", Cause.SERVICE)
        assert not reached
        answer, cause = await handle("0020 40 1810 01 0000")
        assert (answer.hex(), cause) == ("00304318100161626364", None)

    run_virtual(run())


def test_dialect_slave_that_cannot_be_reached() -> None:
    async def find() -> DialectTarget:
        raise GatewayError(Cause.NO_SLAVE)

    body = bytes.fromhex("0020 40 1810 01 0000")
    answer, cause = run_virtual(handler().answer(MailboxType.COE, body, HERE, BUS, find))
    assert (answer.hex(), cause) == ("00208018100100000206", Cause.NO_SLAVE)
