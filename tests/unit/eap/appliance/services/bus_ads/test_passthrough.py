"""Requests to slaves that answer ADS themselves."""

from __future__ import annotations

from devicebus.mailbox import aoe_client
from devicebus.mailbox.protocol import MailboxSizes
from eap.aoe.ads_operation import Read, Write
from eap.appliance.bus_request import AskMailbox
from eap.codec.ads import AdsError, AdsRange, IndexGroup
from eap.codec.ams import AmsCommand, AmsHeader
from eap.ids import NetId
from tests.support.busads import BUS, TOOL, play
from tests.support.fakeengine import PORT

TALKER = 1001
OTHER = NetId.parse("9.9.9.9.1.1")


def asked(engine) -> list[AmsHeader]:
    return [AmsHeader.decode(each.request) for each in engine.of(AskMailbox)]


def test_slave_is_told_its_address_once():
    async def scene(client, engine):
        number = Read(IndexGroup.SDO, 0x8002_0000, 4)
        assert await client.good(TALKER, number) == b"\7\0\0\0"
        assert await client.good(TALKER, number) == b"\7\0\0\0"
        told, *requests = asked(engine)
        assert (told.target, told.target_port) == (told.source, told.source_port) == (BUS, TALKER)
        sources = {(each.source, each.source_port) for each in requests}
        assert sources == {(TOOL, 30000)}
        assert len({each.invoke_id for each in requests}) == 2

    play(scene, "aoe")


def test_packets_longer_than_the_mailbox_go_in_fragments():
    value = bytes(range(250)) * 2

    async def scene(client, engine):
        await client.write(TALKER, IndexGroup.SDO, 0x8001_0000, value)
        assert await client.read(TALKER, IndexGroup.SDO, 0x8001_0000) == value

    play(scene, "aoe")


def test_results_of_the_slave_come_back():
    async def scene(client, engine):
        for operation, result in (
            (Read(IndexGroup.SDO, 0x5555_0000, 4), AdsError.NOT_FOUND),
            (Write(IndexGroup.SDO, 0x8002_0000, b"\1"), AdsError.GENERAL),
            (Read(0x12345, 0, 4), AdsError.INDEX_GROUP),
        ):
            assert (await client.do(TALKER, operation)).result == result

    play(scene, "aoe")


def test_slave_that_is_somebody_else_is_told_again():
    async def scene(client, engine):
        number = Read(IndexGroup.SDO, 0x8002_0000, 4)
        assert await client.good(TALKER, number) == b"\7\0\0\0"
        report = await client.bus.describe(PORT)
        stranger = AmsHeader(OTHER, TALKER, OTHER, TALKER, AmsCommand.WRITE, length=18)
        told = AdsRange(IndexGroup.ADDRESS, 3, 6).encode() + bytes(OTHER)
        sizes = MailboxSizes(report.slaves[0].to_slave, report.slaves[0].to_master)
        renamed = aoe_client.exchange(stranger, told, sizes)
        await client.bus.converse(PORT, TALKER, renamed, "somebody")
        assert await client.good(TALKER, number) == b"\7\0\0\0"

    play(scene, "aoe")
