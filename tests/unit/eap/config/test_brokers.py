from __future__ import annotations

import os
from pathlib import Path

import pytest

from eap.ams.spec import MqttSpec, TlsSpec
from eap.config.brokers import (
    Broker,
    broker_spec,
    brokers_of,
    find_network,
    parse_url,
    shared_network,
)
from eap.config.files import unreadable_reason
from eap.config.structs import RouteSection, StationSection, TlsSection
from eap.ids import NetId


def station(*networks):
    routes = tuple(RouteSection(mqtt=f"mqtt://{name}", network=name) for name in networks)
    return StationSection(
        name="x",
        net_id=NetId.parse("1.2.3.4.5.6"),
        ports=(),
        routes=(RouteSection(to="y"), *routes),
    )


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
def test_invalid_broker_url_is_refused_with_reason(text, reason):
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
    route = RouteSection(
        mqtt="mqtt://broker:1",
        network="line",
        user="me",
        password_file="secret",
        tls=TlsSection(ca="ca.pem", certificate="/etc/me.pem", key="me.key", check_name=False),
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
    assert broker_spec(RouteSection(mqtt="mqtt://broker", network="line"), Path()).tls is None
    assert broker_spec(RouteSection(mqtt="mqtts://broker", network="line"), Path()).tls == TlsSpec()


PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
THEIRS = '"udp://127.0.9.2", net_id: 127.0.9.2.2.1}'


def brokers(*items, port=PORT):
    lines = "".join(f"\n      - {{{item}}}" for item in items)
    return port, f"{port}\n    routes:{lines}"


ONE = "mqtt: mqtt://b, network: n"


@pytest.mark.parametrize(
    ("items", "finding"),
    [
        (["mqtt: b, network: n"], "8: mqtt: 'b' is no broker; mqtt://HOST[:PORT], or mqtts:// wit"),
        (["mqtt: mqtt://b"], "8: broker mqtt://b has no network; one level of a topic"),
        (["mqtt: mqtt://b, network: a/b"], "8: network 'a/b'; one level of a topic"),
        (["mqtt: mqtt://b, network: '+'"], "8: network '+'; one level of a topic"),
        (["mqtt: mqtt://b, network: $x"], "8: network '$x'; one level of a topic"),
        (["mqtt: mqtt://b, network: a b"], "8: network 'a b'; one level of a topic"),
        (
            [f"mqtt: mqtt://b, network: {'n' * 129}"],
            f"8: network '{'n' * 129}'; one level of a topic",
        ),
        ([ONE, "mqtt: mqtt://c, network: n"], "9: station left is in network 'n' already (line 8)"),
        ([f"{ONE}, password_file: line.yaml"], "8: a password without a user; user: as well"),
        (
            [f"{ONE}, user: a, password_file: gone"],
            "8: gone: No such file or directory; a file, it",
        ),
        ([f"{ONE}, tls: {{ca: gone}}"], "8: gone: No such file or directory; a file, its path fro"),
        ([f"{ONE}, tls: {{key: line.yaml}}"], "8: a key without a certificate; certificate: as we"),
        ([f"{ONE}, qos: 3"], "8: qos is 3; a whole number from 0 to 2"),
        ([f"{ONE}, client_id: {'a' * 65536}"], "8: client_id is too long; at most 65535 bytes"),
    ],
)
def test_invalid_broker_is_one_finding(findings, items, finding):
    [found] = findings(brokers(*items))
    assert found.startswith(finding)


def test_two_stations_are_not_one_client(findings):
    [found] = findings(
        brokers(f"{ONE}, client_id: x"), brokers(f"{ONE}, client_id: x", port=THEIRS)
    )
    assert found.startswith("23: client_id 'x' is used twice (first in line 8); one of its own")
    other = "mqtt: mqtt://c, network: n, client_id: x"
    assert findings(brokers(f"{ONE}, client_id: x"), brokers(other, port=THEIRS)) == []


def test_a_broker_with_its_files_is_no_finding(findings):
    files = "user: a, password_file: line.yaml, tls: {ca: line.yaml, certificate: line.yaml}"
    assert findings(brokers(f"{ONE}, {files}", "mqtt: mqtts://b, network: m")) == []


def test_a_file_is_readable_or_says_why_not(tmp_path):
    (tmp_path / "secret").touch()
    assert unreadable_reason(tmp_path / "secret") == ""
    assert unreadable_reason(tmp_path / "gone") == "No such file or directory"
    assert unreadable_reason(tmp_path) == "Is a directory"
    os.mkfifo(tmp_path / "pipe")
    assert unreadable_reason(tmp_path / "pipe") == "no regular file"
    assert "null" in unreadable_reason(tmp_path / "a\0b")


LEARNING_PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
LEARNING_ONE = "mqtt: mqtt://b, network: n"
SOURCES = "mqtt:NETWORK of a broker of the station, or an IPv4 address or network"


def learning(value: str, *brokers: str) -> tuple[str, str]:
    routes = "".join(f"\n      - {{{each}}}" for each in brokers)
    return LEARNING_PORT, f"{LEARNING_PORT}\n    learn: {value}" + (
        f"\n    routes:{routes}" if routes else ""
    )


@pytest.mark.parametrize(
    ("value", "finding"),
    [
        ("[mqtt:m]", f"7: learn: the station is in no network 'm'; {SOURCES}"),
        ("[line]", f"7: learn: 'line' is no network of a broker and no IPv4 network; {SOURCES}"),
        ("[10.0.0.300]", "7: learn: '10.0.0.300' is no network of a broker and no IPv4 network"),
        ("mqtt:n", "7: learn is 'mqtt:n'; true, false or a list"),
        ("", "7: learn has no value; true, false or a list"),
        ("[{a: 1}]", "7: item 1 of learn is a mapping"),
    ],
)
def test_invalid_learn_source_is_one_finding(findings, value, finding):
    [found] = findings(learning(value, LEARNING_ONE))
    assert found.startswith(finding)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("true", True),
        ("false", False),
        ("[]", ()),
        ("[mqtt:n, 10.0.0.7, 10.1.2.3/16]", ("mqtt:n", "10.0.0.7/32", "10.1.0.0/16")),
    ],
)
def test_learn_sources_are_part_of_routing(load_plant, value, told):
    assert load_plant(learning(value, LEARNING_ONE)).plant.routing["left"].learn == told


@pytest.fixture
def warnings(load_plant):
    def of(*edit: str) -> list[str]:
        result = load_plant(edit)
        assert result.findings == ()
        return [f"{each.line}: {each.message}; {each.expected}" for each in result.warnings]

    return of


def test_anonymous_broker_is_a_warning_until_learn_names_it(warnings):
    [warning] = warnings(*learning("true", LEARNING_ONE))
    assert warning == (
        "9: station left learns routes from any client of mqtt://b: the broker requires no user;"
        " learn: [mqtt:n] if that is meant, else learn: false"
    )
    assert warnings(*learning("[mqtt:n]", LEARNING_ONE)) == []
    assert warnings(*learning("false", LEARNING_ONE)) == []
    assert warnings(*learning("true", f"{LEARNING_ONE}, user: a")) == []
    certificate = "tls: {certificate: line.yaml}"
    assert warnings(*learning("true", f"mqtt: mqtts://b, network: n, {certificate}")) == []
    assert len(warnings(*learning("true", "mqtt: mqtts://b, network: n"))) == 1
