from __future__ import annotations

import msgspec
import pytest

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
)


def test_rules_survive_the_way_to_another_process():
    rule = AccessRule(
        "engineering",
        networks=("10.0.0.0/24",),
        targets=(AccessTarget("127.0.1.3.3.1", 1001),),
        services=(AccessService.WRITE,),
        objects=(ObjectRange(0x8000, 0x8FFF),),
    )
    assert msgspec.json.decode(msgspec.json.encode(rule), type=AccessRule) == rule


def test_what_no_rule_has_is_refused():
    with pytest.raises(msgspec.ValidationError):
        msgspec.json.decode(b'{"name": "x", "alow": true}', type=AccessRule)


def test_what_a_router_is_told_comes_out_of_json_as_it_went_in():
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
