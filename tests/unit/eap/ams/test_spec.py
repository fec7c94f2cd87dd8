"""Specification of a station's routing, and its differences."""

from __future__ import annotations

import msgspec
import pytest
from msgspec.structs import replace

from eap.ams.spec import (
    AccessRule,
    AccessService,
    AccessTarget,
    AmsUser,
    HopSpec,
    MqttSpec,
    ObjectRange,
    RouteSpec,
    RoutingSpec,
    TlsSpec,
    TransportKind,
    describe_routing,
)


def test_rules_round_trip_by_json():
    rule = AccessRule(
        "engineering",
        networks=("10.0.0.0/24",),
        targets=(AccessTarget("127.0.1.3.3.1", 1001),),
        services=(AccessService.WRITE,),
        objects=(ObjectRange(0x8000, 0x8FFF),),
    )
    assert msgspec.json.decode(msgspec.json.encode(rule), type=AccessRule) == rule


def test_rule_with_unknown_field_is_refused():
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"name": "x", "alow": true}', type=AccessRule)


def test_routing_spec_round_trips_by_json():
    hop = HopSpec(TransportKind.AMS_TCP, "", "plc.example:48898")
    whole = RoutingSpec(
        routes=(RouteSpec(name="plc", net_id="5.1.2.3.1.1", hop=hop, virtual="10.0.0.9.1.1"),),
        mqtt=(MqttSpec(network="plant", host="broker", tls=TlsSpec(ca="/ca.pem")),),
        access=(AccessRule("all"),),
        users=(AmsUser("engineer", "/secrets/engineer"),),
        learn=False,
    )
    assert msgspec.json.decode(msgspec.json.encode(whole), type=RoutingSpec) == whole


@pytest.mark.parametrize(
    ("learn", "by_mqtt", "from_host"),
    [
        (True, True, True),
        (False, False, False),
        ((), False, False),
        (("mqtt:line",), True, False),
        (("mqtt:other", "10.0.0.0/24"), False, True),
        (("10.0.1.0/24", "10.0.0.9/32"), False, True),
        (("10.0.1.0/24",), False, False),
    ],
)
def test_learn_names_networks_and_brokers(learn, by_mqtt, from_host):
    told = RoutingSpec(learn=learn)
    assert told.learns_by_mqtt("line") is by_mqtt
    assert told.learns_from("10.0.0.9") is from_host
    assert msgspec.json.decode(msgspec.json.encode(told), type=RoutingSpec) == told


HOP = HopSpec(TransportKind.UDP, "eap0", "10.0.0.2:34980")
ROUTES = tuple(RouteSpec(name="mill", net_id=f"10.0.0.2.{n}.1", hop=HOP, octets=6) for n in (1, 2))
OLD = RoutingSpec(
    routes=ROUTES,
    access=(AccessRule("a"), AccessRule("b", allow=False)),
    users=(AmsUser("me", "/secret"),),
    mqtt=(MqttSpec(network="n", host="broker"),),
)


def test_equal_specs_have_no_difference():
    assert describe_routing(OLD, replace(OLD)) == []


def test_each_thing_that_differs_is_one_line():
    new = replace(
        OLD,
        routes=(ROUTES[0], replace(ROUTES[0], name="saw")),
        access=(AccessRule("b"), AccessRule("c")),
        users=(),
        learn=False,
    )
    assert describe_routing(OLD, new) == [
        "route mill: changed",
        "route saw: added",
        "access rule a: removed",
        "access rule b: changed",
        "access rule c: added",
        "user me: removed",
        "routes are learned from nowhere",
    ]
    assert "routes are learned from anywhere" in describe_routing(new, OLD)
    some = replace(OLD, learn=("mqtt:n", "10.0.0.0/24"))
    assert describe_routing(OLD, some) == ["routes are learned from mqtt:n, 10.0.0.0/24"]


def test_the_order_of_rules_matters():
    new = replace(OLD, access=OLD.access[::-1])
    assert describe_routing(OLD, new) == ["access rules: in another order"]


def test_brokers_are_differences():
    assert describe_routing(OLD, replace(OLD, mqtt=())) == ["MQTT network n: removed"]
    (broker,) = OLD.mqtt
    other = replace(OLD, mqtt=(replace(broker, host="other"), replace(broker, network="m")))
    assert describe_routing(OLD, other) == ["MQTT network n: changed", "MQTT network m: added"]
