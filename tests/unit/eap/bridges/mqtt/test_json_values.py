"""JSON messages by MQTT: topics, values, periods, commands, Home Assistant's discovery."""

from __future__ import annotations

import json

import msgspec
import pytest

from eap.ams.mqtt.network import Publish, Subscribe
from eap.bridges.mqtt.json_values import JsonValues
from eap.bridges.mqtt.topics import CommandError, WriteCommand
from eap.bridges.values import BridgeVariable, Quality, Sample
from eap.config.bridge_sections import MqttPublish, MqttSection

AT_NS = 1_700_000_000_123_400_000
AT_S = 1700000000.123
STATE = "State<INT:Off=0,Run=1>"
AXIS = "Axis<8/4:pos@0 REAL,value@4 REAL>"
TYPES = {
    "speed": "REAL", "setpoint": "INT", "door": "BOOL", "state": STATE, "axis": AXIS,
    "name": "STRING(16)",
}  # fmt: skip


def variable(name: str, **more) -> BridgeVariable:
    fields = {"unit": "", "comment": "", "is_settable": name != "speed"} | more
    return BridgeVariable("mixer", name, TYPES[name], **fields)


VARIABLES = {f"mixer/{name}": variable(name) for name in TYPES}
VARIABLES["mixer/speed"] = variable("speed", unit="1/min")


def sample(value, quality=Quality.GOOD) -> Sample:
    return Sample(value, quality, AT_NS)


SAMPLES = {"mixer/speed": sample(1.5), "mixer/setpoint": sample(40)}


def make(**keys) -> JsonValues:
    section = MqttSection(broker="mqtt://b", **{"commands": ("mixer/*",)} | keys)
    core = JsonValues(section, "cell", "cell")
    core.set_variables(VARIABLES, AT_NS)
    return core


def connected(core: JsonValues, samples=SAMPLES) -> list:
    core.connected(samples, AT_NS)
    return core.messages(100, AT_NS)[0]


def published(messages) -> dict[str, object]:
    found = (each for each in messages if isinstance(each, Publish) and each.payload[:1] == b"{")
    return {each.topic: json.loads(each.payload) for each in found}


def test_connection_begins_with_subscriptions_status_and_all_values():
    core = make()
    first, status, *values = connected(core)
    assert first == Subscribe([f"cell/mixer/{name}/set" for name in TYPES if name != "speed"])
    assert status == Publish("cell/status", b"online", 1, is_retained=True)
    assert core.will() == Publish("cell/status", b"offline", 1, is_retained=True)
    assert published(values) == {
        "cell/mixer/speed": {"value": 1.5, "unit": "1/min", "quality": "good", "time": AT_S},
        "cell/mixer/setpoint": {"value": 40, "unit": "", "quality": "good", "time": AT_S},
    }  # fmt: skip
    assert all(each.is_retained for each in values)
    assert not core.has_waiting


def test_appliance_with_some_stations_has_a_status_of_its_own():
    core = JsonValues(MqttSection(broker="mqtt://b"), "cell", "cell@a+b")
    assert core.will().topic == "cell/status/a_b"


def test_waiting_value_is_replaced_by_a_newer_one_and_counted():
    core = make()
    connected(core)
    assert core.put({"mixer/speed": sample(2.0), "mixer/setpoint": sample(41)}) == 0
    assert core.put({"mixer/speed": sample(3.0, Quality.STALE)}) == 1
    messages, count = core.messages(1, AT_NS)
    assert (len(messages), count) == (1, 1)
    assert published(messages)["cell/mixer/speed"]["value"] == 3.0
    assert published(messages)["cell/mixer/speed"]["quality"] == "stale"
    assert core.has_waiting


def test_values_during_an_outage_are_not_kept():
    core = make()
    connected(core)
    core.put({"mixer/speed": sample(2.0)})
    core.disconnected()
    assert core.put({"mixer/speed": sample(3.0)}) == 0
    assert not core.has_waiting
    assert (
        published(connected(core, {"mixer/speed": sample(9.0)}))["cell/mixer/speed"]["value"] == 9.0
    )


def test_group_with_a_period_is_published_changed_or_not():
    groups = (MqttPublish(of="mixer/speed", every_ms=1000), MqttPublish(of="mixer/*"))
    core = make(publish=groups)
    connected(core)
    assert core.put({"mixer/speed": sample(2.0), "mixer/door": sample(True)}) == 0
    topics = []
    for at_ms in (0, 500, 1000, 1400, 2100):
        core.put_due(SAMPLES, AT_NS + at_ms * 1_000_000)
        topics.append([each.topic for each in core.messages(10, AT_NS)[0]])
    assert topics == [
        ["cell/mixer/door", "cell/mixer/speed"], [], ["cell/mixer/speed"], [], ["cell/mixer/speed"],
    ]  # fmt: skip


def test_topics_of_variables_that_are_gone_are_cleared():
    core = make()
    connected(core)
    core.set_variables({"mixer/speed": VARIABLES["mixer/speed"]}, AT_NS)
    cleared = [
        each.topic for each in core.messages(100, AT_NS)[0] if each == each._replace(payload=b"")
    ]
    assert cleared == sorted(f"cell/mixer/{name}" for name in TYPES if name != "speed")


def test_names_become_single_levels_of_topics():
    core = JsonValues(MqttSection(broker="mqtt://b", topic="a/{variable}/{station}"), "c", "c")
    odd = BridgeVariable("x", "a/b+c#d", "INT", "", "", is_settable=False)
    core.set_variables({"x/a/b+c#d": odd, "x/y": odd._replace(variable="y")}, AT_NS)
    core.connected({"x/y": sample(1)}, AT_NS)
    assert core.messages(9, AT_NS)[0][-1].topic == "a/y/x"


@pytest.mark.parametrize(
    ("name", "payload", "value", "reference"),
    [
        ("setpoint", b"55", 55, None),
        ("setpoint", b'{"value": 55, "id": "a7"}', 55, "a7"),
        ("door", b" true ", True, None),
        ("state", b"Run", "Run", None),
        ("state", b'"Run"', "Run", None),
        ("name", b"drum", "drum", None),
        ("axis", b'{"pos": 1, "value": 2}', {"pos": 1, "value": 2}, None),
        ("axis", b'{"value": {"pos": 1, "value": 2}, "id": 3}', {"pos": 1, "value": 2}, 3),
    ],
)
def test_command_is_json_with_or_without_an_id(name, payload, value, reference):
    topic = f"cell/mixer/{name}/set"
    found = make().receive(topic, payload, AT_NS, is_retained=False)
    assert found == [WriteCommand(f"mixer/{name}", value, topic, reference)]


@pytest.mark.parametrize(
    ("topic", "payload", "is_retained", "reason"),
    [
        ("cell/mixer/setpoint/set", b"on", False, "not JSON"),
        ("cell/mixer/setpoint/set", b'"\xff"', False, "not JSON"),
        ("cell/mixer/name/set", b"\xff", False, "utf-8"),
        ("cell/mixer/setpoint/set", b"[" * 100_000, False, "at most 65536 bytes"),
        ("cell/mixer/setpoint/set", b"[" * 60_000, False, "not JSON"),
        ("cell/mixer/setpoint/set", b"55", True, "retained"),
        ("cell/mixer/speed/set", b"55", False, "no variable has this topic"),
        ("cell/mill/setpoint/set", b"55", False, "no variable has this topic"),
    ],
)
def test_invalid_command_is_refused_with_the_reason(topic, payload, is_retained, reason):
    with pytest.raises(CommandError, match=reason):
        make().receive(topic, payload, AT_NS, is_retained=is_retained)


def test_result_of_a_command_has_its_id():
    core, command = make(), WriteCommand("mixer/setpoint", 55, "cell/mixer/setpoint/set", "a7")
    answer = core.answer(command, "", AT_NS)
    assert answer.topic == "cell/mixer/setpoint/result"
    assert not answer.is_retained
    assert json.loads(answer.payload) == {
        "ok": True,
        "value": 55,
        "id": "a7",
        "time": AT_S,
    }
    refused = json.loads(core.answer(command, "no rule allows it", AT_NS).payload)
    assert (refused["ok"], refused["error"]) == (False, "no rule allows it")


def discovered(core: JsonValues) -> dict:
    (found,) = [e for e in connected(core, {}) if getattr(e, "topic", "").endswith("/config")]
    assert found.topic == "homeassistant/device/eap_cell_mixer/config"
    assert found.is_retained
    return json.loads(found.payload)


def test_discovery_describes_each_variable_by_its_type():
    document = discovered(make(home_assistant=True))
    assert {"identifiers", "name"} <= document["device"].keys()
    assert document["origin"]["name"] == "EAP appliance"
    assert document["availability_topic"] == "cell/status"
    components = document["components"]
    platforms = {name: each["platform"] for name, each in components.items()}
    assert platforms == {"speed": "sensor", "setpoint": "number", "door": "switch",
                         "state": "select", "axis": "sensor", "name": "text"}  # fmt: skip
    assert len({each["unique_id"] for each in components.values()}) == len(components)
    assert components["speed"]["unit_of_measurement"] == "rpm"
    assert components["setpoint"]["min"] == -32768
    assert components["setpoint"]["command_topic"] == "cell/mixer/setpoint/set"
    assert components["state"]["options"] == ["Off", "Run"]
    assert "command_topic" not in components["speed"]


def test_discovery_of_variables_that_cannot_be_set_has_no_inputs():
    components = discovered(make(home_assistant=True, commands=()))["components"]
    platforms = {name: each["platform"] for name, each in components.items()}
    assert set(platforms.values()) == {"sensor", "binary_sensor"}
    assert components["state"]["device_class"] == "enum"


def test_discovery_removes_components_that_are_gone():
    core = make(home_assistant=True)
    connected(core)
    core.set_variables({"mixer/speed": VARIABLES["mixer/speed"]}, AT_NS)
    (found,) = [e for e in core.messages(100, AT_NS)[0] if "/config" in getattr(e, "topic", "")]
    components = msgspec.json.decode(found.payload)["components"]
    assert components["door"] == {"platform": "switch"}
    assert components["speed"]["state_topic"] == "cell/mixer/speed"
