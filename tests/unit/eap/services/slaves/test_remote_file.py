"""Requests to the other station for a file, in order; packets are in test_file_codec.py."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from eap.ads.request import Read, ReadWrite
from eap.codec.ads import IndexGroup
from eap.services.slaves.remote_slave import BLOCK, RemoteFile
from tests.support import busads
from tests.support.elsewhere import Bus

CONTENT = bytes(range(250)) * 300
DISK = 256 - 12
"""Octets of a file in a packet of the slave."""


def play(scene: Callable[[Bus], Awaitable[None]]) -> None:
    async def run(client: busads.Client, engine: object) -> None:
        await scene(Bus(client))

    busads.play(run, "files")


def opened(bus: Bus, *, is_write: bool) -> RemoteFile:
    return bus.link().open_file("a.bin", 0, is_write=is_write)


async def write(bus: Bus, content: bytes) -> None:
    file = opened(bus, is_write=True)
    await file.wait_open()
    await file.write(content)
    await file.finish()


def groups(bus: Bus) -> list[int]:
    return [each.group for each in bus.asked if isinstance(each, Read | ReadWrite)]


def asked(bus: Bus, group: int) -> Callable[[], Awaitable[bool]]:
    async def look() -> bool:
        return group in groups(bus)

    return look


def ended(file: RemoteFile) -> Callable[[], Awaitable[bool]]:
    async def look() -> bool:
        return file.has_ended

    return look


def test_blocks_are_longer_and_longer() -> None:
    async def scene(bus: Bus) -> None:
        await write(bus, CONTENT)
        file = opened(bus, is_write=False)
        await file.wait_open()
        got = b""
        while part := await file.read(1000):
            got += part
        assert got == CONTENT
        blocks = [
            each.length
            for each in bus.asked
            if isinstance(each, ReadWrite) and each.group == IndexGroup.FOE_READ
        ]
        assert blocks[:3] == [DISK, 2 * DISK, 4 * DISK]
        assert max(blocks) == BLOCK

    play(scene)


def test_a_file_that_is_written_is_closed_once() -> None:
    async def scene(bus: Bus) -> None:
        await write(bus, CONTENT)
        assert groups(bus)[-1] == IndexGroup.FOE_CLOSE
        assert IndexGroup.FOE_PROGRESS not in groups(bus)

    play(scene)


def test_remote_file_closed_before_it_is_opened() -> None:
    async def scene(bus: Bus) -> None:
        file = opened(bus, is_write=True)
        file.close()
        await busads.until(ended(file))
        assert set(groups(bus)) == {IndexGroup.SDO}

    play(scene)


def test_remote_file_closed_while_it_is_opened() -> None:
    async def scene(bus: Bus) -> None:
        file = opened(bus, is_write=True)
        await busads.until(asked(bus, IndexGroup.FOE_OPEN_WRITE))
        file.close()
        await busads.until(asked(bus, IndexGroup.FOE_PROGRESS))

    play(scene)


def test_remote_file_closed_is_closed_at_the_slave() -> None:
    async def scene(bus: Bus) -> None:
        await write(bus, CONTENT)
        file = opened(bus, is_write=False)
        await file.wait_open()
        bus.asked.clear()
        file.close()
        await busads.until(asked(bus, IndexGroup.FOE_CLOSE))

    play(scene)
