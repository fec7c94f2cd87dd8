"""A file that goes on by itself as far as there is data, or room for it."""

from __future__ import annotations

import asyncio
from contextlib import suppress

import pytest

from devicebus.errors import BusError, FoeError, MailboxClosedError
from devicebus.mailbox.conversation import Message
from devicebus.mailbox.foe_server import FoeServer
from devicebus.mailbox.foe_store import MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.services.bus_ads import transfer as transfer_module
from eap.appliance.services.bus_ads.transfer import AHEAD, Transfer
from eap.codec.mailbox import MailboxType

SIZES = MailboxSizes(1024, 1024)
LONG = bytes(range(256)) * 1024


class FakeTalk:
    """A slave without a bus."""

    def __init__(self, content: bytes = b"") -> None:
        store = MemoryStore([MemoryFile("a.bin", content, max_size=1 << 20)])
        self.server = FoeServer(store, SIZES)
        self.asked = 0
        self.end = ""

    async def open(self) -> FakeTalk:
        await asyncio.sleep(0)
        return self

    async def ask(self, ask) -> Message:
        await asyncio.sleep(0)
        self.asked += 1
        answers = self.server.receive_message(ask.request, 0)
        return Message(MailboxType.FOE, answers[0] if ask.expects_reply else b"")

    def abandon(self) -> None:
        self.end = "abandoned"

    def close(self) -> None:
        self.end = self.end or "closed"


def play(scene, talk, *, is_write=False, name="a.bin"):
    async def run():
        transfer = Transfer(name, 0, SIZES, is_write=is_write)
        task = asyncio.ensure_future(transfer.run(talk.open))
        async with asyncio.timeout(5):
            await scene(transfer, task)
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task

    asyncio.run(run())


def test_reads_ahead_but_not_everything():
    talk = FakeTalk(LONG)

    async def scene(transfer, task):
        await transfer.wait_open()
        assert (transfer.has_turn, transfer.is_open) == (True, True)
        for _ in range(1000):
            await asyncio.sleep(0)
        assert AHEAD <= transfer.progress.done < AHEAD + 1024
        assert await transfer.read(2 * AHEAD) == LONG[: 2 * AHEAD]
        assert await transfer.read(1 << 20) == LONG[2 * AHEAD :]
        assert await transfer.read(10) == b""
        assert transfer.is_complete

    play(scene, talk)
    assert talk.end == "closed"


def test_writes_while_more_is_on_its_way():
    talk = FakeTalk()

    async def scene(transfer, task):
        await transfer.wait_open()
        await transfer.write(LONG[:AHEAD])
        await transfer.write(LONG[AHEAD:])
        assert talk.asked < 100
        await transfer.finish()
        assert (transfer.is_complete, transfer.progress.done) == (True, len(LONG))

    play(scene, talk, is_write=True)
    assert talk.end == "closed"


def test_empty_file():
    async def scene(transfer, task):
        await transfer.finish()
        assert transfer.is_complete

    play(scene, FakeTalk(b"before"), is_write=True)


def test_refusal_is_told_to_everybody_who_asks():
    async def scene(transfer, task):
        for _ in range(2):
            with pytest.raises(FoeError):
                await transfer.wait_open()
        with pytest.raises(FoeError):
            await transfer.read(1)
        assert (transfer.has_ended, transfer.is_complete) == (True, False)

    play(scene, FakeTalk(), name="none.bin")


def test_who_gives_up_waiting_takes_nothing():
    talk = FakeTalk(b"0123456789")

    async def scene(transfer, task):
        reading = asyncio.ensure_future(transfer.read(5))
        await asyncio.sleep(0)
        reading.cancel()
        assert await transfer.read(100) == b"0123456789"

    play(scene, talk)


def test_end_in_the_middle_is_told_to_the_slave():
    talk = FakeTalk(LONG)

    async def scene(transfer, task):
        await transfer.wait_open()
        waiting = asyncio.ensure_future(transfer.read(1 << 20))
        await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(BusError, match="given up"):  # and not less than there is
            await waiting
        assert (transfer.has_ended, transfer.is_complete) == (True, False)

    play(scene, talk)
    assert talk.end == "abandoned"


class BrokenTalk(FakeTalk):
    """A slave that forgets its file with every *breaks*-th message, *times* times."""

    def __init__(self, content: bytes = b"", *, breaks: int = 100, times: int = 2) -> None:
        super().__init__(content)
        self.other: FoeServer | None = None
        self.breaks = breaks
        self.times = times

    async def ask(self, ask) -> Message:
        if self.times and self.asked and not self.asked % self.breaks:
            self.times -= 1
            self.server = self.other or self.server
            self.server.reset()
            self.asked += 1
            raise MailboxClosedError("the slave's mailbox was closed")
        return await super().ask(ask)


@pytest.fixture
def soon(monkeypatch):
    monkeypatch.setattr(transfer_module, "PAUSE_S", 0)


async def write_all(transfer):
    for start in range(0, len(LONG), 5000):
        await transfer.write(LONG[start : start + 5000])
    await transfer.finish()


async def read_all(transfer):
    found = b""
    while part := await transfer.read(5000):
        found += part
    return found


def test_transfer_to_a_slave_is_given_again_after_a_fault_of_the_bus(soon):
    talk = BrokenTalk()

    async def write(transfer, task):
        await write_all(transfer)
        assert transfer.is_complete

    async def read(transfer, task):
        assert await read_all(transfer) == LONG

    play(write, talk, is_write=True)
    assert talk.times == 0
    play(read, talk)


def test_transfer_from_a_slave_is_read_again_after_a_fault_of_the_bus(soon):
    talk = BrokenTalk(LONG)

    async def scene(transfer, task):
        assert await read_all(transfer) == LONG

    play(scene, talk)
    assert talk.times == 0


def test_transfer_of_another_file_after_a_fault_of_the_bus_is_an_error(soon):
    talk = BrokenTalk(LONG, times=1)
    talk.other = FakeTalk(LONG[::-1]).server

    async def scene(transfer, task):
        with pytest.raises(BusError, match="has changed while the bus"):
            await read_all(transfer)

    play(scene, talk)


@pytest.mark.parametrize("limit", ["KEPT", "ALL_KEPT"])
def test_transfer_too_long_to_be_kept_is_given_up(soon, monkeypatch, limit):
    monkeypatch.setattr(transfer_module, limit, 10_000)

    async def scene(transfer, task):
        with pytest.raises(MailboxClosedError):
            await write_all(transfer)

    play(scene, BrokenTalk(), is_write=True)


def test_transfers_that_ended_keep_nothing(soon):
    async def scene(transfer, task):
        await write_all(transfer)

    play(scene, BrokenTalk(), is_write=True)
    assert transfer_module._Past.all_kept == 0
