"""One client, one slave, one protocol; what several do to each other is in test_gateway."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest
from msgspec.structs import replace

from devicebus.errors import (
    BusError,
    FrameLostError,
    MailboxBusyError,
    MailboxClosedError,
    MailboxProtocolError,
    MailboxRefusedError,
    MailboxSizeError,
    MailboxTimeoutError,
    NoMailboxError,
)
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.request import Read
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.mailbox import MailboxType
from eap.errors import EapError, EngineGoneError
from eap.gateway.error_table import Cause
from eap.gateway.requests import GatewayError
from eap.ids import Endpoint
from eap.runtime.engine_messages import SlaveDescription
from eap.services.gateway import sessions as module
from eap.services.gateway.gateway import check_slave
from eap.services.gateway.message_codecs import codec_for
from eap.services.gateway.sessions import (
    ClientSession,
    SessionKey,
    SessionTable,
    cause_of,
)
from eap.services.slaves.access import RemoteAccessError
from tests.support.elsewhere import Station
from tests.support.eventually import elapse, eventually
from tests.support.memoryslave import memory_share
from tests.support.virtualtime import run_virtual

COE, SOE, FOE, VOE, AOE, EOE = (
    MailboxType[name] for name in ("COE", "SOE", "FOE", "VOE", "AOE", "EOE")
)
UPLOAD = "0020 40 0080 01 00000000"
SEGMENT = "0020 60 00000000000000"
HERE, THERE = Endpoint("udp:a", "1"), Endpoint("udp:a", "2")
SLAVE = SlaveDescription(
    station=1001, name="s", vendor=1, product=2, revision=3, serial=4, alias=0, state=8, target=8,
    to_slave=64, to_master=64, protocols=0x0C,
)  # fmt: skip

Ask = Callable[[str], Awaitable[list[str]]]


def play(
    kind: MailboxType,
    station: Station,
    scene: Callable[[Ask, ClientSession], Awaitable[None]],
    idle_s: float = 5.0,
    answer_s: float = 2.0,
) -> None:
    async def run() -> None:
        codec = codec_for(
            kind,
            station.link(answer_s),
            MailboxSizes.of_data(100),
            memory_share(),
            wait_s=answer_s / 3,
        )
        session = ClientSession(kind, codec, answer_s=answer_s, idle_s=idle_s)

        async def handle(body: str, *, is_step: bool = False) -> list[str]:
            replies = await session.handle(bytes.fromhex(body), is_step=is_step)
            return [each.body.hex() for each in replies]

        await scene(handle, session)
        session.close()

    run_virtual(run())


def test_session_repeated_segment_is_answered_once_more() -> None:
    station = Station(bytes(range(200)))

    async def scene(handle: Ask, session: ClientSession) -> None:
        (first,) = await handle(UPLOAD)
        assert first.startswith("0030" + "41" + "0080" + "01" + "c8000000")
        assert session.is_running
        got = bytes.fromhex(first)[10:]
        (part,) = await session.handle(bytes.fromhex(SEGMENT), is_step=True)
        (again,) = await session.handle(bytes.fromhex(SEGMENT), is_step=True)
        assert (part.is_repeat, again) == (False, replace(part, is_repeat=True))
        got += part.body[3:]
        (last,) = await handle("0020 70 00000000000000")
        got += bytes.fromhex(last)[3:]
        assert got[:200] == bytes(range(200))
        assert not session.is_running
        assert station.asked == [Read(IndexGroup.SDO, 0x8000_0001, 0x20002)]

    play(COE, station, scene)


def test_session_transfer_without_next_step_is_given_up() -> None:
    async def scene(handle: Ask, session: ClientSession) -> None:
        await handle(UPLOAD)
        assert session.is_running
        await eventually(lambda: not session.is_running)
        (reply,) = await session.handle(bytes.fromhex(SEGMENT), is_step=True)
        assert reply.reason is Cause.SERVICE
        assert reply.body.hex()[4:6] == "80"

    play(COE, Station(bytes(200)), scene, idle_s=0.02)


def test_session_restarts_with_an_initiate_request() -> None:
    station = Station(bytes(200))

    async def scene(handle: Ask, session: ClientSession) -> None:
        assert await handle(UPLOAD) == await handle(UPLOAD)
        assert len(station.asked) == 2

    play(COE, station, scene)


@pytest.mark.parametrize(
    ("kind", "body", "result", "cause"),
    [
        (EOE, "06000000", AdsError.SERVICE, Cause.NO_PROTOCOL),
        (EOE, "06000000", AdsError.INDEX_GROUP, Cause.NO_PROTOCOL),
        (EOE, "06000000", AdsError.HOST_UNREACHABLE, Cause.UNREACHABLE),
        (EOE, "00", 0, Cause.TOO_SHORT),
        (COE, UPLOAD, AdsError.HOST_UNREACHABLE, Cause.UNREACHABLE),
        (COE, UPLOAD, AdsError.TARGET_PORT, Cause.NO_SLAVE),
        (COE, "00", 0, Cause.TOO_SHORT),
        (COE, "0090 40 0080 01 00000000", 0, Cause.SERVICE),
        (COE, "0080 02 00 0000 0100", 0, Cause.SERVICE),
        (SOE, "05 40 2000", 0, Cause.SERVICE),
        (SOE, "01 40 2000", 0x7FF, Cause.SERVICE),
        (VOE, "5a0e0000 0100", AdsError.NOT_FOUND, Cause.SERVICE),
        (AOE, "00" * 31, 0, Cause.TOO_SHORT),
        (AOE, "00" * 16 + "0600 0400" + "00" * 12, 0, Cause.SERVICE),
    ],
)
def test_session_answers_errors_of_the_gateway(
    kind: MailboxType, body: str, result: int, cause: Cause
) -> None:
    async def scene(handle: Ask, session: ClientSession) -> None:
        (reply,) = await session.handle(bytes.fromhex(body), is_step=False)
        assert reply.reason is cause

    play(kind, Station(result=result), scene)


def test_session_general_error_of_a_remote_element_keeps_its_bytes() -> None:
    async def scene(handle: Ask, session: ClientSession) -> None:
        assert await handle("03 40 2000 01") == ["14402000" + "0b80"]

    play(SOE, Station(result=0x7FF), scene)


@pytest.mark.parametrize(("kind", "body"), [(COE, UPLOAD), (FOE, "01 00 00000000 61")])
def test_session_answers_in_time_for_a_station_that_does_not(kind: MailboxType, body: str) -> None:
    station = Station()
    station.hangs = True

    async def scene(handle: Ask, session: ClientSession) -> None:
        (reply,) = await session.handle(bytes.fromhex(body), is_step=False)
        assert (reply.reason, reply.is_overdue) == (Cause.TIMEOUT, True)
        assert not session.is_running

    play(kind, station, scene, answer_s=0.05)


def test_session_answers_in_time_for_requests_that_wait() -> None:
    station = Station()
    station.hangs = True

    async def scene(handle: Ask, session: ClientSession) -> None:
        async with asyncio.timeout(4):  # not ten times as long as an answer may take
            asked = [session.handle(bytes.fromhex(UPLOAD), is_step=False) for _ in range(10)]
            answers = await asyncio.gather(*asked)
        assert {reply.reason for (reply,) in answers} == {Cause.TIMEOUT}

    play(COE, station, scene, answer_s=0.5)


class Codec:
    """Raises, or answers when it is told to.

    Attributes:
        resets: Times that what was under way was given up.
    """

    sizes = MailboxSizes()
    is_running = False

    def __init__(self, error: BaseException | None = None, *, is_long: bool = False) -> None:
        self.resets = 0
        self._error = error
        self._is_long = is_long

    async def answer(self, body: bytes) -> list[bytes]:
        if self._error is not None:
            raise self._error
        await elapse(0.4)
        return [b"done"]

    def is_step(self, body: bytes) -> bool:
        return True

    def completes_write(self, body: bytes) -> bool:
        return self._is_long

    def reset(self) -> None:
        self.resets += 1


def test_session_passes_a_mailbox_error_of_the_slave() -> None:
    codec = Codec(MailboxRefusedError("no", detail=4))
    session = ClientSession(COE, codec, answer_s=0.5)
    (reply,) = run_virtual(session.handle(b"\0\x20\x40", is_step=False))
    assert (reply.type, reply.body) == (MailboxType.ERR, bytes.fromhex("0100 0400"))
    assert reply.reason is None
    assert codec.resets == 1


def test_session_request_that_is_cancelled_leaves_nothing_behind() -> None:
    async def run() -> None:
        codec = Codec(asyncio.CancelledError())
        with pytest.raises(asyncio.CancelledError):
            await ClientSession(COE, codec, answer_s=0.5).handle(b"", is_step=False)
        assert codec.resets == 1

    run_virtual(run())


@pytest.mark.parametrize(("is_long", "cause"), [(False, Cause.TIMEOUT), (True, None)])
def test_session_last_step_of_a_download_may_take_longer(is_long: bool, cause: Cause) -> None:
    session = ClientSession(COE, Codec(is_long=is_long), answer_s=0.2)
    (reply,) = run_virtual(session.handle(b"\0\x20\1", is_step=False))
    assert reply.reason is cause


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (MailboxTimeoutError("x"), Cause.TIMEOUT),
        (MailboxSizeError("x"), Cause.TOO_LONG),
        (MailboxBusyError("x"), Cause.BUSY),
        (MailboxProtocolError("x"), Cause.PROTOCOL),
        (NoMailboxError("x"), Cause.NO_MAILBOX),
        (MailboxClosedError("x"), Cause.TIMEOUT),
        (FrameLostError("x"), Cause.BUS_DOWN),
        (BusError("x"), Cause.TIMEOUT),
        (EngineGoneError("x"), Cause.BUS_DOWN),
        (GatewayError(Cause.CROWDED), Cause.CROWDED),
        (RemoteAccessError(AdsError.TIMEOUT), Cause.TIMEOUT),
        (RemoteAccessError(AdsError.NOT_FOUND), Cause.SERVICE),
    ],
)
def test_cause_of_an_error(error: EapError, cause: Cause) -> None:
    assert cause_of(error) is cause


def refused(kind: MailboxType, body: bytes, slave: SlaveDescription) -> Cause:
    with pytest.raises(GatewayError) as caught:
        check_slave(kind, body, slave)
    return caught.value.cause


def test_check_slave_names_the_cause_of_a_request_that_cannot_be_sent() -> None:
    check_slave(COE, bytes(58), SLAVE)
    assert refused(COE, bytes(59), SLAVE) is Cause.TOO_LONG
    assert refused(SOE, b"", SLAVE) is Cause.NO_PROTOCOL
    closed = replace(SLAVE, to_slave=0, to_master=0)
    assert refused(COE, b"", closed) is Cause.NO_MAILBOX


# Tables of sessions


class Session:
    def __init__(self, *, is_running: bool = False) -> None:
        self.is_running = is_running
        self.is_closed = False

    def close(self) -> None:
        self.is_closed = True


def key(endpoint: Endpoint = HERE, address: int = 1001) -> SessionKey:
    return SessionKey(endpoint, address, COE)


def test_session_table_keeps_a_clients_session() -> None:
    sessions: SessionTable[Session] = SessionTable()
    first = sessions.get(key(), Session)
    assert sessions.get(key(), Session) is first
    other = sessions.get(key(THERE), Session)
    assert other is not first
    assert sessions.of_slave(1001, COE) == [(key(), first), (key(THERE), other)]
    assert sessions.of_slave(1001, FOE) == sessions.of_slave(1002, COE) == []
    sessions.close_of(HERE)
    assert first.is_closed
    assert sessions.get(key(), Session) is not first


def test_session_table_lists_running_transfers() -> None:
    sessions: SessionTable[Session] = SessionTable()
    sessions.get(key(), Session)
    sessions.get(key(THERE), lambda: Session(is_running=True))
    assert list(sessions.running()) == [key(THERE)]


def test_session_table_drops_the_oldest_unless_it_is_running(monkeypatch) -> None:
    monkeypatch.setattr(module, "MAX_SESSIONS", 2)
    sessions: SessionTable[Session] = SessionTable()
    running = sessions.get(key(address=1), lambda: Session(is_running=True))
    idle = sessions.get(key(address=2), Session)
    last = sessions.get(key(address=3), Session)
    assert [each.is_closed for each in (running, idle, last)] == [False, True, False]
    sessions.close()
    assert running.is_closed
    assert last.is_closed
