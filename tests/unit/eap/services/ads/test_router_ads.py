"""ADS at the NetID of a station."""

from __future__ import annotations

import struct

import pytest
from msgspec.structs import replace

from eap.codec.ads import AdsError, AdsState
from eap.codec.ads import IndexGroup as G
from eap.codec.ams import AmsAnswer, AmsCommand, AmsHeader
from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import RouterDictionary
from eap.ids import Endpoint, InterfaceUri, NetId
from eap.pd.device import DeviceState
from eap.pd.spec import PortKind, PortSpec
from eap.services.ads.ads_service import device_info
from eap.services.ads.station_ads import LiveRouter, RouterAds
from eap.services.routing.service import LocalRequest
from eap.services.routing.station_router import StationRouter
from tests.support import aoe
from tests.support.stationengine import make_device
from tests.support.virtualtime import run_virtual

IO, DEVICE = 300, 0xFFFF
WAY = Endpoint("ams-tcp", "1")
CLIENT = NetId.parse("1.2.3.4.1.1")
OK = bytes(4)


class Bench:
    """A router of a station with an EAP port and a bus."""

    def __init__(self, spec, image) -> None:
        bus = PortSpec(
            "bus0", PortKind.BUS, InterfaceUri.parse("sim://bus.yaml"), NetId.parse("1.2.3.4.7.1")
        )
        self.device, self.engine = make_device(spec)
        spec = replace(spec, ports=(*spec.ports, bus))
        router = StationRouter("left", spec.net_id)
        values = LiveRouter(router, self.device, image, spec.ports)
        dictionary = RouterDictionary(spec, values, DeviceIdentity())
        self.ads = RouterAds(spec, self.device, dictionary, device_info("left", "1.2.3"))

    def ask(self, port, command, body=b""):
        header = AmsHeader(CLIENT, port, CLIENT, 1, command)
        answer = self.ads.answer(LocalRequest(header, body, WAY))
        if isinstance(answer, AmsAnswer):
            return answer
        return run_virtual(answer)

    def read(self, port, group, offset):
        answer = self.ask(port, AmsCommand.READ, aoe.read_body(offset, group=group))
        result = int.from_bytes(answer.data[:4], "little")
        return answer.data[8:] if not result else AdsError(result)

    def control(self, port, ads_state):
        body = struct.pack("<HHI", ads_state, 0, 0)
        return int.from_bytes(self.ask(port, AmsCommand.WRITE_CONTROL, body).data, "little")


@pytest.fixture
def bench(stations, images):
    return Bench(stations[0], images["left"])


def test_it_has_the_ports_of_a_router(bench):
    assert bench.ads.ports == {IO, DEVICE}


@pytest.mark.parametrize("port", [IO, DEVICE])
def test_router_services_report_info_and_state(bench, port):
    info = bench.ask(port, AmsCommand.READ_DEVICE_INFO).data
    assert info == OK + b"\1\2\3\0" + b"left".ljust(16, b"\0")
    assert bench.ask(port, AmsCommand.READ_STATE).data == OK + b"\5\0\x08\0"
    assert bench.read(port, G.RAW_COMMAND, 0) is AdsError.INDEX_GROUP


def test_ports_are_the_devices_of_the_io_server(bench):
    assert bench.read(IO, 0x5000, 2) == b"\2\0\0\0"
    assert bench.read(IO, 0x5000, 1) == struct.pack("<3H", 2, 1, 2)
    assert bench.read(IO, 0x5002, 1) == b"bus0\0"
    assert [bench.read(IO, 0x5000 + n, 7) for n in (1, 2)] == [b"\x70\0", b"\x6f\0"]
    assert bench.read(IO, 0x5002, 5) == bytes(NetId.parse("1.2.3.4.7.1"))


def test_dictionary_is_that_of_a_router(bench):
    assert bench.read(DEVICE, G.SDO, 0x1000_0000) == (9000 << 16 | 5001).to_bytes(4, "little")
    assert bench.read(DEVICE, G.SDO, 0x8001_0007) == b"bus0"
    assert bench.read(DEVICE, G.SDO, 0x9000_0001) is AdsError.NOT_FOUND
    write = aoe.write_body(0xF000_0001, b"\1\0")
    refused = bench.ask(DEVICE, AmsCommand.WRITE, write)
    assert refused.data == AdsError.ACCESS.to_bytes(4, "little")
    assert "0xF000:01: write of a read-only entry (0x06010002)" in refused.why


def test_states_are_those_of_the_station(bench):
    assert bench.control(DEVICE, AdsState.CONFIG) == 0
    assert bench.engine.state is DeviceState.PREOP
    assert bench.ask(DEVICE, AmsCommand.READ_STATE).data == OK + b"\x0f\0\2\0"
    assert bench.control(DEVICE, AdsState.RUN) == 0
    assert bench.engine.state is DeviceState.OP
    assert bench.control(IO, AdsState.CONFIG) == AdsError.SERVICE


def test_router_answers_sum_commands(bench):
    items = struct.pack("<6I", G.SDO, 0x1000_0000, 4, G.SDO, 0x1234_0000, 4)
    body = struct.pack("<4I", G.SUM_READ, 2, 100, len(items)) + items
    header = AmsHeader(CLIENT, DEVICE, CLIENT, 1, AmsCommand.READ_WRITE)
    answer = run_virtual(bench.ads.answer(LocalRequest(header, body, WAY)))
    assert answer.data[8:16] == OK + AdsError.NOT_FOUND.to_bytes(4, "little")
    assert answer.why == "0x1234:00: object does not exist (0x06020000)"
