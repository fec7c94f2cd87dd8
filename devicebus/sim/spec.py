"""A simulated bus as data: what bus files describe and devices are built from.

Plain structs without behaviour, so that any loader can make them.  Units are in the names.
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
Value: TypeAlias = bool | int | float | str


class DeviceKind(Enum):
    """Which builder of ``devicebus.sim.devices`` makes it."""

    COUPLER = "coupler"
    DIGITAL = "digital"
    ANALOGUE = "analogue"
    DRIVE = "drive"
    GENERIC = "generic"
    ESI = "esi"


class AccessKind(Enum):
    """Rights of an entry, by state where they differ."""

    READ = "ro"
    WRITE = "wo"
    READ_WRITE = "rw"
    CONFIGURATION = "rw-preop"


class ChannelSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One input or output of the process data, and the entry that holds it."""

    name: str
    type: str = "BOOL"
    object: str = ""
    """Such as ``0x6041:0``; left out, the next of 0x6000 for inputs, of 0x7000 for outputs;
    ``0`` for padding that has no entry."""
    value: Value = 0
    noise: float = 0.0
    """Inputs: largest deviation from *value*, in steps of the type."""
    values: tuple[float, ...] = ()
    """Inputs: what they show one after the other, again and again."""
    csv: str = ""
    """Inputs: the same from a file with one value a line."""
    follows: str = ""
    """Inputs: the output of this slave that they show."""
    bits: Annotated[int, Meta(ge=0, le=255)] = 0
    """In the PDO; 0 for those of its type."""
    pdo: U16 = 0
    """The PDO that maps it; left out, 0x1A00 for inputs and 0x1600 for outputs."""
    assigned: bool = True
    """Whether that PDO is part of the process data until a master assigns others."""
    period_ms: Annotated[int, Meta(ge=1, le=3_600_000)] = 10
    """How long each value of *values*, of *csv* or of the noise lasts."""


class EntrySpec(msgspec.Struct, frozen=True, kw_only=True):
    """One subindex of an object of its own."""

    subindex: U8
    name: str
    type: str
    value: Value | None = None
    access: AccessKind = AccessKind.READ_WRITE
    minimum: float | None = None
    maximum: float | None = None


class ObjectSpec(msgspec.Struct, frozen=True, kw_only=True):
    """An object: a variable with *type*, or a record with *entries*."""

    index: U16
    name: str
    type: str = ""
    value: Value | None = None
    access: AccessKind = AccessKind.READ_WRITE
    entries: tuple[EntrySpec, ...] = ()
    minimum: float | None = None
    maximum: float | None = None


class FileSpec(msgspec.Struct, frozen=True, kw_only=True):
    """A file that FoE reads and writes."""

    name: str
    max_size: Size = 4 << 20
    content: str = ""
    password: U32 = 0
    access: AccessKind = AccessKind.READ_WRITE
    boot_only: bool = False
    not_in_boot: bool = False
    checksum: bool = False
    """Whether what is written must end with the CRC-32 of what is in front of it."""


class MailboxSpec(msgspec.Struct, frozen=True, kw_only=True):
    """The mailbox and its protocols; *size* bytes each way."""

    size: MailboxSize = 256
    coe: bool = True
    foe: bool = False
    soe: bool = False
    eoe: bool = False
    voe: bool = False
    aoe: bool = False


class ClockSpec(msgspec.Struct, frozen=True, kw_only=True):
    """The distributed clock."""

    drift_ppm: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0
    start_ns: Annotated[int, Meta(ge=0, le=(1 << 63) - 1)] = 0
    """What it shows when it is switched on."""
    needs_sync0: bool = False


class SlaveSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One slave; *after* names the slave that its port 0 is wired to, the one before if empty."""

    name: str
    kind: DeviceKind
    vendor: U32 = 0x0000_0E5A
    product: U32 = 0
    """0: the number of the kind."""
    revision: U32 = 0x0001_0000
    serial: U32 = 0
    alias: U16 = 0
    after: str = ""
    port: Port = 1
    """Of the slave before."""
    mailbox: MailboxSpec | None = MailboxSpec()
    clock: ClockSpec | None = ClockSpec()
    boot: bool = True
    axes: Annotated[int, Meta(ge=1, le=8)] = 1
    """Kind ``drive``: how many axes it has."""
    inputs: tuple[ChannelSpec, ...] = ()
    outputs: tuple[ChannelSpec, ...] = ()
    objects: tuple[ObjectSpec, ...] = ()
    files: tuple[FileSpec, ...] = ()
    esi: str = ""
    """Kind ``esi``: the file of the vendor, beside the bus file."""


class FaultKind(Enum):
    """What can go wrong; what each needs beside its kind is in docs/simulator.md."""

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
    """One fault, from *at_ms* after the start for *for_ms*; without an end it stays."""

    kind: FaultKind
    slave: str = ""
    at_ms: Annotated[int, Meta(ge=0, le=86_400_000)] = 0
    for_ms: Annotated[int, Meta(ge=1, le=86_400_000)] | None = None
    every: Annotated[int, Meta(ge=1, le=1_000_000)] = 1
    """Frames: every how many-th is hit."""
    delay_us: Annotated[int, Meta(ge=0, le=10_000_000)] = 0
    object: str = ""
    code: U32 = 0
    """SDO abort code, AL status code, FoE error code, or error code of an emergency."""
    axis: Annotated[int, Meta(ge=0, le=7)] = 0
    """Of a drive, for its emergency."""
    state: str = ""
    drift_ppm: Annotated[float, Meta(ge=-1000, le=1000)] = 0.0


class BusSpec(msgspec.Struct, frozen=True, kw_only=True):
    """A segment."""

    bus: str
    slaves: tuple[SlaveSpec, ...]
    ring: bool = False
    """Whether the last slave's next port leads back to the master."""
    cable_ns: Annotated[int, Meta(ge=0, le=1_000_000)] = 50
    faults: tuple[FaultSpec, ...] = ()
