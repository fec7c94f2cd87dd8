"""Files of an own bus, which move by themselves as far as there is data, or room for it."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest

from devicebus.errors import BusError, FoeError, MailboxClosedError
from devicebus.mailbox.conversation import MailboxMessage
from devicebus.mailbox.foe_server import FoeServer, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.mailbox import MailboxType
from eap.errors import EapError
from eap.services.slaves import file_stream
from eap.services.slaves.file_stream import AHEAD, FileHistory, LocalFile, StallMeter
from tests.support.virtualtime import run_virtual

SIZES = MailboxSizes(1024, 1024)
LONG = bytes(range(256)) * 1024


class FakeTurn:
    """A slave without a bus."""

    def __init__(self, content: bytes = b"") -> None:
        store = MemoryStore([MemoryFile("a.bin", content, max_size=1 << 20)])
        self.server = FoeServer(store, SIZES)
        self.asked = 0
        self.end = ""

    async def open(self, requester: object) -> FakeTurn:
        await asyncio.sleep(0)
        self.requester = requester
        return self

    async def exchange(self, request) -> MailboxMessage:
        await asyncio.sleep(0)
        self.asked += 1
        answers = self.server.receive_message(request.request, 0)
        return MailboxMessage(MailboxType.FOE, answers[0] if request.expects_reply else b"")

    def abandon(self) -> None:
        self.end = "abandoned"

    def close(self) -> None:
        self.end = self.end or "closed"


def test_stall_meter_adds_up_pauses_that_no_work_pays_off() -> None:
    meter = StallMeter()
    now_s = 100.0
    for _ in range(3):
        assert meter.total_s(now_s) < 2
        meter.begin(now_s)
        assert meter.total_s(now_s + 0.8) > meter.total_s(now_s)
        meter.end(now_s + 0.8)
        now_s += 0.81  # the slave takes the packet in 10 ms
    assert meter.total_s(now_s) > 2
    assert meter.total_s(now_s + 5) == 0


def test_stall_meter_takes_the_round_trips_of_a_client_for_work() -> None:
    meter = StallMeter()
    for number in range(1000):
        meter.begin(number / 10)
        meter.end(number / 10 + 0.09)
    assert meter.total_s(100) == 0


def play(scene, turn, *, is_write=False, name="a.bin"):
    async def run():
        file = LocalFile(name, 0, SIZES, turn.open, is_write=is_write)
        async with asyncio.timeout(5):
            await scene(file)
        file.close()
        with suppress(EapError):
            await file.finish()

    run_virtual(run())


def test_file_is_read_ahead_but_not_to_its_end():
    turn = FakeTurn(LONG)

    async def scene(file):
        await file.wait_open()
        assert (file.has_lock, file.is_open) == (True, True)
        for _ in range(1000):
            await asyncio.sleep(0)
        assert AHEAD <= file.progress.done < AHEAD + 1024
        assert await file.read(2 * AHEAD) == LONG[: 2 * AHEAD]
        assert await file.read(1 << 20) == LONG[2 * AHEAD :]
        assert await file.read(10) == b""
        assert file.is_complete

    play(scene, turn)
    assert turn.end == "closed"


def test_file_is_written_while_more_comes():
    turn = FakeTurn()

    async def scene(file):
        await file.wait_open()
        await file.write(LONG[:AHEAD])
        await file.write(LONG[AHEAD:])
        assert turn.asked < 100
        await file.finish()
        assert (file.is_complete, file.progress.done) == (True, len(LONG))

    play(scene, turn, is_write=True)
    assert turn.end == "closed"


def test_file_that_is_empty_is_written():
    async def scene(file):
        await file.finish()
        assert file.is_complete

    play(scene, FakeTurn(b"before"), is_write=True)


def test_file_that_is_refused_raises_in_every_call():
    async def scene(file):
        for _ in range(2):
            with pytest.raises(FoeError):
                await file.wait_open()
        with pytest.raises(FoeError):
            await file.read(1)
        assert (file.has_ended, file.is_complete) == (True, False)

    play(scene, FakeTurn(), name="none.bin")


def test_file_read_that_is_cancelled_takes_nothing():
    turn = FakeTurn(b"0123456789")

    async def scene(file):
        reading = asyncio.ensure_future(file.read(5))
        await asyncio.sleep(0)
        reading.cancel()
        assert await file.read(100) == b"0123456789"

    play(scene, turn)


def test_file_that_is_closed_early_is_ended_at_the_slave():
    turn = FakeTurn(LONG)

    async def scene(file):
        await file.wait_open()
        waiting = asyncio.ensure_future(file.read(1 << 20))
        await asyncio.sleep(0)
        file.close()
        with pytest.raises(BusError, match="transfer was aborted"):  # and not less than there is
            await waiting
        assert (file.has_ended, file.is_complete) == (True, False)

    play(scene, turn)
    assert turn.end == "abandoned"


class BrokenTurn(FakeTurn):
    """A slave that forgets its file with every *breaks*-th message, *times* times."""

    def __init__(self, content: bytes = b"", *, breaks: int = 100, times: int = 2) -> None:
        super().__init__(content)
        self.other: FoeServer | None = None
        self.breaks = breaks
        self.times = times

    async def exchange(self, request) -> MailboxMessage:
        if self.times and self.asked and not self.asked % self.breaks:
            self.times -= 1
            self.server = self.other or self.server
            self.server.reset()
            self.asked += 1
            raise MailboxClosedError("the slave's mailbox was closed")
        return await super().exchange(request)


@pytest.fixture
def soon(monkeypatch):
    monkeypatch.setattr(file_stream, "PAUSE_S", 0)


async def write_all(file):
    for start in range(0, len(LONG), 5000):
        await file.write(LONG[start : start + 5000])
    await file.finish()


async def read_all(file):
    found = b""
    while part := await file.read(5000):
        found += part
    return found


def test_transfer_to_a_slave_is_given_again_after_a_fault_of_the_bus(soon):
    turn = BrokenTurn()

    async def write(file):
        await write_all(file)
        assert file.is_complete

    async def read(file):
        assert await read_all(file) == LONG

    play(write, turn, is_write=True)
    assert turn.times == 0
    play(read, turn)


def test_transfer_from_a_slave_is_read_again_after_a_fault_of_the_bus(soon):
    turn = BrokenTurn(LONG)

    async def scene(file):
        assert await read_all(file) == LONG

    play(scene, turn)
    assert turn.times == 0


def test_transfer_of_another_file_after_a_fault_of_the_bus_is_an_error(soon):
    turn = BrokenTurn(LONG, times=1)
    turn.other = FakeTurn(LONG[::-1]).server

    async def scene(file):
        with pytest.raises(BusError, match="has changed while the bus"):
            await read_all(file)

    play(scene, turn)


@pytest.mark.parametrize("limit", ["MAX_KEPT", "MAX_ALL_KEPT"])
def test_transfer_too_long_to_be_kept_is_given_up(soon, monkeypatch, limit):
    monkeypatch.setattr(file_stream, limit, 10_000)

    async def scene(file):
        with pytest.raises(MailboxClosedError):
            await write_all(file)

    play(scene, BrokenTurn(), is_write=True)


def test_transfers_that_ended_keep_nothing(soon):
    async def scene(file):
        await write_all(file)

    play(scene, BrokenTurn(), is_write=True)
    assert FileHistory.all_kept == 0
