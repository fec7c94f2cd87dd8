"""The key ``mqtt`` of a plant file: short form, brokers, findings, warnings."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.config.bridge_sections import MqttBridgeSpec
from eap.runtime.plantfile import load_plant

PLANT = """\
plant: cell
stations:
  - name: mixer
    net_id: 5.1.1.1.1.1
    ports: [{{name: eap0, kind: eap, interface: "udp://127.0.9.1", net_id: 5.1.1.1.2.1}}]
    variables: {{ticks: UDINT, setpoint: INT, axis: Axis}}
    sources: {{ticks: {{kind: counter}}}}
    routes:
      - {{mqtt: "mqtts://broker:8884", network: works, user: me, password_file: pw,
         tls: {{ca: ca.pem}}}}
    access: [{{deny: [write], transports: [web]}}{rule}]
types: {{Axis: {{members: {{pos: REAL}}}}}}
mqtt: {mqtt}
"""
RULE = ", {allow: [write], transports: [mqtt]}"


def load(tmp_path: Path, mqtt: str, rule: str = ""):
    for name in ("pw", "ca.pem"):
        (tmp_path / name).write_text("x\n")
    file = tmp_path / "plant.yaml"
    file.write_text(PLANT.format(mqtt=mqtt, rule=rule))
    return load_plant(file)


def bridge(tmp_path: Path, mqtt: str) -> MqttBridgeSpec:
    result = load(tmp_path, mqtt)
    assert result.plant is not None, result.findings
    found = result.plant.bridges["mqtt"]
    assert isinstance(found, MqttBridgeSpec)
    return found


def test_url_alone_publishes_all_variables_on_change(tmp_path):
    spec = bridge(tmp_path, "mqtt://10.0.0.9")
    assert (spec.broker.host, spec.broker.port, spec.broker.tls) == ("10.0.0.9", 1883, None)
    assert [each.patterns for each in spec.section.publish] == [("*/*",)]
    assert spec.section.discovery == ""


def test_network_is_the_broker_of_a_station_with_its_login(tmp_path):
    broker = bridge(tmp_path, "works").broker
    assert (broker.host, broker.port, broker.user) == ("broker", 8884, "me")
    assert broker.password_file == str(tmp_path / "pw")
    assert broker.tls is not None
    assert broker.tls.ca == str(tmp_path / "ca.pem")


def test_own_login_goes_before_that_of_the_station(tmp_path):
    broker = bridge(tmp_path, "{broker: works, user: values, password_file: ca.pem}").broker
    assert (broker.user, broker.password_file) == ("values", str(tmp_path / "ca.pem"))


@pytest.mark.parametrize(
    ("mqtt", "message"),
    [
        ("wroks", "broker 'wroks' is no network of a broker of this plant, did you mean works?"),
        ("http://x", "'http://x' is no broker"),
        ("mqtt://me@x", "has more than a host and a port"),
        ("{broker: works, topic: '{plant}/{statoin}/{variable}'}", "unknown {statoin}"),
        ("{broker: works, topic: '{plant}/{station}'}", "is the same for several variables"),
        ("{broker: works, topic: '{station}/#/{variable}'}", "is no topic"),
        ("{broker: works, topic: '/{station}/{variable}'}", "is no topic"),
        ("{broker: works, publish: [mixer/tikcs]}", "has no variable 'tikcs', did you mean ticks?"),
        ("{broker: works, publish: [{of: ['mill/*']}]}", "no variable fits 'mill/*'"),
        ("{broker: works, publish: [{of: mixer/ticks, every_ms: 50}]}", "every_ms is 50"),
        ("{broker: works, commands: [mixer/ticks]}", "cannot be set: it has a source"),
        ("{broker: works, commands: ['mixer/t*']}", "cannot be set: it has a source"),
        ("{broker: works, sparkplug: a/b}", "group 'a/b'"),
        ("{broker: works, sparkplug: {group: a, node: 'b c'}}", "node 'b c'"),
        ("{broker: works, home_assistant: 'a/#'}", "home_assistant: 'a/#'"),
        ("{broker: works, json: false}", "nothing is published"),
        ("{broker: works, password_file: none, user: x}", "none: No such file"),
        ("{broker: works, period_ms: 5}", "period_ms"),
        ("{broker: works, qos: 3}", "qos"),
    ],
)
def test_invalid_key_is_a_finding_with_its_line(tmp_path, mqtt, message):
    findings = load(tmp_path, mqtt).findings
    assert [each for each in findings if message in each.message], findings
    assert {each.line for each in findings} == {13}


def test_member_of_a_struct_may_be_published_and_commanded(tmp_path):
    spec = bridge(
        tmp_path, "{broker: works, publish: [mixer/axis.pos], commands: [mixer/axis.pos]}"
    )
    assert spec.section.commands == ("mixer/axis.pos",)


def test_commands_without_an_access_rule_are_warned_of(tmp_path):
    mqtt = "{broker: works, commands: [mixer/setpoint]}"
    (warning,) = load(tmp_path, mqtt).warnings
    assert warning.message == "commands for mixer are refused: no access rule allows them"
    assert not load(tmp_path, mqtt, RULE).warnings
