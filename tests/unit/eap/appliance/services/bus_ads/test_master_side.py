"""A master as ADS shows it."""

from __future__ import annotations

import logging

from eap.aoe.ads_master import SlaveState
from eap.appliance.bus_request import Bring, Cancel, SlaveDescription
from eap.appliance.services.bus_ads.master_side import MasterSide
from eap.appliance.services.slaves.bus_view import BusDescription
from eap.codec.ads import AdsState, AdsStates
from tests.support.busads import play, until
from tests.support.fakeengine import PORT


def slave(station: int, state: int, fault: str = "") -> SlaveDescription:
    return SlaveDescription(
        station=station, name="s", vendor=1, product=2, revision=3, serial=4, alias=0,
        state=state, target=8, fault=fault,
    )  # fmt: skip


def bus(*slaves: SlaveDescription) -> BusDescription:
    return BusDescription(is_up=True, fault="", slaves={each.station: each for each in slaves})


def test_states():
    async def scene(client, engine):
        side = MasterSide(client.bus, PORT)
        assert side.state() == 1
        view = client.bus.views[PORT]
        view.latest = bus(slave(1001, 8), slave(1002, 4, "AL status"))
        assert side.state() == 8
        assert side.states() == AdsStates(AdsState.RUN, 8)
        assert side.slaves() == [SlaveState(1001, 8, 0), SlaveState(1002, 0x14, 0)]
        view.latest = bus(slave(1001, 0, "it does not answer"))
        assert side.state() == 1
        assert side.slaves() == [SlaveState(1001, 0x10, 1)]
        view.latest = bus(slave(1001, 8))._replace(is_up=False)
        assert side.state() == 1

    play(scene)


def test_last_request_counts():
    async def scene(client, engine):
        side = MasterSide(client.bus, PORT)
        engine.holds = True
        engine.held_kind = Bring
        side.request_slave_state(1001, 1)
        side.request_state(1)

        async def has(count):
            return len(engine.of(Bring)) == count

        await until(lambda: has(2))
        side.request_slave_state(1001, 8)
        await until(lambda: has(3))
        found = [(each.station, each.target) for each in engine.of(Bring)]
        assert found == [(1001, 1), (0, 1), (1001, 8)]
        assert len(engine.of(Cancel)) == 1

    play(scene)


def test_what_fails_is_told_in_the_log(caplog):
    caplog.set_level(logging.WARNING)

    async def scene(client, engine):
        side = MasterSide(client.bus, PORT)
        side.request_slave_state(1077, 2)

        async def is_told():
            return bool(caplog.records)

        await until(is_told)

    play(scene)
    assert "left/bus0: slave 1077 to PREOP by ADS: " in caplog.text
