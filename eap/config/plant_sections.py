"""Top level of a plant file."""

from __future__ import annotations

import msgspec

from eap.config.bridge_sections import ModbusSection, MqttSection, S7Section
from eap.config.opcua_sections import OpcUaSection
from eap.config.record_sections import RecordSection
from eap.config.structs import (
    Defaults,
    PlantAccess,
    RealtimeSection,
    Section,
    StationSection,
    TypeSection,
)
from eap.config.users import PlantUserSection
from eap.config.web_sections import MetricsSection, WebSection


class HostSection(Section, frozen=True, kw_only=True):
    """A computer of the plant, and the stations that it runs."""

    name: str
    address: str
    stations: tuple[str, ...]
    addresses: tuple[str, ...] = ()
    user: str = ""
    interfaces: dict[str, str] = msgspec.field(default_factory=dict)

    def interface(self, name: str) -> str:
        """Return the name that this host has for the Ethernet interface *name* of the file."""
        return self.interfaces.get(name, name)


class PlantFile(Section, frozen=True, kw_only=True):
    """The whole file; top-level keys that begin with ``x-`` are free for anchors."""

    plant: str
    stations: tuple[StationSection, ...]
    defaults: Defaults = Defaults()
    realtime: RealtimeSection = RealtimeSection()
    access: PlantAccess = PlantAccess()
    users: tuple[PlantUserSection, ...] = ()
    types: dict[str, TypeSection] | tuple[str | dict[str, TypeSection], ...] = msgspec.field(
        default_factory=dict
    )
    hosts: tuple[HostSection, ...] = ()
    web: WebSection | None = None
    metrics: MetricsSection | None = None
    record: tuple[RecordSection, ...] = ()
    mqtt: MqttSection | None = None
    opcua: OpcUaSection | None = None
    s7: S7Section | None = None
    modbus: ModbusSection | None = None
