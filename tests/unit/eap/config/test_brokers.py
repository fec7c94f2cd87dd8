from __future__ import annotations

from pathlib import Path

import pytest

from eap.aoe.spec import MqttSpec, TlsSpec
from eap.config.brokers import (
    Broker,
    broker_spec,
    brokers_of,
    find_network,
    parse_url,
    shared_network,
)
from eap.config.structs import Route, Station, Tls


def station(*networks):
    routes = tuple(Route(mqtt=f"mqtt://{name}", network=name) for name in networks)
    return Station(name="x", net_id="1.2.3.4.5.6", ports=(), routes=(Route(to="y"), *routes))


@pytest.mark.parametrize(
    ("text", "broker"),
    [
        ("mqtt://broker", Broker("broker", 1883, False)),
        ("mqtts://10.0.0.1", Broker("10.0.0.1", 8883, True)),
        ("mqtts://broker:1", Broker("broker", 1, True)),
    ],
)
def test_a_url_names_a_broker(text, broker):
    assert parse_url(text) == broker


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("broker", "'broker' is no broker"),
        ("http://broker", "'http://broker' is no broker"),
        ("mqtt://me:secret@broker", "has more than a host and a port"),
        ("mqtt://broker/line", "has more than a host and a port"),
        ("mqtt://", "'' is no name of a host"),
    ],
)
def test_what_is_no_broker_says_why(text, reason):
    with pytest.raises(ValueError, match=reason):
        parse_url(text)


def test_a_network_is_found_by_its_name():
    one = station("line", "plant")
    assert [each.network for each in brokers_of(one)] == ["line", "plant"]
    assert find_network(one, "plant").mqtt == "mqtt://plant"
    assert find_network(one, "else") is None
    assert shared_network(one, station("plant")) == "plant"
    assert shared_network(one, station("else")) == ""


def test_all_of_a_broker_comes_out_with_its_files_in_full():
    route = Route(
        mqtt="mqtt://broker:1",
        network="line",
        user="me",
        password_file="secret",
        tls=Tls(ca="ca.pem", certificate="/etc/me.pem", key="me.key", check_name=False),
        client_id="me-1",
        no_retain=True,
        unidirectional=True,
        qos=2,
        prefix=True,
    )
    assert broker_spec(route, Path("/plant")) == MqttSpec(
        network="line",
        host="broker",
        port=1,
        user="me",
        password_file="/plant/secret",
        tls=TlsSpec("/plant/ca.pem", "/etc/me.pem", "/plant/me.key", False),
        client_id="me-1",
        no_retain=True,
        is_unidirectional=True,
        qos=2,
        is_prefixed=True,
    )


def test_only_mqtts_or_the_key_means_tls():
    assert broker_spec(Route(mqtt="mqtt://broker", network="line"), Path()).tls is None
    assert broker_spec(Route(mqtt="mqtts://broker", network="line"), Path()).tls == TlsSpec()
