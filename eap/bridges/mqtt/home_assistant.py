"""Home Assistant's MQTT discovery: one retained document for each station as a device.

The document has ``device``, ``origin`` and ``components``, the form for whole devices.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from eap.ams.mqtt.network import Publish
from eap.bridges.values import BridgeVariable
from eap.codec import datatypes
from eap.codec.basetypes import Boolean, DataType, Integer, Real
from eap.codec.enumerations import Enumeration
from eap.codec.times import Timed
from eap.release import RELEASE

_UNITS = {"degC": "°C", "degF": "°F", "1/min": "rpm", "um": "µm", "us": "µs", "Ohm": "Ω"}
"""Units that Home Assistant writes otherwise."""
_MAX_STATE = 255
"""Characters of a state of Home Assistant."""


class DiscoveryDocuments:
    """Discovery documents of the stations of a plant.

    Args:
        prefix: First level of their topics; empty for no discovery.
        plant: Name of the plant.
        status: Topic of the appliance's status.
    """

    def __init__(self, prefix: str, plant: str, status: str) -> None:
        self._prefix = prefix
        self._plant = plant
        self._status = status
        self._platforms: dict[str, dict[str, str]] = {}

    def messages(
        self,
        variables: Mapping[str, BridgeVariable],
        topics: Mapping[str, str],
        commands: Mapping[str, str],
    ) -> Iterator[Publish]:
        """Yield the documents of all stations.

        Args:
            variables: The variables that are published.
            topics: Their topics.
            commands: Topics of those that can be set.
        """
        if not self._prefix:
            return
        stations: dict[str, dict[str, BridgeVariable]] = {}
        for name, each in variables.items():
            stations.setdefault(each.station, {})[name] = each
        for station in {**dict.fromkeys(self._platforms), **stations}:
            identifier = _identifier(f"eap_{self._plant}_{station}")
            components = {
                _identifier(each.variable): self._component(
                    identifier, each, topics[name], commands.get(name, "")
                )
                for name, each in stations.get(station, {}).items()
            }
            platforms = {key: each["platform"] for key, each in components.items()}
            for key, platform in self._platforms.get(station, {}).items():
                # A component with its platform alone is removed.
                components.setdefault(key, {"platform": platform})
            self._platforms[station] = platforms
            yield Publish(
                f"{self._prefix}/device/{identifier}/config",
                msgspec.json.encode(self._document(station, identifier, components)),
                1,
                is_retained=True,
            )

    def _document(
        self, station: str, identifier: str, components: dict[str, dict[str, Any]]
    ) -> dict[str, Any]:
        return {
            "device": {
                "identifiers": [identifier],
                "name": f"{self._plant} {station}",
                "model": "EAP station",
                "sw_version": RELEASE,
            },
            "origin": {"name": "EAP appliance", "sw_version": RELEASE},
            "availability_topic": self._status,
            "components": components,
        }

    def _component(
        self, device: str, variable: BridgeVariable, topic: str, command: str
    ) -> dict[str, Any]:
        component: dict[str, Any] = {
            "unique_id": f"{device}_{_identifier(variable.variable)}",
            "name": variable.variable,
            "state_topic": topic,
            "json_attributes_topic": topic,
            "value_template": "{{ value_json.value }}",
        }
        if command:
            component["command_topic"] = command
        kind = datatypes.parse(variable.type)
        if isinstance(kind, Integer | Real) and not isinstance(kind, Enumeration | Timed):
            if unit := variable.unit:
                component["unit_of_measurement"] = _UNITS.get(unit, unit)
            return component | (_number(kind) if command else _MEASURED)
        return component | (_input(kind) if command else _output(kind))


_MEASURED = {"platform": "sensor", "state_class": "measurement"}
_CUT = {
    # Longer than a state may be: the attributes have the whole value.
    "platform": "sensor",
    "value_template": f"{{{{ (value_json.value | string)[:{_MAX_STATE}] }}}}",
}


def _number(kind: DataType) -> dict[str, Any]:
    """Return the keys of a component that is a number and can be set."""
    low, high = kind.scalar_range or (0, 0)
    step: float = 1
    if isinstance(kind, Real):
        # Its range has more digits than an input field takes.
        low, high, step = max(low, -1e9), min(high, 1e9), 0.001
    return {"platform": "number", "mode": "box", "min": low, "max": high, "step": step}


def _input(kind: DataType) -> dict[str, Any]:
    """Return the keys of a component that is no number and can be set."""
    if isinstance(kind, Boolean):
        # Templates write truth values as Python does; commands are JSON.
        states = {"state_on": "True", "state_off": "False"}
        return {"platform": "switch", "payload_on": "true", "payload_off": "false", **states}
    if isinstance(kind, Enumeration):
        return {"platform": "select", "options": list(kind.numbers)}
    if not kind.is_text:
        return _CUT
    return {
        "platform": "text",
        "max": min(kind.size, _MAX_STATE),
        "command_template": '{{ {"value": value} | tojson }}',
    }


def _output(kind: DataType) -> dict[str, Any]:
    """Return the keys of a component that is no number and only shown."""
    if isinstance(kind, Boolean):
        return {"platform": "binary_sensor", "payload_on": "True", "payload_off": "False"}
    if isinstance(kind, Enumeration):
        return {"platform": "sensor", "device_class": "enum", "options": list(kind.numbers)}
    return _CUT


def _identifier(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]", "_", text)
