"""Which part of a slave's mailbox serves what, and what a slave cannot do."""

from __future__ import annotations

import pytest

from eap.aoe.ads_operation import Read, ReadState, ReadWrite, Write, WriteControl
from eap.codec.ads import AdsError, AdsState, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode
from tests.support.busads import DRIVE, play, until

TALKER, MUTE, OTHER = 1001, 1002, 1002


def test_states_as_a_value():
    async def scene(client, engine):
        assert await client.read(DRIVE, IndexGroup.DEVICE_DATA, 0) == b"\x0f\0\2\0"
        assert await client.read(DRIVE, IndexGroup.DEVICE_DATA, 2) == b"\2\0"
        wrong = await client.do(DRIVE, WriteControl(AdsState.SHUTDOWN, 0, b""))
        assert wrong.result == AdsError.VALUE

    play(scene)


@pytest.mark.parametrize("group", [IndexGroup.SDO, IndexGroup.SOE, IndexGroup.VOE])
def test_protocol_that_a_slave_does_not_speak(group):
    async def scene(client, engine):
        assert (await client.do(MUTE, Read(group, 0, 4))).result == AdsError.SERVICE
        assert "slave 1002 does not speak" in client.why
        assert (await client.do(MUTE, Read(0x1234, 0, 4))).result == AdsError.INDEX_GROUP

    play(scene, "aoe")


def test_slave_without_a_mailbox_in_its_state():
    async def scene(client, engine):
        await client.good(DRIVE, WriteControl(AdsState.INIT, 0, b""))

        async def is_there():
            return (await client.good(DRIVE, ReadState()))[2] == 1

        await until(is_there)
        outcome = await client.do(DRIVE, Read(IndexGroup.SDO, 0x1018_0001, 4))
        assert outcome.result == AdsError.STATE
        assert client.why == "slave 1001 (drive) has no mailbox in INIT"

    play(scene)


def test_slave_that_is_gone():
    async def scene(client, engine):
        with engine.buses[0].line.lost("other"):

            async def is_gone():
                return (await client.good(OTHER, ReadState())) == bytes(4)

            await until(is_gone)
            outcome = await client.do(OTHER, Read(IndexGroup.SDO, 0x1018_0001, 4))
            assert outcome.result == AdsError.TIMEOUT
            assert client.why == "slave 1002 does not answer"

    play(scene, "files")


def test_there_are_no_notifications():
    async def scene(client, engine):
        asked = AddNotification(IndexGroup.SDO, 0x1018_0001, 4, TransMode.SERVER_CYCLE, 0, 0)
        assert (await client.do(DRIVE, asked)).result == AdsError.SERVICE
        assert "no notifications" in client.why

    play(scene)


def test_groups_are_passed_to_a_slave_that_speaks_aoe():
    async def scene(client, engine):
        assert await client.read(TALKER, IndexGroup.SDO, 0x8002_0000) == b"\7\0\0\0"
        await client.good(TALKER, Write(IndexGroup.SDO, 0x8002_0000, b"\x08\0\0\0"))
        both = ReadWrite(IndexGroup.SDO, 0x8002_0000, 4, b"\x09\0\0\0")
        assert await client.good(TALKER, both) == b"\x09\0\0\0"

    play(scene, "aoe")
