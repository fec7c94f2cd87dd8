"""The object dictionary of a router."""

from __future__ import annotations

import pytest

from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import RouterDictionary
from eap.ids import InterfaceUri, NetId
from eap.od import info
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.router9000 import RouterLive
from eap.pd.spec import PortKind, PortSpec, StationSpec
from tests.support.routervalues import MAC, Values

STATION = StationSpec(
    "tower",
    NetId.parse("1.2.3.4.1.1"),
    10_000,
    (
        PortSpec(
            "eap0", PortKind.EAP, InterfaceUri.parse("udp://10.0.0.7"), NetId.parse("1.2.3.4.2.1")
        ),
        PortSpec(
            "eap1", PortKind.EAP, InterfaceUri.parse("ethernet://eth1"), NetId.parse("1.2.3.4.2.2")
        ),
        PortSpec(
            "bus0", PortKind.BUS, InterfaceUri.parse("sim://bus.yaml"), NetId.parse("1.2.3.4.3.1")
        ),
    ),
)


def route(name):
    return {
        RouterLive.ROUTE_NET_ID: NetId.parse("5.6.7.8.1.1"),
        RouterLive.ROUTE_OCTETS: 4,
        RouterLive.ROUTE_NAME: name,
        RouterLive.ROUTE_TRANSPORT: "udp:eap0",
        RouterLive.ROUTE_ADDRESS: "10.0.0.8:34980",
        RouterLive.ROUTE_ORIGIN: 1,
        RouterLive.ROUTE_STATE: 2,
        RouterLive.ROUTE_ROUND_TRIP: 1 << 40,
        RouterLive.ROUTE_REQUESTS: 5,
        RouterLive.ROUTE_ERRORS: 3,
        RouterLive.ROUTE_LAST_ERROR: "no answer",
    }


@pytest.fixture
def values():
    return Values()


@pytest.fixture
def dictionary(values):
    identity = DeviceIdentity(device_name="EAP station tower", software_version="1.2")
    return RouterDictionary(STATION, values, identity)


def plain(dictionary, index):
    return {sub: entry.value for sub, entry in dictionary[index].entries.items()}


def test_dictionary_shows_identity(dictionary):
    assert dictionary.upload(0x1000, 0, OdState.OP) == (9000 << 16 | 5001).to_bytes(4, "little")
    assert dictionary.upload(0x1008, 0, OdState.OP) == b"EAP station tower"
    assert plain(dictionary, 0xF920) == {0: 1, 1: NetId.parse("1.2.3.4.1.1")}
    assert plain(dictionary, 0xF000) == {0: 2, 1: 1, 2: 254}


def test_ports_are_its_devices(dictionary):
    assert plain(dictionary, 0xF010) == {0: 3, 1: 1000, 2: 1000, 3: 1100}
    first = plain(dictionary, 0x8000)
    assert first == {
        0: 7,
        1: NetId.parse("1.2.3.4.2.1"),
        2: 1000,
        3: "udp://10.0.0.7",
        4: bytes(6),
        5: bytes([10, 0, 0, 7]),
        6: 8,
        7: "eap0",
    }
    assert (plain(dictionary, 0x8001)[4], plain(dictionary, 0x8001)[6]) == (MAC, 4)
    assert [plain(dictionary, 0x8002)[sub] for sub in (2, 5, 6)] == [1100, bytes(4), 2]
    assert [dictionary.name_of(index) for index in (0x8002, 0xF000)] == ["bus0", ""]
    assert 0x8003 not in dictionary


def test_figures_are_those_of_the_router(dictionary):
    shown = plain(dictionary, 0xF110)
    assert shown[1] == list(RouterLive).index(RouterLive.ANSWERED)
    assert shown[10] == list(RouterLive).index(RouterLive.SUBSCRIPTIONS)
    assert plain(dictionary, 0xF100)[1] == list(RouterLive).index(RouterLive.STATE)


def test_routes_come_and_go(dictionary, values):
    before = len(dictionary)
    assert 0x9000 not in dictionary
    with pytest.raises(SdoAbortError) as refused:
        dictionary.upload(0x9000, 1, OdState.OP)
    assert refused.value.code == AbortCode.NO_OBJECT
    values.all = [route("a"), route("b" * 300)]
    assert len(dictionary) == before + 2 == len(list(dictionary))
    assert [each.index for each in dictionary if each.index >> 12 == 9] == [0x9000, 0x9001]
    assert plain(dictionary, 0x9000) == {
        0: 11,
        **dict(enumerate(route("a").values(), start=1)),
        8: 0xFFFFFFFF,
    }
    assert dictionary.name_of(0x9000) == "a"
    assert dictionary.upload(0x9001, 3, OdState.OP) == b"b" * 255
    assert info.object_description(dictionary, 0x9001).endswith(b"Route 1")
    values.all = []
    assert 0x9000 not in dictionary
    assert dictionary.name_of(0x8000) == "eap0"


def test_nothing_can_be_written(dictionary):
    for item in dictionary:
        for subindex, entry in item.entries.items():
            with pytest.raises(SdoAbortError) as refused:
                dictionary.download(item.index, subindex, entry.octets, OdState.PREOP)
            assert refused.value.code == AbortCode.READ_ONLY


def test_whole_objects_are_read(dictionary):
    octets = dictionary.upload_complete(0x8000, 0, OdState.OP)
    assert octets[:2] == b"\7\0"
    assert octets[2:10] == bytes(NetId.parse("1.2.3.4.2.1")) + (1000).to_bytes(2, "little")
