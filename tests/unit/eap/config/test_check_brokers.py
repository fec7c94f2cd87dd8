from __future__ import annotations

import pytest

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
        ([f"{ONE}, client_id: {'a' * 65536}"], "8: client_id is too long; at most 65535 octets"),
    ],
)
def test_a_broker_that_cannot_be_is_one_finding(findings, items, finding):
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
