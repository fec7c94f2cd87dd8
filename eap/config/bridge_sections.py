"""Sections of bridges in a plant file: ``s7``, ``modbus`` and ``mqtt``.

The processes of the first two get :class:`S7Bridge` and :class:`ModbusBridge`, with computed
addresses of all that they serve.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from eap.ams.spec import MqttSpec
from eap.codec.modbus import MODBUS_PORT
from eap.codec.s7 import S7_PORT
from eap.config.structs import Milliseconds, Section, TlsSection
from eap.pd.spec import Substitute

TcpPort = Annotated[int, Meta(ge=1, le=0xFFFF)]
FieldPeriod = Annotated[int, Meta(ge=10, le=3_600_000)]
UnitId = Annotated[int, Meta(ge=0, le=255)]


class Order(StrEnum):
    """Order of the words of a number, or of the bytes of a register."""

    BIG = "big"
    """The highest first."""
    LITTLE = "little"


class ControllerSection(Section, frozen=True, kw_only=True):
    """A controller that variables are read from and written to."""

    host: str
    every_ms: FieldPeriod = 100
    timeout_ms: FieldPeriod = 1000
    substitute: Substitute = Substitute.HOLD

    SHORT: ClassVar[str] = "host"


class S7Controller(ControllerSection, frozen=True, kw_only=True):
    """An S7 controller."""

    port: TcpPort = S7_PORT
    rack: Annotated[int, Meta(ge=0, le=7)] = 0
    slot: Annotated[int, Meta(ge=0, le=31)] = 1


class ModbusController(ControllerSection, frozen=True, kw_only=True):
    """A Modbus TCP device, or one behind a gateway."""

    port: TcpPort = MODBUS_PORT
    unit: UnitId = 1
    word_order: Order = Order.BIG
    byte_order: Order = Order.BIG
    gap: Annotated[int, Meta(ge=0, le=120)] = 16


class ServedSection(Section, frozen=True, kw_only=True):
    """Variables that are served, at the next free address or from *first* on."""

    of: str
    first: str = msgspec.field(default="", name="address")
    type: str = ""
    write: bool = False

    SHORT: ClassVar[str] = "of"


class FieldServerSection(Section, frozen=True, kw_only=True):
    """Server of variables of this plant."""

    listen: str
    every_ms: FieldPeriod = 100


class S7ServerSection(FieldServerSection, frozen=True, kw_only=True):
    """Data blocks, by their numbers."""

    listen: str = f"127.0.0.1:{S7_PORT}"
    blocks: dict[str, tuple[ServedSection, ...]]


class ModbusServerSection(FieldServerSection, frozen=True, kw_only=True):
    """Coils and registers."""

    listen: str = f"127.0.0.1:{MODBUS_PORT}"
    unit: UnitId = 1
    word_order: Order = Order.BIG
    byte_order: Order = Order.BIG
    coil: tuple[ServedSection, ...] = ()
    discrete: tuple[ServedSection, ...] = ()
    input: tuple[ServedSection, ...] = ()
    holding: tuple[ServedSection, ...] = ()


class S7Section(Section, frozen=True, kw_only=True):
    """S7 controllers, and data blocks that are served."""

    controllers: dict[str, S7Controller] = msgspec.field(default_factory=dict)
    server: S7ServerSection | None = None


class ModbusSection(Section, frozen=True, kw_only=True):
    """Modbus devices, and registers that are served."""

    controllers: dict[str, ModbusController] = msgspec.field(default_factory=dict)
    server: ModbusServerSection | None = None


class ServedItem(msgspec.Struct, frozen=True):
    """A variable that is served, with its computed address.

    Attributes:
        name: ``STATION/VARIABLE``.
        kind: Text of its type.
        address: As in a plant file.
        type: Type on the other side, empty for that of the variable.
        write: True if clients may write it.
    """

    name: str
    kind: str
    address: str
    type: str = ""
    write: bool = False


class FieldServer(msgspec.Struct, frozen=True):
    """Server of a bridge, with all addresses."""

    listen: str
    every_ms: int
    items: tuple[ServedItem, ...]
    unit: int = 0
    words_swapped: bool = False
    bytes_swapped: bool = False


class S7Bridge(msgspec.Struct, frozen=True):
    """Handover of the bridge ``s7``."""

    controllers: dict[str, S7Controller]
    server: FieldServer | None = None


class ModbusBridge(msgspec.Struct, frozen=True):
    """Handover of the bridge ``modbus``."""

    controllers: dict[str, ModbusController]
    server: FieldServer | None = None


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
