"""Servers of one plant at the same address."""

from __future__ import annotations

import pytest

from eap.config.load import load

PLANT = """\
plant: line
stations:
  - name: oven
    net_id: 10.0.0.1.1.1
    ports: [{name: eap0, kind: eap, interface: "udp://10.0.0.1", net_id: 10.0.0.1.2.1}]
    variables: {count: UDINT}
"""


@pytest.mark.parametrize(
    ("keys", "finding"),
    [
        ("web: 127.0.0.1:8080\nmetrics: 127.0.0.1:9464\n", ""),
        ("web: 127.0.0.1:8080\nopcua: {listen: 127.0.0.2:8080}\n", ""),
        (
            "web: 127.0.0.1:8080\nmetrics: 127.0.0.1:8080\n",
            (
                "8: metrics listens at the address of web; another port, or no such key: the page"
                " gives metrics, too"
            ),
        ),
        (
            "web: 127.0.0.1:4840\nopcua: {listen: 127.0.0.1:4840}\n",
            "8: opcua listens at the address of web; another port",
        ),
        (
            (
                "s7: {server: {listen: 0.0.0.0:102, blocks: {1: [oven/count]}}}\n"
                "modbus: {server: {listen: 127.0.0.1:102, input: [oven/count]}}\n"
            ),
            "8: modbus listens at the address of s7; another port",
        ),
    ],
)
def test_check_names_servers_at_the_same_address(tmp_path, keys, finding):
    path = tmp_path / "plant.yaml"
    path.write_text(PLANT + keys)
    found = [
        f"{each.line}: {each.message}; {each.expected}"
        for each in load(path, lambda _: ()).findings
    ]
    assert found == ([finding] if finding else [])
