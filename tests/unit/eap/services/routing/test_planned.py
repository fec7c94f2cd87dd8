"""Routes and access of a plant file, for a router."""

from __future__ import annotations

import pytest

from eap.ads.endpoint import Endpoint
from eap.ams.routes import Origin, Route
from eap.ams.spec import AccessRule, HopSpec, MqttSpec, RouteSpec, RoutingSpec, TransportKind
from eap.ids import NetId
from eap.services.routing import station_routes
from eap.services.routing.station_routes import access_of, make_router, to_endpoint, to_route
from tests.unit.eap.conftest import eap_port, left

UDP = HopSpec(TransportKind.UDP, "eap0", "127.0.1.2:34980")
WAY = Endpoint("udp:eap0", "127.0.1.2:34980")
THERE = NetId.parse("5.1.2.3.1.1")


def test_route_has_all_of_its_specification():
    spec = RouteSpec(name="plc", net_id=str(THERE), hop=UDP, timeout_ms=700, router="7.7.7.7.1.1")
    assert to_route(spec, WAY, Origin.ADDED) == Route(
        THERE,
        "plc",
        WAY,
        Origin.ADDED,
        timeout_ns=700_000_000,
        router=NetId.parse("7.7.7.7.1.1"),
    )


def test_virtual_net_id_is_the_one_that_is_known_here():
    spec = RouteSpec(name="plc", net_id=str(THERE), hop=UDP, virtual="6.6.6.6.1.1")
    route = to_route(spec, WAY, Origin.STATIC)
    assert (str(route.net_id), route.real) == ("6.6.6.6.1.1", THERE)


@pytest.mark.parametrize(
    ("hop", "endpoint"),
    [
        (UDP, Endpoint("udp:eap0", "127.0.1.2:34980")),
        (HopSpec(TransportKind.ETHERNET, "eap1", "1.2.3.4.5.6"),
         Endpoint("ethernet:eap1", "1.2.3.4.5.6")),
        (HopSpec(TransportKind.AMS_TCP, "", "10.0.0.5:48898"),
         Endpoint("ams-tcp:10.0.0.5:48898", "10.0.0.5:48898")),
        (HopSpec(TransportKind.MQTT, "line", "1.2.3.4.5.6"), Endpoint("mqtt:line", "1.2.3.4.5.6")),
    ],
)  # fmt: skip
def test_hops(hop, endpoint):
    assert to_endpoint(hop) == endpoint


@pytest.mark.parametrize(
    ("kind", "text", "address"),
    [
        (TransportKind.UDP, "10.0.0.5", "10.0.0.5:34980"),
        (TransportKind.TCP, "10.0.0.5:7", "10.0.0.5:7"),
        (TransportKind.ETHERNET, "02-00-00-00-0A-01", "02:00:00:00:0a:01"),
    ],
)
def test_to_endpoint_normalizes_addresses(kind, text, address):
    assert to_endpoint(HopSpec(kind, "eap0", text)).connection == address


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        (TransportKind.UDP, "mill"),
        (TransportKind.UDP, "10.0.0.5:0x10"),
        (TransportKind.TCP, "02:00:00:00:00:01"),
        (TransportKind.UDP, "239.1.1.1"),
        (TransportKind.ETHERNET, "10.0.0.5"),
        (TransportKind.ETHERNET, "01:01:05:04:00:00"),
    ],
)
def test_to_endpoint_rejects_invalid_addresses(kind, text):
    with pytest.raises(ValueError, match=r"10\.0|0x10|mill|239|01:01|02:00"):
        to_endpoint(HopSpec(kind, "eap0", text))


def test_addresses_of_the_station_are_this_host():
    station = left(eap_port(1, interface="udp://10.0.0.1"))
    access = access_of(station, RoutingSpec(access=(AccessRule("no", allow=False),)))
    assert access.is_this_host(Endpoint("ams-tcp", "10.0.0.1:4711#1"))
    assert not access.is_this_host(Endpoint("ams-tcp", "10.0.0.2:4711#1"))
    endpoint = Endpoint("ams-tcp", "10.0.0.2:4711#1")
    assert not access.grants(endpoint, THERE, THERE, 1).may_read


def test_unidirectional_network_is_denied_before_other_rules():
    brokers = (
        MqttSpec(network="hall", host="b", is_unidirectional=True),
        MqttSpec(network="line", host="b"),
    )
    access = access_of(left(), RoutingSpec(mqtt=brokers, access=(AccessRule("all"),)))
    granted = [access.grants(Endpoint(transport, "5.1.2.3.1.1"), THERE, THERE, 1).may_read
               for transport in ("mqtt:hall", "mqtt:line")]  # fmt: skip
    assert granted == [False, True]


def test_router_knows_its_net_ids():
    router = make_router(left(), RoutingSpec())
    assert {str(each) for each in router.net_ids} == {"1.1.1.1.1.1", "1.2.3.4.5.1"}


def test_all_addresses_of_the_machine_are_those_of_a_port_at_any(monkeypatch):
    monkeypatch.setattr(station_routes, "own_addresses", lambda: [("eth7", "10.0.0.7")])
    access = access_of(left(eap_port(1, interface="udp://0.0.0.0")), RoutingSpec())
    assert access.is_this_host(Endpoint("ams-tcp", "10.0.0.7:4711#1"))
    assert not access.is_this_host(Endpoint("ams-tcp", "10.0.0.8:4711#1"))
