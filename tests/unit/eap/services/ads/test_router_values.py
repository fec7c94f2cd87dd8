"""Values of a router's dictionary."""

from __future__ import annotations

from time import monotonic_ns

import pytest
from msgspec.structs import replace

from eap.ams.routes import Origin, Route
from eap.ams.transport_table import Transport
from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import RouterDictionary
from eap.ids import Endpoint, InterfaceUri, NetId
from eap.net.image_file import create_image
from eap.od.profiles.router9000 import RouterLive
from eap.pd.layout import plan_layout
from eap.pd.spec import PortKind, PortSpec, VariableSpec, Writer
from eap.services.ads.station_ads import LiveRouter
from eap.services.routing.station_router import StationRouter
from tests.support.routing import RecordingSender
from tests.support.stationengine import make_device

ROUTE = Route(
    NetId.parse("5.6.7.8.1.1"), "plc", Endpoint("udp:eap0", "10.0.0.8:34980"), Origin.ADDED
)


@pytest.fixture
def station(stations):
    """A station with a bus, and with a port on an interface that every host has."""
    ports = (
        *stations[0].ports,
        PortSpec(
            "eap1", PortKind.EAP, InterfaceUri.parse("ethernet://lo"), NetId.parse("1.2.3.4.6.1")
        ),
        PortSpec(
            "bus0", PortKind.BUS, InterfaceUri.parse("sim://bus.yaml"), NetId.parse("1.2.3.4.7.1")
        ),
        PortSpec(
            "bus1", PortKind.BUS, InterfaceUri.parse("sim://bus.yaml"), NetId.parse("1.2.3.4.7.2")
        ),
        PortSpec(
            "eap2", PortKind.EAP, InterfaceUri.parse("ethernet://none0"), NetId.parse("1.2.3.4.6.2")
        ),
    )
    more = VariableSpec("bus0.state", "USINT", Writer.ENGINE)
    return replace(stations[0], ports=ports, variables=(*stations[0].variables, more))


@pytest.fixture
def router(station):
    router = StationRouter("left", station.net_id)
    router.add_transport(Transport("udp:eap0"), RecordingSender())
    router.add_route(ROUTE)
    return router


@pytest.fixture
def values(station, stations, router, images, files):
    device, _ = make_device(stations[0])
    with create_image(files["left"].path, plan_layout(station)) as fresh:
        with fresh.image.writing(Writer.ENGINE):
            fresh.image.write("bus0.state", 2)
        yield LiveRouter(router, device, images["left"], station.ports)


def test_states_of_ports(values):
    ports = ("eap0", "eap1", "bus0", "bus1")
    assert [values.state_of(port) for port in ports] == [8, 8, 2, 0]
    assert values.number(RouterLive.STATE) == 8


def test_interfaces_have_addresses_or_none(values):
    assert [values.mac_of(port) for port in ("eap0", "eap1", "eap2", "bus0")] == [bytes(6)] * 4


def test_live_router_reads_the_mac_address(values, tmp_path, monkeypatch):
    (tmp_path / "lo").mkdir()
    (tmp_path / "lo" / "address").write_text("02:00:00:00:00:05\n")
    monkeypatch.setattr("eap.services.ads.station_ads._INTERFACES", tmp_path)
    assert values.mac_of("eap1") == bytes.fromhex("020000000005")


def test_every_live_entry_has_a_value(station, values):
    dictionary = RouterDictionary(station, values, DeviceIdentity())
    for item in dictionary:
        for entry in item.entries.values():
            assert len(entry.octets) == entry.kind.size or entry.is_text
    assert dictionary[0xF110].entries[8].value == 1


def test_live_router_reports_routes(router, values):
    (route,) = values.routes()
    shown = {
        key: values.of_route(key, route) for key in RouterLive if key.name.startswith("ROUTE_")
    }
    assert shown == {
        RouterLive.ROUTE_NET_ID: ROUTE.net_id,
        RouterLive.ROUTE_OCTETS: 4,
        RouterLive.ROUTE_NAME: "plc",
        RouterLive.ROUTE_TRANSPORT: "udp:eap0",
        RouterLive.ROUTE_ADDRESS: "10.0.0.8:34980",
        RouterLive.ROUTE_ORIGIN: 1,
        RouterLive.ROUTE_STATE: 0,
        RouterLive.ROUTE_ROUND_TRIP: 0,
        RouterLive.ROUTE_REQUESTS: 0,
        RouterLive.ROUTE_ERRORS: 0,
        RouterLive.ROUTE_LAST_ERROR: "",
    }
    assert values.routes() is values.routes()
    traffic = router.record.routes.of(route.key, monotonic_ns())
    traffic.add_request(40)
    traffic.add_answer(40, 2_000_000)
    keys = (RouterLive.ROUTE_STATE, RouterLive.ROUTE_ROUND_TRIP, RouterLive.ROUTE_REQUESTS)
    assert [values.of_route(key, route) for key in keys] == [1, 2000, 1]
    router.remove_route(ROUTE.net_id, ROUTE.hop)
    assert values.routes() == ()
