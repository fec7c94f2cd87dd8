"""The system service of a station."""

from __future__ import annotations

import struct

import pytest

from eap.codec.ads import AdsError, AdsState
from eap.codec.ads import IndexGroup as G
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader
from eap.ids import Endpoint, NetId
from eap.pd.device import DeviceState
from eap.services.ads.ads_service import device_info
from eap.services.ads.station_ads import SystemAds
from eap.services.routing.service import LocalRequest
from tests.support import aoe
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual

WAY = Endpoint("ams-tcp", "1")
HERE = NetId.parse("1.2.3.4.1.1")
OK = bytes(4)


@pytest.fixture
def device(stations):
    return make_device(stations[0])


@pytest.fixture
def system(device):
    return SystemAds(device[0], device_info("left", "1.2.3"))


@pytest.fixture
def ask(system, device):
    def ask(command, body=b""):
        header = AmsHeader(HERE, 10_000, HERE, 1, command)
        answer = system.answer(LocalRequest(header, body, WAY))
        if isinstance(answer, AmsAnswer):
            return answer.data
        return run_virtual(answer).data

    return ask


def test_system_service_reports_info_and_state(system, ask):
    assert system.ports == {10_000}
    assert ask(AmsCommand.READ_DEVICE_INFO) == OK + b"\1\2\3\0" + b"left".ljust(16, b"\0")
    assert ask(AmsCommand.READ_STATE) == OK + b"\5\0\x08\0"
    state = ask(AmsCommand.READ, aoe.read_body(0, 16, group=G.SYSTEM_STATE))
    ads_state, device_state, restart_index, *version = struct.unpack("<HHHBBH", state[8:18])
    assert (ads_state, device_state, version) == (AdsState.RUN, 8, [1, 2, 3])
    assert restart_index  # another one at each start
    unknown = ask(AmsCommand.READ, aoe.read_body(0, group=G.SDO))
    assert unknown[:4] == AdsError.INDEX_GROUP.to_bytes(4, "little")


def test_states_are_those_of_the_station(ask, device):
    assert ask(AmsCommand.WRITE_CONTROL, struct.pack("<HHI", AdsState.CONFIG, 0, 0)) == OK
    assert device[1].state is DeviceState.PREOP
    assert ask(AmsCommand.READ_STATE) == OK + b"\x0f\0\2\0"


def test_system_service_reset_means_run(ask, device):
    assert ask(AmsCommand.WRITE_CONTROL, struct.pack("<HHI", AdsState.CONFIG, 0, 0)) == OK
    assert ask(AmsCommand.WRITE_CONTROL, struct.pack("<HHI", AdsState.RESET, 0, 0)) == OK
    assert device[1].state is DeviceState.OP
