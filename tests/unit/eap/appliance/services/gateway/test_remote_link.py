"""What a slave elsewhere is asked, and how large its master says that its mailboxes are."""

from __future__ import annotations

import asyncio

import pytest

from eap.aoe.ads_operation import Read
from eap.aoe.answer import AmsAnswer
from eap.appliance.services.gateway.remote_link import RemoteLink
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsCommand
from eap.gateway.elsewhere import ElsewhereError
from tests.support import busads
from tests.support.elsewhere import Station


def mailboxes(bus: str, station: int) -> tuple[int, int]:
    async def scene(client: busads.Client, engine: object) -> tuple[int, int]:
        async def ask(port: int, command: int, body: bytes, *, timeout_s: float) -> AmsAnswer:
            return await client.answer(port, command, body)

        return await RemoteLink(ask, station, 1).mailboxes()

    return busads.play(scene, bus)


def test_sizes_come_from_the_master() -> None:
    assert mailboxes("files", 1001) == (256, 256)
    assert mailboxes("files", 1002) == (128, 128)
    assert mailboxes("aoe", 1002) == (0, 0)
    with pytest.raises(ElsewhereError) as caught:
        mailboxes("files", 1003)
    assert caught.value.result == AdsError.TARGET_PORT
    with pytest.raises(ElsewhereError) as caught:
        mailboxes("files", 0xFFFF)
    assert caught.value.result == AdsError.SERVICE


def test_a_slave_behind_the_first_list() -> None:
    lists = {0xF020: range(1, 256), 0xF021: (900, 1001)}

    async def ask(port: int, command: int, body: bytes, *, timeout_s: float) -> AmsAnswer:
        offset = int.from_bytes(body[4:8], "little")
        index, subindex = offset >> 16, offset & 0xFF
        found = lists.get(index)
        data = (index + subindex).to_bytes(2, "little")
        if found is not None:
            words = (each.to_bytes(2, "little") for each in (len(found), *found))
            data = b"".join(words)
        return AmsAnswer(bytes(4) + len(data).to_bytes(4, "little") + data)

    number = 256
    expected = 0x8000 + number + 33, 0x8000 + number + 34
    assert asyncio.run(RemoteLink(ask, 1001, 1).mailboxes()) == expected


@pytest.mark.parametrize(
    ("result", "told"),
    [
        (AdsError.NOT_FOUND, AdsError.SERVICE),
        (AdsError.HOST_UNREACHABLE, AdsError.HOST_UNREACHABLE),
    ],
)
def test_a_master_that_does_not_tell(result: AdsError, told: AdsError) -> None:
    with pytest.raises(ElsewhereError) as caught:
        asyncio.run(Station(result=result).link().mailboxes())
    assert caught.value.result == told


def test_requests_of_clients_go_on_as_they_are() -> None:
    station = Station(b"xy")
    body = Read(IndexGroup.SDO, 1, 2)
    octets = b"".join(each.to_bytes(4, "little") for each in body)
    answer = asyncio.run(station.link().pass_on(AmsCommand.READ, octets))
    assert answer.data[8:] == b"xy"
    assert station.asked == [body]
