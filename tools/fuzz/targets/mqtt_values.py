"""Commands by MQTT: any bytes as JSON and Sparkplug B, and a valid command with some changed."""

from __future__ import annotations

from contextlib import suppress

from eap.bridges.mqtt.json_values import JsonValues
from eap.bridges.mqtt.sparkplug_node import SparkplugNode
from eap.bridges.mqtt.topics import CommandError, MessageCore
from eap.bridges.values import BridgeVariable, Quality, Sample
from eap.codec import datatypes
from eap.codec.sparkplug import (
    DataSet,
    Metric,
    MetricType,
    Template,
    encode_payload,
)
from eap.config.bridge_sections import MqttSection, SparkplugSection
from tools.fuzz.messages import cut

_TYPES = {
    "speed": "REAL",
    "state": "State<INT:Off=0,Run=1>",
    "axis": "Axis<8/4:pos@0 REAL,value@4 INT[2]>",
    "points": "Axis<8/4:pos@0 REAL,on@4 BOOL8>[2]",
    "name": "STRING(8)",
    "raw": "BLOCK(4)",
}
_VARIABLES = {
    f"a/{name}": BridgeVariable("a", name, kind, "", "", is_settable=True)
    for name, kind in _TYPES.items()
}
_SAMPLES = {
    f"a/{name}": Sample((kind := datatypes.parse(text)).to_plain(kind.zero), Quality.GOOD, 1)
    for name, text in _TYPES.items()
}


_COMMAND = encode_payload(
    1,
    [
        Metric("speed", MetricType.FLOAT, 1.5, 1),
        Metric("", MetricType.STRING, "Run", 2),
        Metric(
            "axis",
            MetricType.TEMPLATE,
            Template([
                Metric("pos", MetricType.FLOAT, 2.0),
                Metric("value", MetricType.DATA_SET,
                       DataSet(["value"], [MetricType.INT16], [[-1], [2]])),
            ], "Axis"),
        ),
    ],
    3,
)  # fmt: skip
"""A valid command."""


def fuzz_one(data: bytes) -> None:
    """Send *data* to each topic, whole, in pieces, and as changes of a valid command."""
    section = MqttSection(broker="mqtt://b", commands=("*/*",), home_assistant=True)
    core = JsonValues(section, "p", "p")
    node = SparkplugNode(section, SparkplugSection(group="g"), "p")
    for each in (core, node):
        each.set_variables(_VARIABLES, 1)
        each.will()
        each.connected(_SAMPLES, 1)
        each.messages(100, 1)
    topics = [f"p/a/{name}/set" for name in _TYPES]
    bent = bytearray(_COMMAND)
    for at, octet in zip(data[::2], data[1::2], strict=False):
        bent[at % len(bent)] = octet
    for piece in (data, bytes(bent), *cut(data)):
        for topic in topics:
            _receive(core, topic, piece)
        for topic in ("spBv1.0/g/NCMD/p", "spBv1.0/g/DCMD/p/a", "spBv1.0/g/DCMD/p/b"):
            _receive(node, topic, piece)
        node.messages(100, 1)


def _receive(core: MessageCore, topic: str, payload: bytes) -> None:
    with suppress(CommandError):
        for command in core.receive(topic, payload, 1, is_retained=False):
            core.answer(command, "refused", 1)
