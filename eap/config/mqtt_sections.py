"""Sections of the key ``mqtt`` of a plant file: values by MQTT (docs/mqtt-values.md)."""

from __future__ import annotations

from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from eap.ams.spec import MqttSpec
from eap.config.structs import Milliseconds, Section, TlsSection

HOME_ASSISTANT = "homeassistant"
"""Usual first level of the topics of Home Assistant's discovery."""


class MqttPublish(Section, frozen=True, kw_only=True):
    """Variables that are published, on change or every *every_ms*."""

    of: str | tuple[str, ...]
    every_ms: Milliseconds = 0

    SHORT: ClassVar[str] = "of"

    @property
    def patterns(self) -> tuple[str, ...]:
        """Names and patterns of *of*."""
        return (self.of,) if isinstance(self.of, str) else self.of


class SparkplugSection(Section, frozen=True, kw_only=True):
    """Edge node of Sparkplug B; without *node* it has the name of the plant."""

    group: str
    node: str = ""

    SHORT: ClassVar[str] = "group"


class MqttSection(Section, frozen=True, kw_only=True):
    """Values by MQTT; *broker* is a URL, or the network of a broker of a station."""

    broker: str
    user: str = ""
    password_file: str = ""
    tls: TlsSection | None = None
    client_id: str = ""
    topic: str = "{plant}/{station}/{variable}"
    publish: tuple[MqttPublish, ...] = (MqttPublish(of="*/*"),)
    period_ms: Annotated[int, Meta(ge=10, le=60_000)] = 100
    commands: tuple[str, ...] = ()
    qos: Annotated[int, Meta(ge=0, le=2)] = 0
    retain: bool = True
    has_json: bool = msgspec.field(name="json", default=True)
    home_assistant: bool | str = False
    sparkplug: SparkplugSection | None = None

    SHORT: ClassVar[str] = "broker"
    KEY: ClassVar[str] = "mqtt"

    @property
    def discovery(self) -> str:
        """First level of the topics of Home Assistant's discovery, empty without it."""
        if isinstance(self.home_assistant, str):
            return self.home_assistant
        return HOME_ASSISTANT if self.home_assistant else ""


class MqttBridgeSpec(msgspec.Struct, frozen=True):
    """Section with its broker, for the bridge."""

    section: MqttSection
    broker: MqttSpec
