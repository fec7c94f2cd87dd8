"""Files of slaves by ADS: opened by name, read and written in blocks by handle, closed."""

from __future__ import annotations

import asyncio

import pytest

from eap.ads.request import Read, ReadWrite, Write
from eap.codec.ads import AdsError, IndexGroup
from eap.ids import NetId
from eap.runtime.engine_messages import ExchangeMailbox
from eap.services.ads import slave_files
from eap.services.slaves.file_stream import MAX_UNSENT
from tests.support.busads import Client, play

DISK, OTHER = 1001, 1002
OPEN_READ, OPEN_WRITE = IndexGroup.FOE_OPEN_READ, IndexGroup.FOE_OPEN_WRITE
READ, WRITE, CLOSE = IndexGroup.FOE_READ, IndexGroup.FOE_WRITE, IndexGroup.FOE_CLOSE
CONTENT = bytes(range(250)) * 300


@pytest.mark.parametrize("block", [1, 7, 1000])
def test_file_is_read_in_blocks(block):
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.read_file(DISK, handle, block) == b"first file"

    play(scene, "files")


@pytest.mark.parametrize("block", [238, 1000, len(CONTENT)])
def test_file_is_written_in_blocks(block):
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin\0")
        for at in range(0, len(CONTENT), block):
            await client.ask(DISK, WRITE, handle, CONTENT[at : at + block], 0)
        await client.ask(DISK, CLOSE, handle)
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.read_file(DISK, handle, 10_000) == CONTENT

    play(scene, "files")


def test_file_is_moved_by_read_and_write():
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        await client.write(DISK, WRITE, handle, b"short")
        await client.write(DISK, CLOSE, handle)
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.read(DISK, READ, handle, 100) == b"short"
        await client.write(DISK, CLOSE, handle)

    play(scene, "files")


def test_file_progress_has_the_octets_so_far():
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        await client.ask(DISK, WRITE, handle, bytes(1000), 0)
        hold_mailboxes(engine)
        await client.ask(DISK, WRITE, handle, bytes(1000), 0)
        done = await client.read(DISK, IndexGroup.FOE_PROGRESS, handle, 8)
        assert int.from_bytes(done[:4], "little") < 2000
        assert done[4:] == bytes(4)
        engine.release()
        await client.ask(DISK, CLOSE, handle)
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert len(await client.read(DISK, READ, handle, 3000)) == 2000
        done = await client.ask(DISK, IndexGroup.FOE_PROGRESS, handle, length=8)
        assert done == b"\xd0\7\0\0\1\0\0\0"

    play(scene, "files")


@pytest.mark.parametrize(
    ("group", "name", "result", "why"),
    [
        (OPEN_READ, b"none.bin", AdsError.NOT_FOUND, "file not found (0x8001)"),
        (OPEN_WRITE, b"boot.bin", AdsError.STATE, "(0x8008)"),
        (OPEN_READ, b"locked.bin", AdsError.ACCESS, "(0x80"),
        (OPEN_READ, b"\xff\xff", AdsError.VALUE, "is not UTF-8"),
        (OPEN_READ, bytes(300).replace(b"\0", b"n"), AdsError.SIZE, "300 bytes"),
    ],
)
def test_file_that_cannot_be_opened_holds_up_no_other(group, name, result, why):
    async def scene(client, engine):
        outcome = await client.do(DISK, ReadWrite(group, 0, 4, name))
        assert outcome.result == result
        assert why in client.why
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")  # others are not kept out
        assert await client.read_file(DISK, handle, 100) == b"first file"

    play(scene, "files")


def test_file_is_opened_with_the_offset_as_password():
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_READ, b"locked.bin", 42)
        assert await client.read_file(DISK, handle, 100) == b"secret"

    play(scene, "files")


def test_file_that_is_too_long_is_refused_when_it_is_closed():
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"small.bin")
        await client.ask(DISK, WRITE, handle, bytes(2000), 0)
        outcome = await client.do(DISK, ReadWrite(CLOSE, handle, 0, b""))
        assert outcome.result == AdsError.NO_MEMORY
        assert "disk full" in client.why
        again = await client.do(DISK, ReadWrite(CLOSE, handle, 0, b""))
        assert again.result == AdsError.INDEX_OFFSET

    play(scene, "files")


def test_file_handle_belongs_to_a_net_id_through_any_connection():
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        client.service.client_gone(client.endpoint)
        client.endpoint = client.endpoint._replace(connection="2")
        assert await client.ask(DISK, READ, handle, length=5) == b"first"
        stranger = Client(client.service, client.bus, net_id=NetId.parse("8.8.8.8.1.1"))
        theirs = await stranger.do(DISK, ReadWrite(READ, handle, 5, b""))
        assert theirs.result == AdsError.INDEX_OFFSET
        elsewhere = await client.do(OTHER, ReadWrite(READ, handle, 5, b""))
        assert elsewhere.result == AdsError.INDEX_OFFSET
        assert await client.read_file(DISK, handle, 100) == b" file"

    play(scene, "files")


def test_file_is_busy_while_the_slave_moves_another_one(monkeypatch):
    monkeypatch.setattr(slave_files, "FILE_BLOCK_S", 0.05)

    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        await client.ask(DISK, WRITE, handle, b"begun", 0)
        second = await client.do(DISK, ReadWrite(OPEN_READ, 0, 4, b"a.bin"))
        assert second.result == AdsError.BUSY
        assert client.why == "left/bus0/disk: another file goes to slave 1001 or comes from it"
        waiting = asyncio.ensure_future(client.open_file(DISK, OPEN_READ, b"a.bin"))
        await asyncio.sleep(0)
        await client.ask(DISK, CLOSE, handle)
        assert await client.read_file(DISK, await waiting, 100) == b"begun"

    play(scene, "files")


def test_file_without_requests_is_closed(monkeypatch):
    monkeypatch.setattr(slave_files, "IDLE_S", 0.02)

    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        await client.ask(DISK, WRITE, handle, b"lost", 0)
        second = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.ask(DISK, READ, second, length=100) == b"first file"
        gone = await client.do(DISK, ReadWrite(CLOSE, handle, 0, b""))
        assert gone.result == AdsError.INDEX_OFFSET

    play(scene, "files")


@pytest.mark.parametrize("data", [b"\0", b"\1\2\3\4"])
def test_file_is_closed_by_a_close_with_data(data):
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        await client.write(DISK, WRITE, handle, b"short")
        await client.write(DISK, CLOSE, handle, data)
        other = Client(client.service, client.bus, net_id=NetId.parse("8.8.8.8.1.1"))
        handle = await other.open_file(DISK, OPEN_READ, b"a.bin")
        assert await other.ask(DISK, READ, handle, length=100) == b"short"
        await other.ask(DISK, CLOSE, handle, data)

    play(scene, "files")


def test_file_left_open_gives_way_to_the_next_one_of_its_owner(monkeypatch):
    monkeypatch.setattr(slave_files, "ABANDONED_S", 0.02)

    async def scene(client, engine):
        left = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        await client.ask(DISK, WRITE, left, b"lost", 0)
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.read_file(DISK, handle, 100) == b"first file"
        gone = await client.do(DISK, ReadWrite(CLOSE, left, 0, b""))
        assert gone.result == AdsError.INDEX_OFFSET

    play(scene, "files")


def test_file_left_open_does_not_count_when_its_owner_opens_the_next_one(monkeypatch):
    monkeypatch.setattr(slave_files, "ABANDONED_S", 0)
    monkeypatch.setattr(slave_files, "MAX_OF_CLIENT", 1)

    async def scene(client, engine):
        await client.open_file(DISK, OPEN_READ, b"a.bin")
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.read_file(DISK, handle, 100) == b"first file"

    play(scene, "files")


def test_file_left_open_does_not_give_way_to_other_clients(monkeypatch):
    monkeypatch.setattr(slave_files, "ABANDONED_S", 0)
    monkeypatch.setattr(slave_files, "FILE_BLOCK_S", 0.05)

    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        other = Client(client.service, client.bus, net_id=NetId.parse("8.8.8.8.1.1"))
        busy = await other.do(DISK, ReadWrite(OPEN_READ, 0, 4, b"a.bin"))
        assert busy.result == AdsError.BUSY
        await client.ask(DISK, CLOSE, handle)

    play(scene, "files")


def test_file_in_use_does_not_give_way_to_the_next_one_of_its_owner(monkeypatch):
    monkeypatch.setattr(slave_files, "ABANDONED_S", 0.05)
    monkeypatch.setattr(slave_files, "FILE_BLOCK_S", 0.1)

    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        hold_mailboxes(engine)
        block = bytes(MAX_UNSENT + 1)
        await client.ask(DISK, WRITE, handle, block, 0)
        closing = asyncio.ensure_future(client.do(DISK, ReadWrite(CLOSE, handle, 0, b"")))
        await asyncio.sleep(0)
        busy = await client.do(DISK, ReadWrite(OPEN_READ, 0, 4, b"a.bin"))
        assert busy.result == AdsError.BUSY
        await closing
        engine.release()
        monkeypatch.undo()
        await client.ask(DISK, CLOSE, handle)

    play(scene, "files")


def test_file_that_is_given_up_keeps_its_content():
    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        await client.ask(DISK, WRITE, handle, b"lost", 0)
        await client.ask(DISK, IndexGroup.FOE_PROGRESS, handle, b"\1", 0)
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.read_file(DISK, handle, 100) == b"first file"

    play(scene, "files")


def test_file_of_a_slow_slave_is_busy_until_it_goes_on(monkeypatch):
    monkeypatch.setattr(slave_files, "FILE_BLOCK_S", 0.05)

    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_WRITE, b"a.bin")
        hold_mailboxes(engine)
        block = bytes(MAX_UNSENT + 1000)
        await client.ask(DISK, WRITE, handle, block, 0)
        for group, data in ((WRITE, b"more"), (CLOSE, b"")):
            late = await client.do(DISK, ReadWrite(group, handle, 0, data))
            assert late.result == AdsError.BUSY
            assert (
                client.why
                == "left/bus0/disk: file 'a.bin' of slave 1001: not ready: repeat the request"
            )
        more = await client.do(DISK, ReadWrite(WRITE, handle, 0, b"more"))
        assert more.result == AdsError.STATE  # it was said that there is no more
        engine.release()
        monkeypatch.undo()
        await client.ask(DISK, CLOSE, handle)
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        assert await client.read_file(DISK, handle, 100_000) == block

    play(scene, "files")


def test_file_that_is_opened_late_is_read_then(monkeypatch):
    monkeypatch.setattr(slave_files, "FILE_BLOCK_S", 0.05)

    async def scene(client, engine):
        hold_mailboxes(engine)
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        missing = await client.open_file(OTHER, OPEN_READ, b"none.bin")
        late = await client.do(DISK, ReadWrite(READ, handle, 100, b""))
        assert late.result == AdsError.BUSY
        engine.release()
        assert await client.read_file(DISK, handle, 100) == b"first file"
        outcome = await client.do(OTHER, ReadWrite(READ, missing, 100, b""))
        assert outcome.result == AdsError.NOT_FOUND

    play(scene, "files")


def hold_mailboxes(engine):
    engine.held_kind = ExchangeMailbox
    engine.holds = True


def test_file_requests_beyond_the_limits_are_refused(monkeypatch):
    monkeypatch.setattr(slave_files, "MAX_OF_CLIENT", 1)

    async def scene(client, engine):
        handle = await client.open_file(DISK, OPEN_READ, b"a.bin")
        full = await client.do(DISK, ReadWrite(OPEN_READ, 0, 4, b"a.bin"))
        assert full.result == AdsError.NO_MORE_HANDLES
        for operation, result in (
            (ReadWrite(READ, handle, slave_files.MAX_BLOCK + 1, b""), AdsError.SIZE),
            (ReadWrite(READ, handle, 4, b"data"), AdsError.SIZE),
            (ReadWrite(OPEN_READ, 0, 3, b"a.bin"), AdsError.SIZE),
            (ReadWrite(WRITE, handle, 0, b"data"), AdsError.ACCESS),
            (Write(OPEN_READ, 0, b"a.bin"), AdsError.SERVICE),
            (Read(READ, handle + 1, 4), AdsError.INDEX_OFFSET),
        ):
            assert (await client.do(DISK, operation)).result == result

    play(scene, "files")
