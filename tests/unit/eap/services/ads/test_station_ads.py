"""All ADS services of a station together, at its router."""

from __future__ import annotations

import asyncio
import struct
from time import monotonic_ns

import pytest

from eap.ams.transport_table import Transport
from eap.codec.ads import IndexGroup as G
from eap.codec.adsnotification import TransMode, decode_notification
from eap.codec.ams import AmsCommand
from eap.device.eap_dictionary import DeviceIdentity
from eap.pd.image import Inputs, Sampler
from eap.pd.words import StationWord
from eap.services.ads.station_ads import StationAds
from eap.services.routing.station_router import StationRouter
from tests.support import aoe
from tests.support.eventually import eventually
from tests.support.routing import RecordingSender
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual

CONNECTION = "127.0.0.1:9 #1"


@pytest.fixture
def sender():
    return RecordingSender()


@pytest.fixture
def router(stations, sender):
    station = stations[0]
    net_ids = [port.net_id for port in station.ports]
    router = StationRouter(station.name, station.net_id, net_ids)
    router.add_transport(Transport("ams-tcp", is_stream=True), sender)
    return router


@pytest.fixture
def ads(stations, images, router):
    device, _ = make_device(stations[0])
    return StationAds(stations[0], device, images["left"], router, DeviceIdentity())


def ask(router, sender, target, command, body=b"", *, port=0xFFFF):
    before = len(sender.sent)
    packet = aoe.packet(target, command, body, port=port)
    router.receive(packet, "ams-tcp", CONNECTION)
    ((_, answer),) = sender.sent[before:]
    assert not answer.error
    return answer.body


@pytest.mark.usefixtures("ads")
def test_every_net_id_of_its_own_answers(router, sender, stations):
    station = stations[0]
    for net_id, port, name in (
        (station.net_id, 0xFFFF, b"left"),
        (station.net_id, 10_000, b"left"),
        (station.net_id, 300, b"left"),
        (station.ports[0].net_id, 10_000, b"left"),
        (station.ports[0].net_id, 0xFFFF, b"left/eap0"),
    ):
        info = ask(router, sender, str(net_id), AmsCommand.READ_DEVICE_INFO, port=port)
        assert info[8:] == name.ljust(16, b"\0")


def test_notifications_leave_by_the_router(ads, router, sender, stations, files):
    target = str(stations[0].ports[0].net_id)
    image = files["left"].image
    sampler = Sampler(image, Inputs(image).memory)

    async def run():
        serving = asyncio.ensure_future(ads.serve())
        await asyncio.sleep(0)
        name = b"ticks\0"
        asked = struct.pack("<4I", G.SYMBOL_HANDLE, 0, 4, len(name)) + name
        handle = int.from_bytes(ask(router, sender, target, 9, asked)[8:], "little")
        watch = struct.pack("<6I16x", G.VALUE_BY_HANDLE, handle, 2, TransMode.SERVER_CYCLE, 0, 0)
        added = ask(router, sender, target, AmsCommand.ADD_NOTIFICATION, watch)
        await asyncio.sleep(0)
        image.words[StationWord.CYCLE] = 1
        ran_ns = monotonic_ns()
        image.words[StationWord.CYCLE_AT_NS] = ran_ns
        sampler.end_cycle(1, ran_ns)
        count = len(sender.sent)
        await eventually(lambda: len(sender.sent) != count)
        serving.cancel()
        return added, sender.sent[-1]

    added, (connection, told) = run_virtual(run())
    assert (connection, told.command) == (CONNECTION, AmsCommand.NOTIFICATION)
    assert told.source == f"{target}:65535"
    ((sample,),) = [stamp.samples for stamp in decode_notification(told.body)]
    assert sample == (int.from_bytes(added[4:], "little"), bytes(2))
    router.connection_closed("ams-tcp", CONNECTION)
    assert ads.pump.advance(monotonic_ns(), 0) is None
