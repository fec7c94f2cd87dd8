"""Sections and keys of a plant file; docs/plant-file.md explains every key.

Types and ranges only: the ``check_`` functions check references between parts of the file.
Units are in the names.  Every section knows its path in the file, for findings.
"""

from __future__ import annotations

from enum import IntEnum, StrEnum
from typing import Annotated, Any, ClassVar, TypeAlias

import msgspec
from msgspec import Meta

from eap.ams.spec import Role
from eap.ids import NetId
from eap.od.slave_config import RevisionRule, StateTimeouts, Watchdogs
from eap.pd.spec import (
    Authentication,
    BusTarget,
    LengthCheck,
    OnChangeSpec,
    PortKind,
    Source,
    Substitute,
    Target,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    Wake,
)

# Ranges of the wire fields (PD id, version) and of the dictionary's entries: a file that loads fits
# both.
U16 = Annotated[int, Meta(ge=0, le=0xFFFF)]
U32 = Annotated[int, Meta(ge=0, le=0xFFFF_FFFF)]
Divider = Annotated[int, Meta(ge=1, le=0xFFFF)]
Milliseconds = Annotated[int, Meta(ge=0, le=0xFFFF_FFFF)]
DeviceCycle = Annotated[int, Meta(ge=100, le=60_000_000)]
FrameTimeout = Annotated[int, Meta(ge=2_000, le=10_000_000)]
FrameRetries = Annotated[int, Meta(ge=0, le=20)]
Period = Annotated[int, Meta(ge=1, le=0xFFFF_FFFF)]
MAX_BITS = 8 * 0xFFFF
"""Size of the largest variable."""
MAX_ANSWER_MS = 600_000
"""Largest timeout of an answer."""
BitOffset = Annotated[int, Meta(ge=0, le=MAX_BITS - 1)]
Plain: TypeAlias = bool | int | float | str | list[Any] | dict[str, Any]


INVALID_NET_ID = NetId(b"")
"""Placeholder for an invalid NetID, which is a finding of its own."""


class Section(msgspec.Struct, frozen=True, kw_only=True):
    """Base of all sections; *at* is the section's path and no key of the file."""

    at: str = ""

    SHORT: ClassVar[str] = ""
    """Key of a scalar that replaces the section (short form)."""


class VlanSection(Section, frozen=True):
    """The tag of an Ethernet port's frames."""

    # 802.1Q reserves 4095; 0 would be a priority tag without a VLAN.
    id: Annotated[int, Meta(ge=1, le=4094)]
    priority: Annotated[int, Meta(ge=0, le=7)] = 0


class GatewayLimits(Section, frozen=True):
    """Limits of a mailbox gateway."""

    in_flight: Annotated[int, Meta(ge=1, le=1024)] = 32
    rate: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    clients: Annotated[int, Meta(ge=1, le=0xFFFF)] = 256


class GatewaySection(Section, frozen=True):
    """The mailbox gateway of a bus port; the short form is ``enabled``."""

    enabled: bool = True
    port: Annotated[int, Meta(ge=1, le=0xFFFF)] | None = None
    answer_ms: Annotated[int, Meta(ge=10, le=MAX_ANSWER_MS)] = 900
    silent: bool = False
    full: bool = False
    padded: bool = False
    addresses: dict[str, Plain] = {}
    limits: GatewayLimits = GatewayLimits()

    SHORT: ClassVar[str] = "enabled"


class StartupSection(Section, frozen=True):
    """A start-up write of a slave: an SDO or an IDN, with a value or data."""

    transition: str | tuple[str, ...] = "PS"
    sdo: str = ""
    idn: str = ""
    drive: Annotated[int, Meta(ge=0, le=7)] = 0
    value: Plain | None = None
    type: str = ""
    data: str = ""
    complete: bool = False
    comment: str = ""


class SyncSection(Section, frozen=True):
    """SYNC0 or SYNC1 of a slave; without a cycle it follows the bus."""

    cycle_us: Annotated[int, Meta(ge=1, le=4_000_000)] | None = None
    shift_us: Annotated[float, Meta(ge=-4_000_000, le=4_000_000)] = 0.0


class SlaveSection(Section, frozen=True):
    """Configuration of a slave by its master; a key that is left out changes nothing."""

    optional: bool | None = None
    group: str | None = None
    revision: U32 | None = None
    revision_rule: RevisionRule | None = None
    serial: U32 | None = None
    alias: U16 | None = None
    identification: str | None = None
    pdos: tuple[str, ...] | dict[str, tuple[str, ...]] | None = None
    mapping: dict[str, tuple[str, ...]] | None = None
    startup: tuple[StartupSection, ...] = ()
    dc: str | None = None
    sync0: SyncSection | None = None
    sync1: SyncSection | None = None
    activate: U16 | None = None
    watchdog: Watchdogs | None = None
    timeouts: StateTimeouts | None = None


class EoeKind(StrEnum):
    """Treatment of Ethernet frames of slaves."""

    TAP = "tap"
    """They go to a TAP interface of the host, and to other slaves."""


class EoeSlaveSection(Section, frozen=True):
    """A slave that is connected by EoE, with its IP settings; the short form is ``kind``."""

    kind: EoeKind = EoeKind.TAP
    ip: str = ""
    gateway: str = ""
    dns: str = ""
    name: str = ""
    mac: str = ""

    SHORT: ClassVar[str] = "kind"


class EoeSection(Section, frozen=True):
    """EoE of a bus port; the short form is ``kind``."""

    kind: EoeKind = EoeKind.TAP
    interface: str = ""
    address: str = ""
    slaves: dict[str, EoeSlaveSection] = {}

    SHORT: ClassVar[str] = "kind"


class PortSlaveSection(SlaveSection, frozen=True):
    """Configuration of a slave in a plant file, with what concerns this host."""

    eoe: EoeSlaveSection | None = None


class PortSection(Section, frozen=True):
    """A port; the NetID of an EAP port is the publisher ID of its frames.

    *interface* and *bus* name bus files by their path from the plant file on.
    """

    name: str
    kind: PortKind
    interface: str
    net_id: NetId
    vlan: VlanSection | None = None
    join: tuple[str, ...] = ()
    broadcast: bool = False
    tcp: bool = False
    wake: Wake = Wake.CYCLE
    eap_sm: bool = False
    length: LengthCheck = LengthCheck.STRICT
    profile: U16 = 0
    ams: bool = True
    mac: str = ""
    bus: str = ""
    target: BusTarget = BusTarget.OP
    clocks: bool = False
    frame_timeout_us: FrameTimeout = 1_000_000
    frame_retries: FrameRetries = 4
    redundant: str = ""
    lock_cycle: bool | None = None
    sync_lead_us: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    gateway: GatewaySection = GatewaySection()
    slaves: dict[str, PortSlaveSection] = {}
    eoe: EoeSection | None = None

    @property
    def vlan_id(self) -> int:
        """VID of the frames, 0 if they have no tag."""
        return self.vlan.id if self.vlan else 0

    EAP_KEYS: ClassVar[tuple[str, ...]] = (
        "vlan",
        "join",
        "broadcast",
        "tcp",
        "wake",
        "eap_sm",
        "length",
        "profile",
        "ams",
        "mac",
    )
    BUS_KEYS: ClassVar[tuple[str, ...]] = (
        "bus",
        "target",
        "clocks",
        "frame_timeout_us",
        "frame_retries",
        "redundant",
        "lock_cycle",
        "sync_lead_us",
        "gateway",
        "slaves",
        "eoe",
    )


class VariableSection(Section, frozen=True):
    """A variable; the short form in the file is its type."""

    type: str
    unit: str = ""
    comment: str = ""
    default: Plain | None = None

    SHORT: ClassVar[str] = "type"


class MemberSection(Section, frozen=True):
    """A member of a struct; the short form is its type."""

    type: str
    offset: Annotated[int, Meta(ge=0, le=0xFFFF)] | None = None
    bit: Annotated[int, Meta(ge=0, le=7)] = 0
    comment: str = ""

    SHORT: ClassVar[str] = "type"


class Packing(IntEnum):
    """Largest alignment of the members of a struct, in bytes; 1 leaves no gaps."""

    ONE = 1
    TWO = 2
    FOUR = 4
    EIGHT = 8


class TypeSection(Section, frozen=True):
    """A type of the plant; the short form is the type that it is another name of."""

    alias: str = ""
    base: str = ""
    values: dict[str, int] = {}
    members: dict[str, MemberSection] = {}
    union: dict[str, MemberSection] = {}
    extends: str = ""
    pack: Packing = Packing.EIGHT
    size: Annotated[int, Meta(ge=0, le=0xFFFF)] = 0

    SHORT: ClassVar[str] = "alias"
    FORMS: ClassVar[tuple[str, ...]] = ("alias", "values", "members", "union")


class FrameSection(Section, frozen=True):
    """A frame to send."""

    name: str
    port: str
    to: str
    divider: Divider | None = None
    modulo: U16 | None = None
    monitor_interval_ms: Milliseconds = 0
    monitor_ip: str = ""
    sign: bool = False
    changeable: bool = False

    def spec(self, destination: str, pds: tuple[TxPdSpec, ...] = (), mac: str = "") -> TxFrameSpec:
        """Return the specification of the frame to *destination*, with *pds* in it."""
        return TxFrameSpec(
            name=self.name,
            port=self.port,
            destination=destination,
            pds=pds,
            divider=self.divider or 0,
            modulo=self.modulo or 0,
            changeable=self.changeable,
            mac=mac,
            monitor_interval_ms=self.monitor_interval_ms,
            monitor_ip=self.monitor_ip,
            sign=self.sign,
        )


class PublishSection(Section, frozen=True):
    """A PD to send in a frame."""

    name: str
    frame: str
    id: U16
    variables: tuple[str, ...]
    version: U16 = 0
    cycle_us: Period | None = None
    divider: Divider | None = None
    modulo: U16 | None = None
    on_change: OnChangeSpec | None = None
    event: bool = False
    poll: str = ""
    changeable: bool = False

    def spec(self) -> TxPdSpec:
        """Return the specification of the PD."""
        trigger = TriggerSpec(
            cycle_us=self.cycle_us or 0,
            divider=self.divider or 0,
            modulo=self.modulo or 0,
            on_change=self.on_change,
            event=self.event,
        )
        return TxPdSpec(
            name=self.name,
            pd_id=self.id,
            variables=self.variables,
            version=self.version,
            trigger=trigger,
            poll_request=self.poll,
            changeable=self.changeable,
        )


class FromSection(Section, frozen=True):
    """A publisher given by NetID and PD id."""

    publisher: str
    id: U16
    cycle_us: Period | None = None
    step: Divider | None = None


ANY_SOURCE = "any"
"""Source of a subscription that accepts frames from any address."""


class SubscribeSection(Section, frozen=True):
    """A PD to receive."""

    name: str
    port: str
    source: FromSection | str = msgspec.field(name="from")
    variables: dict[str, VariableSection] | None = None
    version: U16 | None = None
    ignore_version: bool = False
    timeout_ms: Milliseconds = 0
    substitute: Substitute = Substitute.HOLD
    foreign: bool = False
    poll: str = ""
    changeable: bool = False
    sender: str = msgspec.field(default="", name="source")
    """Required source address of the frames, or ANY_SOURCE; by default that of the publisher."""
    auth: Authentication = Authentication.OFF


class LinkSection(Section, frozen=True):
    """A link: one variable of a station follows another."""

    source: str = msgspec.field(name="from")
    target: str = msgspec.field(name="to")
    from_bit: BitOffset | None = None
    to_bit: BitOffset | None = None
    bits: Annotated[int, Meta(ge=1, le=MAX_BITS)] | None = None
    scale: float | None = None
    offset: float | None = None
    swap: bool = False


class TlsSection(Section, frozen=True):
    """TLS of a connection; files by their paths from the plant file on."""

    ca: str = ""
    certificate: str = ""
    key: str = ""
    check_name: bool = True
    fingerprint: str = ""
    identity: str = ""
    password_file: str = ""

    ROUTE_KEYS: ClassVar[tuple[str, ...]] = ("fingerprint", "identity", "password_file")
    """Keys of a route by Secure ADS that a broker has not."""


class SecureAdsSection(Section, frozen=True):
    """Secure ADS of a station; files by their paths from the plant file on."""

    certificate: str
    key: str
    ca: str = ""
    peers: dict[str, str] = {}
    psk: dict[str, str] = {}
    port: U16 = 8016


class RouteSection(Section, frozen=True):
    """A route of a station, or with *mqtt* a broker by which it reaches other stations."""

    to: str = ""
    via: str = ""
    port: str = ""
    ams_tcp: str = ""
    net_id: str = ""
    octets: Annotated[int, Meta(ge=4, le=6)] | None = None
    virtual: str = ""
    unidirectional: bool = False
    timeout_ms: Annotated[int, Meta(ge=0, le=MAX_ANSWER_MS)] = 0
    probe: bool = True
    mqtt: str = ""
    network: str = ""
    user: str = ""
    password_file: str = ""
    tls: TlsSection | None = None
    client_id: str = ""
    no_retain: bool = False
    qos: Annotated[int, Meta(ge=0, le=2)] = 0
    prefix: bool = False

    ROUTE_KEYS: ClassVar[tuple[str, ...]] = (
        "to",
        "via",
        "port",
        "ams_tcp",
        "net_id",
        "octets",
        "virtual",
        "timeout_ms",
        "probe",
        "tls",
    )
    MQTT_KEYS: ClassVar[tuple[str, ...]] = (
        "network",
        "user",
        "password_file",
        "tls",
        "client_id",
        "no_retain",
        "qos",
        "prefix",
    )


class AccessSection(Section, frozen=True):
    """Rule that allows or denies access."""

    name: str = ""
    allow: tuple[str, ...] = ()
    deny: tuple[str, ...] = ()
    networks: tuple[str, ...] = msgspec.field(name="from", default=())
    net_ids: tuple[str, ...] = ()
    transports: tuple[str, ...] = ()
    doors: tuple[str, ...] = ()
    """Former name of *transports*, which older plant files use."""
    to: tuple[str, ...] = ()
    objects: tuple[str, ...] = ()
    roles: tuple[Role, ...] = ()


class UserSection(Section, frozen=True):
    """User that may add routes from other hosts; without a file one of the plant's users."""

    name: str
    password_file: str = ""


class StationSection(Section, frozen=True):
    """A station: its router, ports, variables, and the PDs it sends and receives."""

    name: str
    net_id: NetId
    ports: tuple[PortSection, ...]
    cycle_us: DeviceCycle | None = None
    phase_us: Annotated[int, Meta(ge=0, le=60_000_000)] | None = None
    variables: dict[str, VariableSection] = {}
    sources: dict[str, Source] = {}
    targets: dict[str, Target] = {}
    frames: tuple[FrameSection, ...] = ()
    publish: tuple[PublishSection, ...] = ()
    subscribe: tuple[SubscribeSection, ...] = ()
    links: tuple[LinkSection, ...] = ()
    routes: tuple[RouteSection, ...] = ()
    learn: bool | tuple[str, ...] = True
    access: tuple[AccessSection, ...] = ()
    users: tuple[UserSection, ...] = ()
    secure_ads: SecureAdsSection | None = None
    pd_keys: str = ""

    @property
    def eap_ports(self) -> list[str]:
        """Names of the EAP ports."""
        return [port.name for port in self.ports if port.kind is PortKind.EAP]


class Defaults(Section, frozen=True):
    """Defaults of stations."""

    cycle_us: DeviceCycle = 10_000
    pd_keys: str = ""


class RealtimeSection(Section, frozen=True):
    """Pace of the engine."""

    groups: Annotated[int, Meta(ge=1, le=64)] | None = None
    spin: bool = False


class AuditMode(StrEnum):
    """Treatment of changes that the audit cannot record."""

    OPTIONAL = "optional"
    """The change is made; lost audit lines are counted."""
    REQUIRED = "required"
    """The change is refused."""


class PlantAccess(Section, frozen=True):
    """Rules for the access to all stations; each has rules of its own beside them."""

    audit: AuditMode = AuditMode.OPTIONAL
    operators: tuple[str, ...] = ()
    """Variables that operators set by the control socket."""
