from __future__ import annotations

from msgspec.structs import replace

from eap.ams.spec import (
    AccessRule,
    AmsUser,
    HopSpec,
    MqttSpec,
    RouteSpec,
    RoutingSpec,
    TransportKind,
    describe_routing,
    routing_needs_new_start,
)

HOP = HopSpec(TransportKind.UDP, "eap0", "10.0.0.2:34980")
ROUTES = tuple(RouteSpec(name="mill", net_id=f"10.0.0.2.{n}.1", hop=HOP, octets=6) for n in (1, 2))
OLD = RoutingSpec(
    routes=ROUTES,
    access=(AccessRule("a"), AccessRule("b", allow=False)),
    users=(AmsUser("me", "/secret"),),
    mqtt=(MqttSpec(network="n", host="broker"),),
)


def test_what_is_the_same_is_no_difference():
    assert describe_routing(OLD, replace(OLD)) == []
    assert routing_needs_new_start(OLD, replace(OLD)) == []


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


def test_brokers_need_a_new_start():
    assert routing_needs_new_start(OLD, replace(OLD, mqtt=())) == [
        "MQTT network n: removed: restart the appliance"
    ]
    assert routing_needs_new_start(OLD, replace(OLD, learn=False)) == [
        "routes by MQTT: learn is another one: restart the appliance"
    ]
    assert routing_needs_new_start(OLD, replace(OLD, learn=("mqtt:n",))) == []
    without = replace(OLD, mqtt=())
    assert routing_needs_new_start(without, replace(without, learn=False)) == []
