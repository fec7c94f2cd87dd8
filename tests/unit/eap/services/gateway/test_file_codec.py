"""Files of a remote slave, packet by packet; mailboxes have room for 244 octets of a file."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable

import pytest

from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.ads import AdsError
from eap.codec.foe import FoeErrorCode, FoeOpcode, decode_message, encode_message
from eap.gateway.error_table import Cause
from eap.gateway.requests import GatewayError
from eap.runtime.engine_messages import ExchangeMailbox
from eap.services.gateway.transfer_codecs import FileCodec
from eap.services.slaves.access import RemoteAccessError
from tests.support import busads
from tests.support.elsewhere import Bus
from tests.support.fakeengine import FakeEngine
from tests.support.memoryslave import memory_share

READ, WRITE, DATA, ACK, ERROR, BUSY = FoeOpcode
CONTENT = bytes(range(250)) * 300
ROOM = 244


class Files:
    """One client's session."""

    def __init__(self, bus: Bus, answer_s: float = 1) -> None:
        access = bus.link(answer_s=answer_s)
        self.codec = FileCodec(access, MailboxSizes(), memory_share(), answer_s / 3)

    async def handle(self, opcode: int, number: int, body: bytes = b"") -> tuple[int, int, bytes]:
        """Return opcode, number and body of an answer, when it is another one than BUSY."""
        while (answer := await self.once(opcode, number, body))[0] == BUSY:
            pass
        return answer

    async def once(self, opcode: int, number: int, body: bytes = b"") -> tuple[int, int, bytes]:
        """Return opcode, number and body of an answer."""
        (answer,) = await self.codec.answer(encode_message(FoeOpcode(opcode), number, body))
        header, rest = decode_message(answer)
        return header.opcode, header.number, bytes(rest)

    async def write(self, content: bytes, name: bytes = b"a.bin") -> None:
        """Write a whole file."""
        assert (await self.handle(WRITE, 0, name))[:2] == (ACK, 0)
        ends = range(0, len(content) + 1, ROOM)
        for number, at in enumerate(ends, start=1):
            answer = await self.handle(DATA, number, content[at : at + ROOM])
            assert answer[:2] == (ACK, number)

    async def read(self, name: bytes = b"a.bin") -> bytes:
        """Read a whole file."""
        content, number = b"", 0
        opcode, got, data = await self.handle(READ, 0, name)
        while True:
            number += 1
            assert (opcode, got) == (DATA, number)
            content += data
            if len(data) < ROOM:
                last = encode_message(FoeOpcode.ACK, number)
                assert await self.codec.answer(last) == []
                return content
            opcode, got, data = await self.handle(ACK, number)


def play(scene: Callable[[Bus, FakeEngine], Awaitable[None]]) -> None:
    async def run(client: busads.Client, engine: FakeEngine) -> None:
        await scene(Bus(client), engine)

    busads.play(run, "files")


@pytest.mark.parametrize("size", [0, 1, ROOM, 2 * ROOM + 1, len(CONTENT)])
def test_files_of_any_size(size: int) -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.write(CONTENT[:size])
        assert await files.read() == CONTENT[:size]
        assert await Files(bus).read() == CONTENT[:size]

    play(scene)


@pytest.mark.parametrize(
    ("opcode", "name", "code"),
    [
        (READ, b"none.bin", FoeErrorCode.NOT_FOUND),
        (WRITE, b"boot.bin", FoeErrorCode.ILLEGAL),
        (READ, b"locked.bin", FoeErrorCode.ACCESS_DENIED),
        (READ, bytes(300).replace(b"\0", b"n"), FoeErrorCode.NOT_DEFINED),
    ],
)
def test_file_error_of_the_slave_reaches_the_client(
    opcode: FoeOpcode, name: bytes, code: FoeErrorCode
) -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        for _ in range(2):  # asking again is another try
            assert (await files.handle(opcode, 0, name))[:2] == (ERROR, code)
            assert not files.codec.is_running
        assert await files.read() == b"first file"

    play(scene)


def test_file_codec_passes_the_password() -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        assert await Files(bus).handle(READ, 42, b"locked.bin") == (DATA, 1, b"secret")

    play(scene)


def test_a_slave_that_takes_no_more() -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.handle(WRITE, 0, b"small.bin")
        for number in range(1, 22):
            opcode, code, _ = await files.handle(DATA, number, bytes(ROOM if number < 21 else 1))
            if opcode == ERROR:
                break
        assert (opcode, code) == (ERROR, FoeErrorCode.DISK_FULL)

    play(scene)


@pytest.mark.parametrize(
    ("opcode", "number", "code"),
    [
        (DATA, 2, FoeErrorCode.PACKET_NUMBER),
        (ACK, 1, FoeErrorCode.ILLEGAL),
    ],
)
def test_a_step_out_of_order(opcode: FoeOpcode, number: int, code: FoeErrorCode) -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.handle(WRITE, 0, b"a.bin")
        assert (await files.handle(opcode, number))[:2] == (ERROR, code)
        assert await files.read() == b"first file"

    play(scene)


def test_file_codec_reader_that_is_busy_gets_its_packet_again() -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.write(CONTENT[: 3 * ROOM])
        first = await files.handle(READ, 0, b"a.bin")
        assert await files.once(BUSY, 0) == first
        second = await files.handle(ACK, 1)
        assert second == (DATA, 2, CONTENT[ROOM : 2 * ROOM])
        assert (await files.handle(ACK, 1))[:2] == (ERROR, FoeErrorCode.PACKET_NUMBER)
        assert not files.codec.is_running

    play(scene)


def test_file_codec_ends_a_transfer_with_an_unknown_opcode() -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.handle(READ, 0, b"a.bin")
        (answer,) = await files.codec.answer(bytes.fromhex("09 00 00000000"))
        assert answer == encode_message(ERROR, FoeErrorCode.ILLEGAL)
        assert not files.codec.is_running

    play(scene)


def test_a_packet_longer_than_the_mailbox() -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.handle(WRITE, 0, b"a.bin")
        with pytest.raises(GatewayError) as caught:
            await files.handle(DATA, 1, bytes(ROOM + 1))
        assert caught.value.cause is Cause.TOO_LONG

    play(scene)


@pytest.mark.parametrize("goes_on", [True, False])
def test_file_client_that_has_to_wait_gets_busy(goes_on: bool) -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        engine.held_kind = ExchangeMailbox
        engine.holds = True
        files = Files(bus, answer_s=0.1)
        for _ in range(2):
            assert (await files.once(WRITE, 0, b"a.bin"))[0] == BUSY
        if goes_on:
            engine.release()
            assert (await files.handle(WRITE, 0, b"a.bin"))[0] == ACK
            engine.holds = True
            assert (await files.once(DATA, 1, b"written"))[0] == BUSY
            engine.release()
            assert (await files.handle(DATA, 1, b"written"))[0] == ACK
        else:
            assert await files.codec.answer(encode_message(FoeOpcode.ERROR, 0x8000)) == []
            engine.release()
        assert await files.read() == (b"written" if goes_on else b"first file")

    play(scene)


@pytest.mark.parametrize("opcode", [READ, WRITE])
def test_a_station_that_vanishes(opcode: FoeOpcode) -> None:
    async def go_on(files: Files) -> None:
        for number in range(1, 1000):
            step = (ACK, number) if opcode == READ else (DATA, number, bytes(ROOM))
            async with asyncio.timeout(0.3):
                await files.once(*step)

    async def scene(bus: Bus, engine: FakeEngine) -> None:
        await Files(bus).write(CONTENT)
        files = Files(bus, answer_s=0.1)
        await files.handle(opcode, 0, b"a.bin")
        bus.is_gone = True
        with pytest.raises(RemoteAccessError) as caught:
            await go_on(files)
        assert caught.value.result == AdsError.TIMEOUT
        files.codec.reset()

    play(scene)


def test_abandoned_write_leaves_no_file() -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.handle(WRITE, 0, b"a.bin")
        await files.handle(DATA, 1, bytes(ROOM))
        files.codec.reset()
        assert await Files(bus).read() == b"first file"

    play(scene)


def test_another_file_ends_the_one_before() -> None:
    async def scene(bus: Bus, engine: FakeEngine) -> None:
        files = Files(bus)
        await files.write(CONTENT)
        assert (await files.handle(READ, 0, b"a.bin"))[0] == DATA
        assert (await files.handle(READ, 0, b"small.bin")) == (DATA, 1, b"")
        assert await files.read() == CONTENT

    play(scene)
