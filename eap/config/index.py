"""Index of a plant file: sections by name, references between them, and variables of buses.

A name that occurs twice stands for its first section; the second one is a finding of
``check_names``. A plant file names a bus file.  The caller of ``load`` passes the function that
reads bus files, because this package does not know device descriptions.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from ipaddress import IPv4Address
from itertools import count
from math import lcm
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import msgspec

from eap.codec import datatypes
from eap.codec.datatypes import DataType, find_variable
from eap.config.finding import PlantFinding
from eap.config.plant_sections import PlantFile
from eap.config.structs import (
    FrameSection,
    FromSection,
    PortSection,
    PublishSection,
    StationSection,
    SubscribeSection,
)
from eap.ids import InterfaceUri, ObjectId
from eap.od.model import RW, Access
from eap.od.slave_config import OpMode, SlaveConfig
from eap.pd.fieldsources import controller_variables
from eap.pd.spec import BusEntrySpec, BusSlaveSpec, FieldSource, PortKind

FIRST_STATION = 1001
"""Station address of the first slave in the line; the others follow."""
STATE = "state"
WKC_OK = "wkc_ok"
_STATES = "1 INIT, 2 PREOP, 4 SAFEOP, 8 OP, 0 without an answer"
_OTHER = re.compile(r"[^\w-]")


class DescribedPdoEntry(msgspec.Struct, frozen=True):
    """One entry of process data; *type* for ``datatypes.parse``, empty for padding."""

    name: str
    type: str
    index: int
    subindex: int
    bit_length: int
    manager: int = 0
    """Sync manager of the PDO that maps it."""
    group: str = ""
    """Name of its PDO, if variables have it before the name of the entry."""
    access: Access = RW
    """Rights of the object, where they are known."""


class DescribedPdo(msgspec.Struct, frozen=True, kw_only=True):
    """PDO that a slave has, assigned by default or not."""

    index: int
    name: str = ""
    group: str = ""
    """Name before those of its entries in variables; empty for none."""
    is_output: bool
    manager: int
    """Sync manager that it is assigned to, or may be."""
    assigned: bool = True
    mandatory: bool = False
    fixed: bool = False
    """True if its entries cannot be changed."""
    excludes: tuple[int, ...] = ()
    """PDOs that cannot be assigned together with it."""
    entries: tuple[DescribedPdoEntry, ...] = ()

    @property
    def label(self) -> str:
        """Index and name."""
        return f"0x{self.index:04X}" + (f" ({self.name})" if self.name else "")


class DescribedSlave(msgspec.Struct, frozen=True, kw_only=True):
    """One slave of a bus file; a field that is None is not checked."""

    name: str
    vendor: int
    product: int
    revision: int | None = None
    serial: int | None = None
    alias: int | None = None
    outputs: tuple[DescribedPdoEntry, ...] = ()
    """In the order of the PDOs."""
    inputs: tuple[DescribedPdoEntry, ...] = ()
    config: SlaveConfig = SlaveConfig()
    pdos: tuple[DescribedPdo, ...] = ()
    """All PDOs, by which *config* may replace *outputs* and *inputs*."""
    objects: tuple[DescribedPdoEntry, ...] = ()
    """Known entries of its dictionary."""
    op_modes: tuple[OpMode, ...] = ()
    assignments: Mapping[str, Mapping[int, tuple[int, ...]]] = {}
    """Named PDO assignments of its description, by sync manager."""
    managers: Mapping[int, bool] = {}
    """Sync managers of process data; true for outputs."""
    has_coe: bool = True
    has_soe: bool = True
    has_clock: bool = True


class ExpectedBus(msgspec.Struct, frozen=True):
    """A bus, in the order of the line."""

    slaves: tuple[DescribedSlave, ...] = ()
    is_ring: bool = False
    """True if its bus file has a second line to the master."""
    digest: str = ""
    """Of all that a simulator plays from its bus file."""
    warnings: tuple[PlantFinding, ...] = ()
    """Warnings about its bus file."""


class BusVariable(NamedTuple):
    """A variable that a bus adds to a station; *type* is canonical."""

    type: str
    is_output: bool
    comment: str


class NamedBus(NamedTuple):
    """The slaves of one bus port, and all variables that it brings, in order."""

    slaves: tuple[BusSlaveSpec, ...]
    variables: dict[str, BusVariable]
    digest: str
    """As that of ExpectedBus."""


def name_bus(port: str, description: ExpectedBus) -> NamedBus:
    """Return the slaves and variables of the bus at *port*, with the names of its process data.

    ``PORT.SLAVE.ENTRY``, and beside these the states of bus and slaves.
    """
    variables = {
        f"{port}.{STATE}": BusVariable("BYTE", False, f"lowest AL state of the slaves: {_STATES}"),
        f"{port}.{WKC_OK}": BusVariable("BOOL", False, "the last exchange reached every slave"),
    }
    slaves = []
    for number, slave in enumerate(description.slaves):
        prefix = f"{port}.{slave.name}"
        variables[f"{prefix}.{STATE}"] = BusVariable("BYTE", False, f"AL state: {_STATES}")
        names = iter(_unique_names([*slave.outputs, *slave.inputs]))
        outputs = tuple(_name(entry, prefix, next(names)) for entry in slave.outputs)
        inputs = tuple(_name(entry, prefix, next(names)) for entry in slave.inputs)
        for entries, specs in ((slave.outputs, outputs), (slave.inputs, inputs)):
            variables.update(_variables(entries, specs, is_output=entries is slave.outputs))
        slaves.append(
            BusSlaveSpec(
                name=slave.name,
                station=FIRST_STATION + number,
                vendor=slave.vendor,
                product=slave.product,
                revision=slave.revision,
                serial=slave.serial,
                alias=slave.alias,
                outputs=outputs,
                inputs=inputs,
                config=slave.config,
            )
        )
    return NamedBus(tuple(slaves), variables, description.digest)


def _name(entry: DescribedPdoEntry, prefix: str, name: str) -> BusEntrySpec:
    variable = f"{prefix}.{name}" if entry.type else ""
    place = entry.index, entry.subindex, entry.bit_length
    return BusEntrySpec(variable, *place, entry.manager)


def _variables(
    entries: Sequence[DescribedPdoEntry], specs: Sequence[BusEntrySpec], *, is_output: bool
) -> Iterator[tuple[str, BusVariable]]:
    for entry, spec in zip(entries, specs, strict=True):
        if spec.variable:
            comment = f"{'output' if is_output else 'input'} {ObjectId(spec.index, spec.subindex)}"
            yield spec.variable, BusVariable(entry.type, is_output, comment)


def _unique_names(entries: Sequence[DescribedPdoEntry]) -> list[str]:
    """Return the last part of the name of each entry; a duplicate gets its object index."""
    plain = [plain_name(entry) for entry in entries]
    counts = Counter([STATE, *(name for name, e in zip(plain, entries, strict=True) if e.type)])
    # `state` is the AL state of the slave, which each slave has.
    taken = {name for name, times in counts.items() if times == 1} | {STATE}
    names = []
    for entry, name in zip(entries, plain, strict=True):
        if counts[name] > 1 and entry.type:
            names.append(_free(f"{name}_{_object_suffix(entry)}", taken))
            taken.add(names[-1])
        else:
            names.append(name)
    return names


def plain_name(entry: DescribedPdoEntry) -> str:
    """Return the end of the name of an entry's variable, unless another has the same."""
    name = _OTHER.sub("_", entry.name) or _object_suffix(entry)
    return f"{_OTHER.sub('_', entry.group)}.{name}" if entry.group else name


def _object_suffix(entry: DescribedPdoEntry) -> str:
    return f"{entry.index:04X}_{entry.subindex:02X}"


def _free(name: str, taken: set[str]) -> str:
    if name not in taken:
        return name
    return next(each for n in count(2) if (each := f"{name}_{n}") not in taken)


_Key = TypeVar("_Key")
_Value = TypeVar("_Value")


class SentPd(NamedTuple):
    """A PD that a station of the plant sends, with its station, frame and port."""

    station: StationSection
    pd: PublishSection
    frame: FrameSection
    port: PortSection

    @property
    def label(self) -> str:
        """``STATION/PD``."""
        return f"{self.station.name}/{self.pd.name}"


class Span(NamedTuple):
    """Consecutive bits of one variable."""

    variable: str
    start: int
    bits: int

    def overlaps(self, other: Span) -> bool:
        """Return whether both spans have a bit in common."""
        return (
            self.variable == other.variable
            and self.start < other.start + other.bits
            and other.start < self.start + self.bits
        )


class VariablePart(NamedTuple):
    """A variable, or a member or element of one; *bit_offset* counts from its start."""

    variable: str
    kind: DataType
    bit_offset: int = 0

    @property
    def span(self) -> Span:
        """All of its bits."""
        return Span(self.variable, self.bit_offset, self.kind.bit_length)


class Index:
    """The plant by names; what cannot be resolved is absent.

    Args:
        plant: The file.
        buses: Descriptions of the buses by station and port, None if the file is invalid.
    """

    def __init__(
        self,
        plant: PlantFile,
        buses: Mapping[tuple[str, str], ExpectedBus | None] = MappingProxyType({}),
    ) -> None:
        self.plant = plant
        self.buses = {
            key: name_bus(key[1], description)
            for key, description in buses.items()
            if description is not None
        }
        self._unread = [key for key, description in buses.items() if description is None]
        self._bus_variables: dict[str, dict[str, BusVariable]] = {}
        for (name, _), bus in self.buses.items():
            self._bus_variables.setdefault(name, {}).update(bus.variables)
        self._field_variables = {
            station.name: controller_variables(
                each.controller
                for each in station.sources.values()
                if isinstance(each, FieldSource)
            )
            for station in plant.stations
        }
        self.stations = _first((s.name, s) for s in plant.stations)
        self.ports = _first(((s.name, p.name), p) for s in plant.stations for p in s.ports)
        self.frames = _first(((s.name, f.name), f) for s in plant.stations for f in s.frames)
        self.uris = {
            key: uri
            for key, port in self.ports.items()
            if (uri := _interface(port.interface)) is not None
        }
        self.sent = _first(((s.station.name, s.pd.name), s) for s in self._sent())
        self.hosts = _first((name, host) for host in plant.hosts for name in host.stations)
        """Host of each station, by its name; empty for a plant of one host."""

    def are_apart(self, station: str, other: str) -> bool:
        """Return whether two stations run on different hosts."""
        one, two = self.hosts.get(station), self.hosts.get(other)
        return one is not None and two is not None and one.name != two.name

    def interface(self, station: str, port: str) -> InterfaceUri:
        """Return the interface of a port by the name that the host of its station has for it."""
        return self.interface_on_host(station, self.uris[station, port])

    def interface_on_host(self, station: str, uri: InterfaceUri) -> InterfaceUri:
        """Return *uri* of the file by the name that the host of *station* has for it."""
        host = self.hosts.get(station)
        if host is None or uri.scheme != "ethernet":
            return uri
        return InterfaceUri(uri.scheme, host.interface(uri.host), uri.port, uri.options)

    def cycle_us(self, station: StationSection) -> int:
        """Return the device cycle of *station*."""
        return station.cycle_us or self.plant.defaults.cycle_us

    def pd_keys(self, station: StationSection) -> str:
        """Return the file with the keys of *station*, relative to the plant file; empty if none."""
        return station.pd_keys or self.plant.defaults.pd_keys

    def _sent(self) -> Iterator[SentPd]:
        for station in self.plant.stations:
            for pd in station.publish:
                frame = self.frames.get((station.name, pd.frame))
                port = frame and self.eap_port(station, frame.port)
                if frame and port:
                    yield SentPd(station, pd, frame, port)

    def eap_port(self, station: StationSection, name: str) -> PortSection | None:
        """Return the EAP port *name* of *station*, if it has one."""
        port = self.ports.get((station.name, name))
        return port if port is not None and port.kind is PortKind.EAP else None

    def bus_variables(self, station: StationSection) -> dict[str, BusVariable]:
        """Return the variables that buses add to *station*."""
        return self._bus_variables.get(station.name, {})

    def field_variables(self, station: StationSection) -> dict[str, tuple[str, str, str]]:
        """Return type, unit and comment of the variables of the controllers that it reads."""
        return self._field_variables.get(station.name, {})

    def unread_buses(self, station: StationSection) -> list[str]:
        """Return the bus ports of *station* without a readable description."""
        return [port for name, port in self._unread if name == station.name]

    def slaves(self, station: StationSection, port: str) -> tuple[BusSlaveSpec, ...]:
        """Return the described slaves of a bus port, none if no bus file describes it."""
        bus = self.buses.get((station.name, port))
        return bus.slaves if bus else ()

    def names(self, station: StationSection) -> list[str]:
        """Return the names of all variables of *station*."""
        names = [*station.variables]
        for subscription in station.subscribe:
            names += self.received(subscription)
        return [*names, *self.bus_variables(station), *self.field_variables(station)]

    def publishers(self, subscription: SubscribeSection) -> list[SentPd]:
        """Return the PDs of this plant that *subscription* receives; several only for any."""
        source = subscription.source
        if isinstance(source, str):
            station, _, name = source.partition("/")
            sent = self.sent.get((station, name))
            return [sent] if sent else []
        return [sent for sent in self.sent.values() if _matches(source, sent)]

    def subscription(self, station: StationSection, name: str) -> SubscribeSection | None:
        """Return the subscription *name* of *station*, if it has one."""
        return next((each for each in station.subscribe if each.name == name), None)

    def received(self, subscription: SubscribeSection) -> dict[str, str]:
        """Return the variables of *subscription* and their types as texts, in PDO order."""
        if subscription.variables is not None:
            return {name: variable.type for name, variable in subscription.variables.items()}
        if not isinstance(subscription.source, str):
            return {}
        return {
            f"{subscription.name}.{name}": text
            for sent in self.publishers(subscription)
            for name in sent.pd.variables
            if (text := self.type_text(sent.station, name)) is not None
        }

    def type_text(self, station: StationSection, name: str) -> str | None:
        """Return the type of a variable of *station* as written, None if it has no such one."""
        if name in station.variables:
            return station.variables[name].type
        if name in (on_bus := self.bus_variables(station)):
            return on_bus[name].type
        if name in (made := self.field_variables(station)):
            return made[name][0]
        for subscription in station.subscribe:
            if subscription.variables is not None:
                if name in subscription.variables:
                    return subscription.variables[name].type
            elif isinstance(subscription.source, str):
                # Each hop takes a prefix off the name, so stations that forward in a circle end.
                prefix, rest = f"{subscription.name}.", name.removeprefix(f"{subscription.name}.")
                for sent in self.publishers(subscription):
                    if name.startswith(prefix) and rest in sent.pd.variables:
                        return self.type_text(sent.station, rest)
        return None

    def part(self, station: StationSection, name: str) -> VariablePart | None:
        """Return the variable of *station* that *name* is or lies in; None if there is none.

        Raises:
            ValueError: its type is invalid, or it has no such part.
        """

        def type_of(variable: str) -> DataType | None:
            text = self.type_text(station, variable)
            return None if text is None else datatypes.parse(text)

        found = find_variable(name, type_of)
        return None if found is None else VariablePart(found[0], *found[1])

    def types(self, sent: SentPd) -> list[DataType] | None:
        """Return the types of the variables of a PD; None if one is missing or invalid."""
        texts = [self.type_text(sent.station, name) for name in sent.pd.variables]
        # The caller reports nothing here: variables without a type are findings of their own.
        return parse_types(texts)

    def step(self, sent: SentPd) -> int:
        """Return the sender cycles between two of a PD, 0 if it has no fixed step."""
        pd = sent.pd
        if pd.on_change is not None or pd.event or pd.poll:
            return 0
        if pd.cycle_us:
            return max(pd.cycle_us // self.cycle_us(sent.station), 1)
        # Both dividers count device cycles, and both must be due.
        return lcm(pd.divider or 1, sent.frame.divider or 1)


def parse_types(texts: list[str | None]) -> list[DataType] | None:
    """Return all types, None if one is missing or invalid."""
    try:
        kinds = [datatypes.parse(text) for text in texts if text is not None]
    except ValueError:
        return None
    return kinds if len(kinds) == len(texts) else None


def _matches(source: FromSection, sent: SentPd) -> bool:
    return source.id == sent.pd.id and source.publisher in ("any", str(sent.port.net_id))


def _interface(text: str) -> InterfaceUri | None:
    try:
        return InterfaceUri.parse(text)
    except ValueError:
        return None


def is_local_only(uri: InterfaceUri) -> bool:
    """Return whether only the own host reaches *uri*: a loopback line or address."""
    if uri.scheme == "loop":
        return True
    return uri.scheme in {"udp", "tcp"} and IPv4Address(uri.host).is_loopback


def _first(pairs: Iterable[tuple[_Key, _Value]]) -> dict[_Key, _Value]:
    found: dict[_Key, _Value] = {}
    for key, value in pairs:
        found.setdefault(key, value)
    return found
