"""Description of a simulated bus: content of bus files, from which devices are built.

Plain structs without behaviour, for any loader.  Names contain the units.
"""

from __future__ import annotations

from enum import Enum
from typing import Annotated, TypeAlias

import msgspec
from msgspec import Meta

U8 = Annotated[int, Meta(ge=0, le=0xFF)]
U16 = Annotated[int, Meta(ge=0, le=0xFFFF)]
U32 = Annotated[int, Meta(ge=0, le=0xFFFF_FFFF)]
Port = Annotated[int, Meta(ge=1, le=3)]
MailboxSize = Annotated[int, Meta(ge=32, le=1486)]
Size = Annotated[int, Meta(ge=1, le=16 << 20)]
DEFAULT_VENDOR = 0x0000_0E5A
Value: TypeAlias = bool | int | float | str


class DeviceKind(Enum):
    """Kind of a device: selects a builder of ``devicebus.sim.devices``."""

    COUPLER = "coupler"
    DIGITAL = "digital"
    ANALOGUE = "analogue"
    DRIVE = "drive"
    GENERIC = "generic"
    ESI = "esi"


class ProfileKind(Enum):
    """Behaviour of a device from an ESI file."""

    AUTO = "auto"
    """That of a drive if it has the objects of one, 0x6040 and 0x6041."""
    DRIVE = "drive"
    NONE = "none"


class AccessKind(Enum):
    """Access rights of an entry or a file, as a bus file writes them."""

    READ = "ro"
    WRITE = "wo"
    READ_WRITE = "rw"
    CONFIGURATION = "rw-preop"


class ChannelSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Input or output of the process data, with the entry that holds it."""

    name: str
    type: str = "BOOL"
    object: str = ""
    """Such as ``0x6041:0``; left out, the next of 0x6000 for inputs, of 0x7000 for outputs;
    ``0`` for padding that has no entry."""
    value: Value = 0
    noise: float = 0.0
    """Inputs: largest deviation from *value*, in steps of the type."""
    values: tuple[float, ...] = ()
    """Inputs: sequence of values, repeated."""
    csv: str = ""
    """Inputs: sequence from a file with one value per line."""
    follows: str = ""
    """Inputs: name of an output of this slave whose value they take."""
    bits: Annotated[int, Meta(ge=0, le=255)] = 0
    """Bit length in the PDO; 0 for that of its type."""
    pdo: U16 = 0
    """PDO that maps it; by default 0x1A00 for inputs and 0x1600 for outputs."""
    assigned: bool = True
    """True if that PDO is assigned by default."""
    period_ms: Annotated[int, Meta(ge=1, le=3_600_000)] = 10
    """Duration of each value of *values*, *csv* or noise."""


class EntrySpec(msgspec.Struct, frozen=True, kw_only=True):
    """Subindex of an ObjectSpec."""

    subindex: U8
    name: str
    type: str
    value: Value | None = None
    access: AccessKind = AccessKind.READ_WRITE
    minimum: float | None = None
    maximum: float | None = None


class ObjectSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Object: a variable with *type*, or a record with *entries*."""

    index: U16
    name: str
    type: str = ""
    value: Value | None = None
    access: AccessKind = AccessKind.READ_WRITE
    entries: tuple[EntrySpec, ...] = ()
    minimum: float | None = None
    maximum: float | None = None
    mappable: bool = False
    """True if a master may map it: as an input if it is read-only, else as an output."""


class FileSpec(msgspec.Struct, frozen=True, kw_only=True):
    """File for FoE."""

    name: str
    max_size: Size = 4 << 20
    content: str = ""
    password: U32 = 0
    access: AccessKind = AccessKind.READ_WRITE
    boot_only: bool = False
    not_in_boot: bool = False
    checksum: bool = False
    """True if written content must end with the CRC-32 of the bytes before it."""


class MailboxSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Mailbox and its protocols; *size* in bytes for each direction."""

    size: MailboxSize = 256
    coe: bool = True
    foe: bool = False
    soe: bool = False
    eoe: bool = False
    voe: bool = False
    aoe: bool = False


class ClockSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Distributed clock."""

    drift_ppm: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0
    start_ns: Annotated[int, Meta(ge=0, le=(1 << 63) - 1)] = 0
    """Local time at power-on."""
    needs_sync0: bool | None = None
    """True if it refuses OP without SYNC0; None for what its ESI file says, or not."""


class SlaveSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Slave; *after* names the slave at its port 0, by default the one before."""

    name: str
    kind: DeviceKind
    vendor: U32 = DEFAULT_VENDOR
    """Kind ``esi``: the default stands for any vendor."""
    product: U32 = 0
    """0: default of the kind."""
    revision: U32 | None = None
    """None: 0x00010000, or that of the ESI file."""
    serial: U32 = 0
    alias: U16 = 0
    after: str = ""
    port: Port = 1
    """Port of the slave named by *after*."""
    mailbox: MailboxSpec | None = MailboxSpec()
    clock: ClockSpec | None = ClockSpec()
    boot: bool = True
    axes: Annotated[int, Meta(ge=1, le=8)] = 1
    """Kind ``drive``: number of axes."""
    inputs: tuple[ChannelSpec, ...] = ()
    outputs: tuple[ChannelSpec, ...] = ()
    objects: tuple[ObjectSpec, ...] = ()
    files: tuple[FileSpec, ...] = ()
    esi: str = ""
    """Kind ``esi``: ESI file of the vendor, or a folder of such files; relative to the bus file."""
    device: str = ""
    """Kind ``esi``: type of the device in the file, such as ``EL2004``."""
    modules: tuple[int | str | None, ...] | None = None
    """Kind ``esi``: idents or names of the modules in its slots; None for its defaults."""
    profile: ProfileKind = ProfileKind.AUTO
    """Kind ``esi``: behaviour of the device."""
    pdo_names: dict[str, str] = {}
    """Names of PDOs, by index; they come before the names of their entries."""


class FaultKind(Enum):
    """Kind of a fault; docs/simulator.md lists the fields that each kind needs."""

    LOSS = "loss"
    DELAY = "delay"
    CORRUPT = "corrupt"
    WKC = "wkc"
    CUT = "cut"
    POWER = "power"
    MAILBOX = "mailbox"
    FOE = "foe"
    SDO = "sdo"
    EEPROM = "eeprom"
    TX_PDO = "tx-pdo"
    EMERGENCY = "emergency"
    AL_ERROR = "al-error"
    REFUSE = "refuse"
    DRIFT = "drift"


class FaultSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Fault from *at_ms* after the start for *for_ms*; without *for_ms* it stays."""

    kind: FaultKind
    slave: str = ""
    at_ms: Annotated[int, Meta(ge=0, le=86_400_000)] = 0
    for_ms: Annotated[int, Meta(ge=1, le=86_400_000)] | None = None
    every: Annotated[int, Meta(ge=1, le=1_000_000)] = 1
    """Frames: period, in frames."""
    delay_us: Annotated[int, Meta(ge=0, le=10_000_000)] = 0
    object: str = ""
    code: U32 = 0
    """SDO abort code, AL status code, FoE error code, or error code of an emergency."""
    second: bool = False
    """Cut: the second line of a ring to the master instead of the cable of a slave."""
    axis: Annotated[int, Meta(ge=0, le=7)] = 0
    """Axis of a drive, for its emergency."""
    state: str = ""
    drift_ppm: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0


class BusSpec(msgspec.Struct, frozen=True, kw_only=True):
    """Simulated bus."""

    bus: str
    slaves: tuple[SlaveSpec, ...]
    ring: bool = False
    """True if the last slave's next port is connected to the master."""
    esi: str = ""
    """ESI file or folder of the slaves of kind ``esi`` without their own."""
    cable_ns: Annotated[int, Meta(ge=0, le=1_000_000)] = 50
    faults: tuple[FaultSpec, ...] = ()
