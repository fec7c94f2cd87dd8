"""Edge node of Sparkplug B: births, data, deaths, numbers, rebirth, commands, types."""

from __future__ import annotations

import pytest

from eap.ams.mqtt.network import Publish, Subscribe
from eap.bridges.mqtt.sparkplug_node import REBIRTH, SparkplugNode
from eap.bridges.mqtt.sparkplug_types import TemplateTypes, metric_type, plain_value
from eap.bridges.mqtt.topics import CommandError
from eap.bridges.values import BridgeVariable, Quality, Sample
from eap.codec import datatypes
from eap.codec.sparkplug import (
    DataSet,
    Metric,
    MetricType,
    Template,
    decode_payload,
    encode_payload,
)
from eap.config.bridge_sections import MqttPublish, MqttSection, SparkplugSection

AT_NS = 1_700_000_000_000_000_000
AXIS = "Axis<8/4:pos@0 REAL,on@4 BOOL8>"
STATE = "State<INT:Off=0,Run=1>"


def variable(station: str, name: str, kind: str = "INT") -> BridgeVariable:
    return BridgeVariable(station, name, kind, "mm", "", is_settable=name != "speed")


VARIABLES = {
    each.name: each
    for each in (
        variable("a", "speed"), variable("a", "axis", AXIS), variable("b", "state", STATE),
    )
}  # fmt: skip


def sample(value, quality=Quality.GOOD) -> Sample:
    return Sample(value, quality, AT_NS)


SAMPLES = {
    "a/speed": sample(7), "a/axis": sample({"pos": 1.5, "on": True}), "b/state": sample("Run"),
}  # fmt: skip


def make(**keys) -> SparkplugNode:
    section = MqttSection(broker="mqtt://b", **{"commands": ("*/*",)} | keys)
    node = SparkplugNode(section, SparkplugSection(group="works"), "cell")
    node.set_variables(VARIABLES, AT_NS)
    return node


def messages(node: SparkplugNode, most: int = 100) -> list[tuple[str, object]]:
    """Return kind and device of the next messages, with their payloads."""
    found = []
    for each in node.messages(most, AT_NS)[0]:
        if isinstance(each, Publish):
            words = each.topic.split("/")
            assert words[:2] == ["spBv1.0", "works"]
            assert words[3] == "cell"
            found.append(("/".join([words[2], *words[4:]]), decode_payload(each.payload)))
    return found


def born(samples=SAMPLES, **keys) -> tuple[SparkplugNode, list]:
    node = make(**keys)
    node.will()
    node.connected(samples, AT_NS)
    return node, messages(node)


def kinds(found) -> list[str]:
    return [kind for kind, _ in found]


def sequences(found) -> list[int]:
    return [payload.seq for _, payload in found]


def test_connection_begins_with_births_of_node_and_stations():
    node = make()
    will = node.will()
    assert (will.topic, will.qos, will.is_retained) == ("spBv1.0/works/NDEATH/cell", 1, False)
    assert decode_payload(will.payload).seq is None
    node.connected(SAMPLES, AT_NS)
    first = node.messages(1, AT_NS)[0]
    assert first[0] == Subscribe(("spBv1.0/works/NCMD/cell", "spBv1.0/works/DCMD/cell/+"))
    node.connected(SAMPLES, AT_NS)
    found = messages(node)
    assert kinds(found) == ["NBIRTH", "DBIRTH/a", "DBIRTH/b"]
    assert sequences(found) == [0, 1, 2]
    bd_seq, rebirth, definition = found[0][1].metrics
    assert bd_seq == decode_payload(will.payload).metrics[0]
    assert (rebirth.name, rebirth.value, rebirth.kind) == (REBIRTH, False, MetricType.BOOLEAN)
    assert definition.name == "Axis"
    assert definition.value.is_definition
    speed, axis = found[1][1].metrics
    assert (speed.name, speed.kind, speed.value) == ("speed", MetricType.INT16, 7)
    assert axis.value.reference == "Axis"
    assert [(m.name, m.value) for m in axis.value.metrics] == [("pos", 1.5), ("on", True)]
    assert found[2][1].metrics[0].value == "Run"


def test_node_is_born_when_its_variables_are_known():
    node = SparkplugNode(
        MqttSection(broker="mqtt://b"), SparkplugSection(group="works", node="cell"), "x"
    )
    node.will()
    node.connected({}, AT_NS)
    assert not messages(node)
    node.set_variables(VARIABLES, AT_NS)
    node.put_due(SAMPLES, AT_NS)
    assert kinds(messages(node)) == ["NBIRTH", "DBIRTH/a", "DBIRTH/b"]


def test_bd_seq_counts_connections_and_wraps():
    node = make()
    numbers = [decode_payload(node.will().payload).metrics[0].value for _ in range(257)]
    assert numbers[:3] == [0, 1, 2]
    assert numbers[255:] == [255, 0]


def test_data_names_metrics_by_alias_and_continues_the_sequence():
    node, births = born()
    alias = births[1][1].metrics[0].alias
    for value in range(300):
        node.put({"a/speed": sample(value)})
        ((kind, payload),) = messages(node)
        assert kind == "DDATA/a"
        assert payload.seq == (3 + value) % 256
        assert [(m.name, m.alias, m.value) for m in payload.metrics] == [("", alias, value)]


def test_newer_value_replaces_a_waiting_one():
    node, _ = born()
    assert node.put({"a/speed": sample(1)}) == 0
    assert node.put({"a/speed": sample(2)}) == 1
    ((_, payload),) = messages(node)
    assert [each.value for each in payload.metrics] == [2]


def test_station_is_born_when_all_its_values_are_there():
    node, births = born({"a/speed": sample(7)})
    assert kinds(births) == ["NBIRTH"]
    node.put_due(SAMPLES, AT_NS)
    assert kinds(messages(node)) == ["DBIRTH/a", "DBIRTH/b"]


def test_station_without_fresh_values_dies_and_is_born_again():
    node, _ = born()
    stale = sample("Run", Quality.STALE)
    node.put({"b/state": stale})
    ((kind, payload),) = messages(node)
    assert (kind, payload.metrics, payload.seq) == ("DDEATH/b", [], 3)
    node.put_due(SAMPLES | {"b/state": stale}, AT_NS)
    assert not messages(node)
    node.put_due(SAMPLES, AT_NS)
    node.put({"b/state": sample("Run")})
    assert kinds(messages(node)) == ["DBIRTH/b"]


def test_stale_value_beside_fresh_ones_has_its_quality():
    node, _ = born()
    node.put({"a/speed": sample(7, Quality.STALE)})
    (message,) = node.messages(9, AT_NS)[0]
    # Property Quality: Int32 500, which protobuf writes as f4 03.
    assert b"Quality" in message.payload
    assert b"\x18\xf4\x03" in message.payload


def test_rebirth_repeats_all_births_with_the_same_bd_seq():
    node, births = born()
    node.put({"a/speed": sample(8)})
    command = encode_payload(1, [Metric(REBIRTH, MetricType.BOOLEAN, value=True)], None)
    assert node.receive("spBv1.0/works/NCMD/cell", command, AT_NS, is_retained=False) == []
    again = messages(node)
    assert kinds(again) == kinds(births)
    assert sequences(again) == [0, 1, 2]
    assert again[0][1].metrics[0] == births[0][1].metrics[0]


def test_new_variables_are_born():
    node, _ = born()
    node.set_variables(VARIABLES | {"c/x": variable("c", "x")}, AT_NS)
    node.put_due(SAMPLES | {"c/x": sample(1)}, AT_NS)
    assert kinds(messages(node)) == ["NBIRTH", "DBIRTH/a", "DBIRTH/b", "DBIRTH/c"]


def test_nothing_is_kept_during_an_outage():
    node, _ = born()
    node.disconnected()
    assert node.put({"a/speed": sample(8)}) == 0
    node.put_due(SAMPLES, AT_NS)
    assert not node.has_waiting
    assert node.messages(100, AT_NS) == ([], 0)
    node.will()
    node.connected(SAMPLES, AT_NS)
    found = messages(node)
    assert kinds(found) == ["NBIRTH", "DBIRTH/a", "DBIRTH/b"]
    assert found[0][1].metrics[0].value == 1


def test_periodic_group_is_sent_when_due():
    node, _ = born(publish=(MqttPublish(of="*/*", every_ms=1000),))
    sent = []
    for at_ms in (0, 500, 1000):
        node.put_due(SAMPLES, AT_NS + at_ms * 1_000_000)
        sent.append(kinds(messages(node)))
    assert sent == [["DDATA/a", "DDATA/b"], [], ["DDATA/a", "DDATA/b"]]


def command(node: SparkplugNode, station: str, *metrics: Metric, is_retained: bool = False):
    topic = f"spBv1.0/works/DCMD/cell/{station}"
    payload = encode_payload(1, metrics, None)
    return node.receive(topic, payload, AT_NS, is_retained=is_retained)


def test_command_names_metrics_by_name_or_alias():
    node, births = born()
    alias = births[2][1].metrics[0].alias
    pos = Metric("pos", MetricType.FLOAT, 9.0)
    axis = Metric("axis", MetricType.TEMPLATE, Template([pos], "Axis"))
    (found,) = command(node, "a", axis)
    # Members that the template lacks keep their present value.
    assert (found.name, found.value) == ("a/axis", {"pos": 9.0, "on": True})
    (found,) = command(node, "b", Metric("", MetricType.STRING, "Off", alias))
    assert (found.name, found.value) == ("b/state", "Off")


@pytest.mark.parametrize(
    ("station", "metric", "reason"),
    [
        ("a", Metric("speed", MetricType.INT16, 1), "cannot be set"),
        ("a", Metric("none", MetricType.INT16, 1), "unknown metric 'none'"),
        ("a", Metric("", MetricType.INT16, 1, 99), "unknown metric with alias 99"),
        ("a", Metric("", MetricType.INT16, 1, 3), "unknown metric with alias 3"),
        ("c", Metric("x", MetricType.INT16, 1), "unknown station 'c'"),
        ("a", Metric("axis", MetricType.INT16, 1), "no template"),
        ("b", Metric("state", MetricType.STRING, None), "null"),
    ],
)
def test_invalid_command_is_refused(station, metric, reason):
    node, _ = born()
    with pytest.raises(CommandError, match=reason):
        command(node, station, metric)


def test_retained_and_broken_commands_are_refused():
    node, _ = born()
    with pytest.raises(CommandError, match="retained"):
        command(node, "b", Metric("state", MetricType.STRING, "Off"), is_retained=True)
    with pytest.raises(CommandError, match="protobuf field 2"):
        node.receive("spBv1.0/works/NCMD/cell", b"\x12\x7f", AT_NS, is_retained=False)
    with pytest.raises(CommandError, match="unknown command"):
        node.receive("spBv1.0/works/NCMD/cell", b"", AT_NS, is_retained=False)


@pytest.mark.parametrize(
    ("text", "plain", "kind", "value"),
    [
        ("BOOL", True, MetricType.BOOLEAN, True),
        ("SINT", -5, MetricType.INT8, -5),
        ("BIT3", 5, MetricType.UINT8, 5),
        ("UINT24", 5, MetricType.UINT32, 5),
        ("LINT", -5, MetricType.INT64, -5),
        ("LREAL", 0.5, MetricType.DOUBLE, 0.5),
        ("STRING(8)", "x", MetricType.STRING, "x"),
        ("BLOCK(2)", "ff00", MetricType.BYTES, b"\xff\x00"),
        (STATE, "Run", MetricType.STRING, "Run"),
        (STATE, 7, MetricType.STRING, "7"),
        ("REAL[2]", [1.0, 2.0], MetricType.DATA_SET,
         DataSet(["value"], [MetricType.FLOAT], [[1.0], [2.0]])),
        (f"{AXIS}[1]", [{"pos": 1.0, "on": False}], MetricType.DATA_SET,
         DataSet(["pos", "on"], [MetricType.FLOAT, MetricType.BOOLEAN], [[1.0, False]])),
        ("INT[2,2]", [[1, 2], [3, 4]], MetricType.STRING, "[[1,2],[3,4]]"),
    ],
)  # fmt: skip
def test_value_and_command_of_each_type(text, plain, kind, value):
    parsed = datatypes.parse(text)
    assert metric_type(parsed) is kind
    types = TemplateTypes()
    types.add(parsed)
    assert types.value(parsed, plain) == value
    assert plain_value(parsed, Metric("x", kind, value), None) == plain


def test_structs_of_one_name_and_other_members_are_different_templates():
    types = TemplateTypes()
    for text in ("T<2/2:a@0 INT>", "T<2/2:b@0 INT>", "T<2/2:a@0 INT>"):
        types.add(datatypes.parse(text))
    assert [each.name for each in types.definitions()] == ["T", "T_2"]
