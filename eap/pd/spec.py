"""Specification of one station, complete and checked: the input of the engine.

A plant file and, later, an object dictionary both end in these records.  They hold names and plain
values only, so that they cross from the supervisor to the engine as JSON; times and sizes are in
the units their names say, and 0 means "off" where a field says so.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import StrEnum
from functools import lru_cache, partial
from typing import Annotated, Any, TypeVar

import msgspec

from eap.codec.datatypes import Plain
from eap.ids import InterfaceUri, NetId, decode_value, encode_value
from eap.od.slave_config import SlaveConfig

_U32 = Annotated[int, msgspec.Meta(ge=0, le=0xFFFF_FFFF)]


class Writer(StrEnum):
    """Writer of a variable; each has a region of the process image to itself."""

    ENGINE = "engine"
    """Received process data and the generators that run in the cycle."""
    SERVICES = "services"
    """Sources that need I/O: host measurements, CSV replay, controllers."""
    APPLICATION = "application"
    """User programs and ``eapctl pd set``."""


class Substitute(StrEnum):
    """Content of a subscription's variables after its time-out."""

    HOLD = "hold"
    ZERO = "zero"
    DEFAULT = "default"


class SpecRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all specifications."""


class VariableSpec(SpecRecord, frozen=True):
    """One variable; *type* as ``eap.codec.datatypes.parse`` reads it."""

    name: str
    type: str
    writer: Writer = Writer.APPLICATION
    default: Plain | None = None
    """Value at the start and, with Substitute.DEFAULT, after a time-out; None is all zero.

    Raw blocks take a string of hexadecimal digits.
    """
    unit: str = ""
    comment: str = ""


class CounterSource(SpecRecord, frozen=True, tag="counter", tag_field="kind"):
    """One *step* up in each device cycle, wrapping with the type."""

    variable: str
    step: int = 1


class RampSource(SpecRecord, frozen=True, tag="ramp", tag_field="kind"):
    """From *low* to *high* in *period_ms*, then again."""

    variable: str
    low: float
    high: float
    period_ms: float


class SineSource(SpecRecord, frozen=True, tag="sine", tag_field="kind"):
    """*offset* plus *amplitude* times the sine of a full turn in *period_ms*."""

    variable: str
    amplitude: float
    period_ms: float
    offset: float = 0.0


class RandomSource(SpecRecord, frozen=True, tag="random", tag_field="kind"):
    """Random bytes in each device cycle in which the variable is sent."""

    variable: str
    seed: int = 0


class Measure(StrEnum):
    """Measurement of this host; docs/plant-file.md gives the units."""

    LOAD1 = "load1"
    LOAD5 = "load5"
    LOAD15 = "load15"
    CPU_PERCENT = "cpu_percent"
    CPU_TIME = "cpu_time"
    MEMORY_TOTAL = "memory_total"
    MEMORY_AVAILABLE = "memory_available"
    MEMORY_USED = "memory_used"
    MEMORY_PERCENT = "memory_percent"
    RX_OCTETS = "rx_octets"
    TX_OCTETS = "tx_octets"
    RX_PACKETS = "rx_packets"
    TX_PACKETS = "tx_packets"
    UPTIME = "uptime"
    PROCESSES = "processes"
    CONTEXT_SWITCHES = "context_switches"
    TEMPERATURE = "temperature"


INTERFACE_MEASURES = frozenset(
    {Measure.RX_OCTETS, Measure.TX_OCTETS, Measure.RX_PACKETS, Measure.TX_PACKETS}
)
"""Measures whose argument is the name of a network interface."""


class HostSource(SpecRecord, frozen=True, tag="host", tag_field="kind"):
    """A measurement of this host, read from /proc; *argument* as the measure needs one."""

    variable: str
    measure: Measure
    argument: str = ""
    period_ms: int = 500


class CsvSource(SpecRecord, frozen=True, tag="csv", tag_field="kind"):
    """One *column* of *file*, a row every *period_ms*, from the start again at the end."""

    variable: str
    file: str
    column: str
    period_ms: int = 100


class S7Source(SpecRecord, frozen=True, tag="s7", tag_field="kind"):
    """A value in a data block of a *controller*, which the bridge ``s7`` reads."""

    variable: str
    controller: str
    address: str
    type: str = ""
    """Type there, if it is another one than that of the variable."""
    timeout_ms: _U32 = 0
    """Age at which the substitute applies; in a plant file 0 is that of the controller."""
    substitute: Substitute | None = None
    """In a plant file None is that of the controller."""


class ModbusSource(SpecRecord, frozen=True, tag="modbus", tag_field="kind"):
    """A value in registers of a *controller*, which the bridge ``modbus`` reads."""

    variable: str
    controller: str
    address: str
    type: str = ""
    timeout_ms: _U32 = 0
    substitute: Substitute | None = None


EngineSource = CounterSource | RampSource | SineSource | RandomSource
FieldSource = S7Source | ModbusSource
ServicesSource = HostSource | CsvSource | FieldSource
Source = EngineSource | ServicesSource


class S7Target(SpecRecord, frozen=True, tag="s7", tag_field="kind"):
    """A place in a data block of a *controller* that the bridge ``s7`` writes a variable to."""

    variable: str
    controller: str
    address: str
    type: str = ""


class ModbusTarget(SpecRecord, frozen=True, tag="modbus", tag_field="kind"):
    """Registers of a *controller* that the bridge ``modbus`` writes a variable to."""

    variable: str
    controller: str
    address: str
    type: str = ""


Target = S7Target | ModbusTarget


class OnChangeSpec(SpecRecord, frozen=True):
    """Send when the data differs from the data sent last."""

    timeout_ms: _U32 = 0
    """Send again though unchanged after this time; 0 never."""
    inhibit_us: _U32 = 0
    """Shortest gap between two frames sent for a change; 0 none."""


class TriggerSpec(SpecRecord, frozen=True):
    """Triggers of a TxPD; docs/triggers.md has the truth table.  All off: each device cycle."""

    cycle_us: int = 0
    divider: int = 0
    modulo: int = 0
    on_change: OnChangeSpec | None = None
    event: bool = False
    """Send when the application raises bit 1 of the PD's ``.VarCtrl``."""


REQUESTER = "requester"
"""Destination of a frame that only answers: the requester."""


class TxPdSpec(SpecRecord, frozen=True):
    """One PD to send: *variables* of this station, in PDO order."""

    name: str
    pd_id: int
    variables: tuple[str, ...]
    version: int = 0
    trigger: TriggerSpec = TriggerSpec()
    poll_request: str = ""
    """Name of the RxPD, of the same port, that requests it; all triggers are off then."""
    changeable: bool = False
    """True if its ID and poll request may be written in SafeOp and Op."""


class TxFrameSpec(SpecRecord, frozen=True):
    """One frame to send from *port* to *destination*.

    *destination* is a MAC address, an IPv4 address (``address[:port]``), ``tcp://address[:port]``
    or, on Ethernet, the NetID of a port; when all PDs are polled it is REQUESTER.  Polled PDs go in
    frames of their own, to the requester.
    """

    name: str
    port: str
    destination: str
    pds: tuple[TxPdSpec, ...]
    divider: int = 0
    modulo: int = 0
    changeable: bool = False
    """True if its destination may be written in SafeOp and Op."""
    mac: str = ""
    """MAC address behind a NetID; empty if it is to be learned from what that port sends."""
    monitor_interval_ms: int = 0
    """Interval of looking for the host at a unicast destination; 0 never."""
    monitor_ip: str = ""
    """Ethernet: IPv4 address of the subscriber, to probe for by ARP; empty leaves it unknown."""
    sign: bool = False
    """True if a last PD signs it with a key of the station."""


class SentVariableSpec(SpecRecord, frozen=True):
    """One variable as it is sent; *name* is that of the RxPD's variable, empty if it has none."""

    name: str
    type: str


class RxAlternateSpec(SpecRecord, frozen=True):
    """Another layout of a PD that is taken as well, while its sender changes from one to the other.

    Variables that it has in common with the RxPD are received; all others keep their values.
    """

    version: int
    variables: tuple[SentVariableSpec, ...]
    """Everything that is sent, in PDO order."""


class Authentication(StrEnum):
    """Treatment of the signature of frames with a PD."""

    OFF = "off"
    """It is not looked at."""
    COUNT = "count"
    """The data is taken; what is wrong is counted."""
    REQUIRED = "required"
    """Only data of a frame with a right signature is taken."""


class RxPdSpec(SpecRecord, frozen=True):
    """One PD to receive into *variables* of this station, in PDO order."""

    name: str
    port: str
    pd_id: int
    variables: tuple[str, ...]
    publisher: str = ""
    """NetID in dotted form; empty is any publisher."""
    version: int = 0
    ignore_version: bool = False
    timeout_ms: int = 0
    """Age at which the substitute applies; 0 never."""
    substitute: Substitute = Substitute.HOLD
    sender_cycle_us: int = 0
    """The sender's device cycle, 0 if unknown: needed for jitter, lateness and long gaps."""
    step: int = 0
    """Sender cycles between two of this PD, 0 if it has no fixed step: needed to count losses."""
    alternates: tuple[RxAlternateSpec, ...] = ()
    """Each with a version and size of its own."""
    poll_request: str = ""
    """Name of the TxPD, of the same port, that requests it; quality and time-out count from that.

    The step is 0 then.
    """
    changeable: bool = False
    """True if its ID, publisher and poll request may be written in SafeOp and Op."""
    source: str = ""
    """Address that its frames must come from, the publisher's: a MAC address on Ethernet, else an
    IPv4 address; empty takes frames from any."""
    auth: Authentication = Authentication.OFF


class PortKind(StrEnum):
    """Kind of a port: EAP to other stations or type 1 down to slaves."""

    EAP = "eap"
    BUS = "bus"


class Wake(StrEnum):
    """Moment at which received frames are taken."""

    CYCLE = "cycle"
    """At the start of the station's next cycle: the fewest wake-ups."""
    ARRIVAL = "arrival"
    """As they arrive: the shortest latency, at the price of a wake-up a frame."""


class BusEntrySpec(SpecRecord, frozen=True):
    """One entry of a slave's process data, in the order of its PDOs.

    *variable* is its name in the process image, empty for padding and for types not supported.
    """

    variable: str
    index: int
    subindex: int
    bit_length: int
    manager: int = 0
    """Sync manager that transfers it."""


class BusSlaveSpec(SpecRecord, frozen=True):
    """One slave that a bus is expected to have; None accepts any value."""

    name: str
    station: int
    """Station address: 1001 for the first in the line."""
    vendor: int
    product: int
    revision: int | None = None
    serial: int | None = None
    alias: int | None = None
    outputs: tuple[BusEntrySpec, ...] = ()
    inputs: tuple[BusEntrySpec, ...] = ()
    config: SlaveConfig = SlaveConfig()


class BusTarget(StrEnum):
    """The state to which the slaves of a bus are brought, and where they are kept."""

    INIT = "INIT"
    PREOP = "PREOP"
    SAFEOP = "SAFEOP"
    OP = "OP"


class BusPortSpec(SpecRecord, frozen=True):
    """Bus of a bus port: its slaves, their target state, and time-outs of frames."""

    file: str = ""
    """Absolute path of the bus file that describes it; empty if nothing is expected."""
    slaves: tuple[BusSlaveSpec, ...] = ()
    """In the order of the line; empty accepts any slaves, without variables."""
    target: BusTarget = BusTarget.OP
    clocks: bool = False
    """True if distributed clocks are set and kept together."""
    frame_timeout_us: int = 1_000_000
    """Upper limit of the time-out after which a frame is sent again."""
    frame_retries: int = 4
    """Times that a frame that is overdue is sent again."""
    redundant: str = ""
    """Interface of the second line to the other end of the slaves; empty without a ring."""
    lock_cycle: bool = False
    """True if the cycle of the station follows the reference clock of this bus."""
    sync_lead_us: int = 0
    """Time before SYNC0 at which frames then pass that clock; 0 for 30 % of the cycle."""
    simulated: str = ""
    """Digest of the simulated slaves in *file*; empty on other buses."""

    @property
    def has_sync(self) -> bool:
        """True if the clocks of its slaves depend on the cycle of the station."""
        return self.clocks or any(slave.config.sync is not None for slave in self.slaves)


class LinkSpec(SpecRecord, frozen=True):
    """In each cycle *target* gets the value of *source*, both variables of one station.

    Without scale, offset and swap bits are copied: *bits* of them (0: all of the source) from bit
    *source_bit* of the source to bit *target_bit* of the target.  Between numbers of different
    types, and with 0 bits, the value is converted.
    """

    source: str
    target: str
    source_bit: int = 0
    target_bit: int = 0
    bits: int = 0
    scale: float = 1.0
    """Numbers: the target is source times *scale* plus *offset*, within the limits of its type."""
    offset: float = 0.0
    swap: bool = False
    """True if the bytes are reversed on the way."""


class GatewayAddress(SpecRecord, frozen=True):
    """Target of a virtual mailbox address: one of the three."""

    address: int
    station: int = 0
    """Station address of a slave on the same bus."""
    net_id: str = ""
    """Of another bus port, with the AMS *port* of a slave there, or 0xFFFF for the master."""
    port: int = 0
    members: tuple[int, ...] = ()
    """Of a group: station addresses, or virtual ones that are no groups."""
    name: str = ""
    """Of the slave or bus at *net_id* in the plant, such as ``mixer/bus0/drive``."""


class GatewaySpec(SpecRecord, frozen=True):
    """The mailbox gateway of a bus port (ETG.8200)."""

    enabled: bool = True
    """True if it answers before a command starts it."""
    port: int = 0
    """UDP and TCP port of its own at each address of the station; 0 for none."""
    answer_ms: int = 900
    silent: bool = False
    """True if it keeps its own errors to itself."""
    full: bool = False
    """True if objects of slaves in the master's dictionary have all entries there are."""
    padded: bool = False
    """True if complete access puts entries of an even size at even bytes."""
    addresses: tuple[GatewayAddress, ...] = ()
    in_flight: int = 32
    """Requests of one client that wait."""
    rate: int = 0
    """Requests of one client in a second; 0 for any number."""
    clients: int = 256


class EoeSlaveSpec(SpecRecord, frozen=True):
    """A slave that is connected by EoE; settings that are empty are not written."""

    slave: str
    """Name, or station address."""
    ip: str = ""
    """IPv4 address with the length of its network, such as ``192.168.7.10/24``."""
    gateway: str = ""
    dns: str = ""
    name: str = ""
    """Host name."""
    mac: str = ""
    """Empty for one that is made of the station address."""


class EoeSpec(SpecRecord, frozen=True):
    """TAP interface of this host by which the slaves of a bus are reached (EoE)."""

    interface: str
    address: str = ""
    """IPv4 address of the interface with the length of its network; empty to leave it alone."""
    slaves: tuple[EoeSlaveSpec, ...] = ()
    connects_all: bool = False
    """True if every slave with EoE is connected, not only those in *slaves*."""


class LengthCheck(StrEnum):
    """Treatment of frames whose EtherCAT header has a wrong Length."""

    STRICT = "strict"
    """They are dropped."""
    LENIENT = "lenient"
    """They are taken if all their PDs are there, and counted."""


class PortSpec(SpecRecord, frozen=True):
    """One port of a station."""

    name: str
    kind: PortKind
    interface: InterfaceUri
    net_id: NetId
    vlan_id: int = 0
    """Send tagged with this VID and take only its frames; 0 sends untagged."""
    vlan_priority: int = 0
    join: tuple[str, ...] = ()
    """Multicast groups (MAC or IPv4) to listen to; the EAP default on Ethernet always is."""
    broadcast: bool = False
    """True if to listen to UDP broadcasts."""
    tcp: bool = False
    """True if type 4 is taken from TCP connections too."""
    wake: Wake = Wake.CYCLE
    eap_sm: bool = False
    """True if the frames sent carry the device's state in the EAP SM octet."""
    length: LengthCheck = LengthCheck.STRICT
    profile: int = 0
    """Device profile that the port's dictionary names in 0x1000; 0 is that of modular devices."""
    ams: bool = True
    """True if AMS/TCP and UDP 48899 are served at the port's IP address, if it has one."""
    bus: BusPortSpec | None = None
    """Bus ports only, as those that follow."""
    gateway: GatewaySpec | None = None
    eoe: EoeSpec | None = None


class StationSpec(SpecRecord, frozen=True):
    """One station, complete."""

    name: str
    net_id: NetId
    cycle_us: int
    ports: tuple[PortSpec, ...]
    phase_us: int = 0
    """Offset of the station within its cycle; stations of one engine are staggered."""
    variables: tuple[VariableSpec, ...] = ()
    sources: tuple[Source, ...] = ()
    targets: tuple[Target, ...] = ()
    frames: tuple[TxFrameSpec, ...] = ()
    subscriptions: tuple[RxPdSpec, ...] = ()
    links: tuple[LinkSpec, ...] = ()
    pd_keys: str = ""
    """File with the keys that sign its frames, and those of others; empty without."""


# A call into msgspec holds the interpreter until it is done, which is milliseconds for thousands of
# records.  Cycles may run beside it, so it gets some records at a time.
RECORDS_PER_STEP = 64
"""Records in one step: about 50 us."""

_encode = partial(msgspec.json.encode, enc_hook=encode_value)

T = TypeVar("T", bound=msgspec.Struct)


def encode_in_steps(record: msgspec.Struct) -> bytes:
    """Return *record* as JSON."""
    fields = []
    for name in record.__struct_fields__:
        value = getattr(record, name)
        if isinstance(value, tuple):
            # Without the brackets of each piece: together they are one JSON array.
            pieces = (_encode(piece)[1:-1] for piece in _pieces(value))
            octets = b"[" + b",".join(pieces) + b"]"
        else:
            octets = _encode(value)
        fields.append(_encode(name) + b":" + octets)
    return b"{" + b",".join(fields) + b"}"


def record_to_lines(record: msgspec.Struct) -> bytes:
    """Return *record* in lines for :func:`record_from_lines`; long fields follow the first line."""
    long = {
        name: value
        for name in record.__struct_fields__
        if isinstance(value := getattr(record, name), tuple)
    }
    lines = [_encode(msgspec.structs.replace(record, **dict.fromkeys(long, ())))]
    for name, value in long.items():
        lines += [name.encode() + b" " + _encode(piece) for piece in _pieces(value)]
    return b"\n".join(lines)


def record_from_lines(data: bytes, kind: type[T]) -> T:
    """Read what :func:`record_to_lines` made; raise MsgspecError or KeyError otherwise."""
    first, *rest = data.split(b"\n")
    record = msgspec.json.decode(first, type=kind, dec_hook=decode_value)
    decoders = _decoders(kind)
    long: dict[str, list[Any]] = {}
    for line in rest:
        name, _, octets = line.partition(b" ")
        long.setdefault(name.decode(), []).extend(decoders[name.decode()].decode(octets))
    return msgspec.structs.replace(record, **{name: tuple(value) for name, value in long.items()})


def _pieces(value: tuple[Any, ...]) -> Iterator[tuple[Any, ...]]:
    return (value[at : at + RECORDS_PER_STEP] for at in range(0, len(value), RECORDS_PER_STEP))


@lru_cache(maxsize=8)
def _decoders(kind: type[msgspec.Struct]) -> dict[str, msgspec.json.Decoder[Any]]:
    return {
        field.name: msgspec.json.Decoder(field.type, dec_hook=decode_value)
        for field in msgspec.structs.fields(kind)
    }
