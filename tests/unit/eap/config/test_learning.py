from __future__ import annotations

import pytest

PORT = '"udp://127.0.9.1", net_id: 127.0.9.1.2.1}'
ONE = "mqtt: mqtt://b, network: n"
SOURCES = "mqtt:NETWORK of a broker of the station, or an IPv4 address or network"


def learning(value: str, *brokers: str) -> tuple[str, str]:
    routes = "".join(f"\n      - {{{each}}}" for each in brokers)
    return PORT, f"{PORT}\n    learn: {value}" + (f"\n    routes:{routes}" if routes else "")


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
def test_learn_source_that_is_none_is_one_finding(findings, value, finding):
    [found] = findings(learning(value, ONE))
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
def test_learn_sources_are_told_to_the_router(load_plant, value, told):
    assert load_plant(learning(value, ONE)).plant.routing["left"].learn == told


@pytest.fixture
def warnings(load_plant):
    def of(*edit: str) -> list[str]:
        result = load_plant(edit)
        assert result.findings == ()
        return [f"{each.line}: {each.message}; {each.expected}" for each in result.warnings]

    return of


def test_broker_that_anybody_may_teach_by_is_a_warning_until_learn_names_it(warnings):
    [warning] = warnings(*learning("true", ONE))
    assert warning == (
        "9: station left learns routes from anybody at mqtt://b: the broker asks for no user;"
        " learn: [mqtt:n] if that is meant, else learn: false"
    )
    assert warnings(*learning("[mqtt:n]", ONE)) == []
    assert warnings(*learning("false", ONE)) == []
    assert warnings(*learning("true", f"{ONE}, user: a")) == []
    certificate = "tls: {certificate: line.yaml}"
    assert warnings(*learning("true", f"mqtt: mqtts://b, network: n, {certificate}")) == []
    assert len(warnings(*learning("true", "mqtt: mqtts://b, network: n"))) == 1
