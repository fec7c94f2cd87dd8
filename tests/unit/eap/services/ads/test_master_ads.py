"""The master of a bus as an ADS device: states, notifications, EtherCAT commands."""

from __future__ import annotations

import logging

import pytest

from devicebus.wire.datagram import Command, DatagramReply, DatagramRequest, brd
from eap.ads.io import SlaveState
from eap.ads.request import AdsRefusedError, DeleteNotification, WriteControl
from eap.codec.ads import AdsError, AdsState, AdsStates, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode, decode_notification
from eap.codec.ams import AmsCommand, decode_packet
from eap.runtime.engine_messages import BringSlaves, Cancel, Ping, SlaveDescription
from eap.services.ads import master_ads
from eap.services.ads.master_ads import MasterStates, RawCommands, StateRequests
from eap.services.slaves.bus_client import BusDescription
from tests.support.busads import BUS, DRIVE, MASTER, play, until
from tests.support.eventually import elapse, settle

STATE = AddNotification(IndexGroup.SLAVE_STATES, DRIVE, 2, TransMode.SERVER_ON_CHANGE, 0, 0)
CYCLIC = AddNotification(IndexGroup.SLAVE_STATES, DRIVE, 2, TransMode.SERVER_CYCLE, 0, 0)
COUNT = bytes.fromhex("01ff 0000 0000 0400 0000 00000000 0000")
WRITE = bytes.fromhex("0507 e903 2001 0200 0000 0800 0000")


def states_of(client) -> MasterStates:
    return MasterStates(client.bus.view, StateRequests(client.bus))


def slave(station: int, state: int, fault: str = "") -> SlaveDescription:
    return SlaveDescription(
        station=station, name="s", vendor=1, product=2, revision=3, serial=4, alias=0,
        state=state, target=8, fault=fault,
    )  # fmt: skip


def bus(*slaves: SlaveDescription) -> BusDescription:
    return BusDescription(is_up=True, fault="", slaves={each.station: each for each in slaves})


def test_master_state_is_the_highest_of_its_slaves():
    async def scene(client, engine):
        states = states_of(client)
        assert states.state() == 1
        view = client.bus.view
        view.latest = bus(slave(1001, 8), slave(1002, 4, "AL status"))
        assert states.state() == 8
        assert states.states() == AdsStates(AdsState.RUN, 8)
        assert states.slaves() == [SlaveState(1001, 8, 0), SlaveState(1002, 0x14, 0)]
        view.latest = bus(slave(1001, 0, "it does not answer"))
        assert states.state() == 1
        assert states.slaves() == [SlaveState(1001, 0x10, 1)]
        view.latest = bus(slave(1001, 8))._replace(is_up=False)
        assert states.state() == 1

    play(scene)


def test_state_request_replaces_the_one_before():
    async def scene(client, engine):
        states = states_of(client)
        engine.holds = True
        engine.held_kind = BringSlaves
        states.request_slave_state(1001, 1)
        states.request_state(1)

        async def has(count):
            return len(engine.of(BringSlaves)) == count

        await until(lambda: has(2))
        states.request_slave_state(1001, 8)
        await until(lambda: has(3))
        found = [(each.station, each.target) for each in engine.of(BringSlaves)]
        assert found == [(1001, 1), (0, 1), (1001, 8)]
        assert len(engine.of(Cancel)) == 1

    play(scene)


def test_state_request_that_fails_is_logged(caplog):
    caplog.set_level(logging.WARNING)

    async def scene(client, engine):
        states = states_of(client)
        states.request_slave_state(1077, 2)

        async def is_told():
            return bool(caplog.records)

        await until(is_told)

    play(scene)
    assert "left/bus0: slave 1077 to PREOP by ADS: " in caplog.text


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    monkeypatch.setattr(master_ads, "POLL_S", 0.001)


def samples(client) -> list[tuple[int, bytes]]:
    found = []
    for endpoint, packet in client.told:
        header, body = decode_packet(packet)
        assert endpoint == client.endpoint
        assert (header.source, header.source_port) == (BUS, MASTER)
        assert header.command == AmsCommand.NOTIFICATION
        for stamp in decode_notification(bytes(body)):
            found += [(each.handle, bytes(each.data)) for each in stamp.samples]
    return found


def test_notification_sends_each_state_of_a_slave_until_it_is_deleted():
    async def scene(client, engine):
        handle = int.from_bytes(await client.good(MASTER, STATE), "little")

        async def has(*states):
            return samples(client) == [(handle, bytes((each, 0))) for each in states]

        await until(lambda: has(2))
        await client.good(DRIVE, WriteControl(AdsState.INIT, 0, b""))
        await until(lambda: has(2, 1))
        await client.good(MASTER, DeleteNotification(handle))
        await settle()
        looks = len(engine.of(Ping))
        await elapse(1)
        assert len(engine.of(Ping)) == looks

    play(scene)


def test_notification_ends_with_its_connection():
    async def scene(client, engine):
        await client.good(MASTER, CYCLIC)
        client.service.client_gone(client.endpoint)
        await elapse(1)
        assert not client.told

    play(scene)


def test_notification_waits_for_an_engine_that_is_gone():
    async def scene(client, engine):
        await client.good(MASTER, STATE)
        engine.holds = True
        await elapse(0.2)
        assert not client.told
        engine.release()

        async def is_told():
            return len(samples(client)) == 1

        await until(is_told)

    play(scene)


def test_raw_commands_are_answered_with_their_working_counters():
    commands = RawCommands(COUNT + WRITE)
    assert commands.accesses() == [
        brd(0, 1),
        DatagramRequest(Command.APRD, 0, 0, bytes(4), 1),
        DatagramRequest(Command.FPWR, 1001, 0x120, b"\x08\0", 1),
    ]
    replies = [
        DatagramReply(b"\0", 3),
        DatagramReply(b"\x11\0\2\0", 1),
        DatagramReply(b"\x08\0", 1),
    ]
    assert commands.encode_answer(replies) == (
        bytes.fromhex("01ff 0300 0000 0400 0000 11000200 0100")
        + bytes.fromhex("0507 e903 2001 0200 0000 0800 0100")
    )


def test_raw_command_position_counts_past_zero():
    last = RawCommands(COUNT[:2] + b"\xfe\xff" + COUNT[4:])
    assert last.encode_answer([DatagramReply(b"\0", 3), DatagramReply(bytes(4), 1)])[2:4] == b"\1\0"


@pytest.mark.parametrize(
    ("data", "result"),
    [
        (b"", AdsError.SIZE),
        (COUNT[:9], AdsError.SIZE),
        (COUNT[:-1], AdsError.SIZE),
        (COUNT + b"\1", AdsError.SIZE),
        (b"\x63" + COUNT[1:], AdsError.VALUE),
    ],
)
def test_raw_commands_that_are_malformed_are_refused(data, result):
    with pytest.raises(AdsRefusedError) as refused:
        RawCommands(data)
    assert refused.value.result == result
