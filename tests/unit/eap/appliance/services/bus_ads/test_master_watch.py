"""Who watches a master is told of it."""

from __future__ import annotations

import asyncio

import pytest

from eap.aoe.ads_operation import DeleteNotification, WriteControl
from eap.appliance.bus_request import Ping
from eap.appliance.services.bus_ads import master_watch
from eap.codec.ads import AdsState, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode, decode_notification
from eap.codec.ams import AmsCommand, decode_packet
from tests.support.busads import BUS, DRIVE, MASTER, play, until

STATE = AddNotification(IndexGroup.SLAVE_STATES, DRIVE, 2, TransMode.SERVER_ON_CHANGE, 0, 0)

CYCLIC = AddNotification(IndexGroup.SLAVE_STATES, DRIVE, 2, TransMode.SERVER_CYCLE, 0, 0)


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    monkeypatch.setattr(master_watch, "LOOK_S", 0.001)


def samples(client) -> list[tuple[int, bytes]]:
    found = []
    for way, packet in client.told:
        header, body = decode_packet(packet)
        assert way == client.way
        assert (header.source, header.source_port) == (BUS, MASTER)
        assert header.command == AmsCommand.NOTIFICATION
        for stamp in decode_notification(bytes(body)):
            found += [(each.handle, bytes(each.data)) for each in stamp.samples]
    return found


def test_states_of_a_slave():
    async def scene(client, engine):
        handle = int.from_bytes(await client.good(MASTER, STATE), "little")

        async def has(*states):
            return samples(client) == [(handle, bytes((each, 0))) for each in states]

        await until(lambda: has(2))
        await client.good(DRIVE, WriteControl(AdsState.INIT, 0, b""))
        await until(lambda: has(2, 1))
        await client.good(MASTER, DeleteNotification(handle))
        await asyncio.sleep(0.01)
        looks = len(engine.of(Ping))
        await asyncio.sleep(0.02)
        assert len(engine.of(Ping)) == looks  # nobody looks when nobody wants to know

    play(scene)


def test_client_that_is_gone_is_told_nothing_more():
    async def scene(client, engine):
        await client.good(MASTER, CYCLIC)
        client.service.client_gone(client.way)
        await asyncio.sleep(0.02)
        assert not client.told

    play(scene)


def test_engine_that_is_gone_is_waited_for():
    async def scene(client, engine):
        await client.good(MASTER, STATE)
        engine.holds = True
        await asyncio.sleep(0.2)
        assert not client.told
        engine.release()

        async def is_told():
            return len(samples(client)) == 1

        await until(is_told)

    play(scene)
