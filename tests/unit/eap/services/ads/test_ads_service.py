"""Common behaviour of the ADS services of a station."""

from __future__ import annotations

import struct

import pytest

from eap.ads.space import AdsSpace
from eap.codec.ads import AdsError, AdsState
from eap.codec.ads import IndexGroup as G
from eap.codec.adsnotification import TransMode
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId
from eap.pd.device import DeviceState
from eap.services.ads.ads_service import AdsService, device_info
from eap.services.routing.service import LocalRequest
from tests.support import aoe
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual

ONE, OTHER = 300, 301
WAY, OTHER_WAY = Endpoint("ams-tcp", "1"), Endpoint("ams-tcp", "2")
CLIENT = NetId.parse("1.2.3.4.1.1")
OK = bytes(4)


class Echo(AdsSpace):
    """One index group, whose data is a constant."""

    def __init__(self, group: int) -> None:
        self.groups = {group}

    def read(self, group, offset, length):
        return b"%d" % group


class Bench:
    """A service with two ports, which have an index group each."""

    def __init__(self, spec) -> None:
        self.device, self.engine = make_device(spec)
        spaces = {ONE: [Echo(1)], OTHER: [Echo(2)]}
        self.service = AdsService(self.device, device_info("left", "1.2.3"), spaces)

    def ask(self, port, command, body=b"", endpoint=WAY):
        header = AmsHeader(CLIENT, port, CLIENT, 1, command)
        answer = self.service.answer(LocalRequest(header, body, endpoint))
        if isinstance(answer, AmsAnswer):
            return answer.data
        return run_virtual(answer).data

    def watchers(self):
        return [len(self.service.notifications[port]) for port in (ONE, OTHER)]


@pytest.fixture
def bench(stations):
    return Bench(stations[0])


def test_each_port_has_its_own_index_groups(bench):
    assert bench.service.ports == {ONE, OTHER}
    for port, group in ((ONE, 1), (OTHER, 2)):
        answer = bench.ask(port, AmsCommand.READ, aoe.read_body(0, group=group))
        assert answer == OK + b"\1\0\0\0%d" % group
        other = bench.ask(port, AmsCommand.READ, aoe.read_body(0, group=3 - group))
        assert other[:4] == AdsError.INDEX_GROUP.to_bytes(4, "little")


def test_states_are_those_of_the_station(bench):
    config = struct.pack("<HHI", AdsState.CONFIG, 0, 0)
    assert bench.ask(ONE, AmsCommand.WRITE_CONTROL, config) == OK
    assert bench.engine.state is DeviceState.PREOP
    assert bench.ask(OTHER, AmsCommand.READ_STATE) == OK + b"\x0f\0\2\0"


def test_notifications_end_with_their_connection(bench):
    watched = struct.pack("<6I16x", G.DEVICE_DATA, 0, 4, TransMode.SERVER_CYCLE, 0, 0)
    for port, endpoint in ((ONE, WAY), (OTHER, WAY), (OTHER, OTHER_WAY)):
        assert bench.ask(port, AmsCommand.ADD_NOTIFICATION, watched, endpoint)[:4] == OK
    assert bench.watchers() == [1, 2]
    bench.service.client_gone(WAY)
    assert bench.watchers() == [0, 1]
    bench.service.client_gone(OTHER_WAY)
    assert bench.watchers() == [0, 0]
