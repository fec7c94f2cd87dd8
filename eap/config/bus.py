"""Bus of a plant file as it is expected: its slaves, and the variables of a station on it.

A plant file names a bus file; the caller of ``load`` brings the function that reads it, because
this package knows plants and not devices.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from ipaddress import IPv4Address
from itertools import count
from pathlib import Path
from typing import NamedTuple, TypeAlias

import msgspec

from eap.config.finding import FindingReport, PlantFinding
from eap.config.structs import PlantFile, PortSection, StationSection
from eap.ids import InterfaceUri, ObjectId
from eap.pd.spec import BusEntrySpec, BusSlaveSpec, PortKind

FIRST_STATION = 1001
"""Station address of the first slave in the line; the others follow."""
STATE = "state"
WKC_OK = "wkc_ok"
_STATES = "1 INIT, 2 PREOP, 4 SAFEOP, 8 OP, 0 without an answer"
_OTHER = re.compile(r"[^\w-]")


class DescribedEntry(msgspec.Struct, frozen=True):
    """One entry of process data; *type* as ``datatypes.parse`` reads it, empty for padding."""

    name: str
    type: str
    index: int
    subindex: int
    bit_length: int


class DescribedSlave(msgspec.Struct, frozen=True, kw_only=True):
    """One slave as its description has it; what is None may be anything."""

    name: str
    vendor: int
    product: int
    revision: int | None = None
    serial: int | None = None
    alias: int | None = None
    outputs: tuple[DescribedEntry, ...] = ()
    """In the order of the PDOs."""
    inputs: tuple[DescribedEntry, ...] = ()


class ExpectedBus(msgspec.Struct, frozen=True):
    """A bus, in the order of the line."""

    slaves: tuple[DescribedSlave, ...] = ()


DescribeBus: TypeAlias = Callable[[Path], ExpectedBus | tuple[PlantFinding, ...]]
"""Reads a bus file; returns its findings if it has any, and never raises for what it holds."""


class BusVariable(NamedTuple):
    """A variable that a station has because of a bus; *type* is canonical."""

    type: str
    is_output: bool
    comment: str


class NamedBus(NamedTuple):
    """The slaves of one bus port, and all variables that it brings, in order."""

    slaves: tuple[BusSlaveSpec, ...]
    variables: dict[str, BusVariable]


def name_bus(port: str, description: ExpectedBus) -> NamedBus:
    """Give the process data of the bus at *port* its names.

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
            )
        )
    return NamedBus(tuple(slaves), variables)


def _name(entry: DescribedEntry, prefix: str, name: str) -> BusEntrySpec:
    variable = f"{prefix}.{name}" if entry.type else ""
    return BusEntrySpec(variable, entry.index, entry.subindex, entry.bit_length)


def _variables(
    entries: Sequence[DescribedEntry], specs: Sequence[BusEntrySpec], *, is_output: bool
) -> Iterator[tuple[str, BusVariable]]:
    for entry, spec in zip(entries, specs, strict=True):
        if spec.variable:
            comment = f"{'output' if is_output else 'input'} {ObjectId(spec.index, spec.subindex)}"
            yield spec.variable, BusVariable(entry.type, is_output, comment)


def _unique_names(entries: Sequence[DescribedEntry]) -> list[str]:
    """Return the last part of each entry's name; one that is there twice gets its object."""
    plain = [_plain(entry) for entry in entries]
    counts = Counter([STATE, *(name for name, e in zip(plain, entries, strict=True) if e.type)])
    taken = {name for name, times in counts.items() if times == 1} | {STATE}
    names = []
    for entry, name in zip(entries, plain, strict=True):
        if counts[name] > 1 and entry.type:
            names.append(_free(f"{name}_{_place(entry)}", taken))
            taken.add(names[-1])
        else:
            names.append(name)
    return names


def _plain(entry: DescribedEntry) -> str:
    return _OTHER.sub("_", entry.name) or _place(entry)


def _place(entry: DescribedEntry) -> str:
    return f"{entry.index:04X}_{entry.subindex:02X}"


def _free(name: str, taken: set[str]) -> str:
    if name not in taken:
        return name
    return next(each for n in count(2) if (each := f"{name}_{n}") not in taken)


SCHEMES = ("sim", "ethernet", "udp")
INTERFACE = "sim:// and a bus file, ethernet://NAME or udp://ADDRESS"
_FILE = "a bus file, its path from the plant file on"
_SLAVE_NAME = "a text without spaces and slashes, by which a plant can address it"


def check_bus_port(port: PortSection, uri: InterfaceUri, report: FindingReport) -> None:
    """Report what no bus port on *uri* can have."""
    path = f"{port.at}.interface"
    if uri.scheme not in SCHEMES:
        report.add(path, f"{uri.scheme}:// is no interface of a bus port", INTERFACE)
        return
    if uri.options:
        report.add(path, f"{uri.scheme}:// takes no options", f"{uri.scheme}://{uri.host}")
    if uri.scheme == "udp":
        address = IPv4Address(uri.host)
        if address.is_multicast or address.is_unspecified or uri.host == "255.255.255.255":
            report.add(path, f"{uri.host} is no address of a bus", "the address of one segment")
    if uri.scheme == "sim" and port.bus and Path(port.bus) != Path(uri.host):
        message = f"port {port.name} simulates {uri.host}, but is described by {port.bus}"
        report.add(f"{port.at}.bus", message, "no key bus: the simulated file is the description")


def describe_buses(
    plant: PlantFile, folder: Path, describe: DescribeBus, report: FindingReport
) -> dict[tuple[str, str], ExpectedBus | None]:
    """Return what is known of the bus at each (station, port); None where its file is no bus file.

    What is wrong with the files goes to *report*.
    """
    found: dict[tuple[str, str], ExpectedBus | None] = {}
    known: dict[Path, ExpectedBus | None] = {}
    for station, port in _bus_ports(plant):
        path, file = bus_file(port, folder)
        if file is None:
            description: ExpectedBus | None = ExpectedBus()
        elif reason := _unusable(file):
            report.add(path, f"bus file {file} {reason}", _FILE)
            description = None
        else:
            if file not in known:
                known[file] = _describe(file, describe, report)
            description = known[file]
        if description is not None and not _has_names(path, port, description, report):
            description = None
        found.setdefault((station.name, port.name), description)
    return found


def bus_file(port: PortSection, folder: Path) -> tuple[str, Path | None]:
    """Return where *port* names its bus file (a path in the plant file), and the file, if any."""
    try:
        uri = InterfaceUri.parse(port.interface)
    except ValueError:
        uri = None
    if uri is not None and uri.scheme == "sim":
        return f"{port.at}.interface", folder / uri.host
    return f"{port.at}.bus", folder / port.bus if port.bus else None


def _unusable(file: Path) -> str:
    """Return why there is nothing to read at *file*; empty if there is."""
    try:
        if file.is_file():
            return ""
        return "is no regular file" if file.exists() else "does not exist"
    except OSError as exc:
        return f"cannot be read: {exc.strerror}"


def _bus_ports(plant: PlantFile) -> Iterator[tuple[StationSection, PortSection]]:
    for station in plant.stations:
        for port in station.ports:
            if port.kind is PortKind.BUS:
                yield station, port


def _describe(file: Path, describe: DescribeBus, report: FindingReport) -> ExpectedBus | None:
    description = describe(file)
    if isinstance(description, ExpectedBus):
        return description
    report.adopt(description)
    return None


def _has_names(
    path: str, port: PortSection, description: ExpectedBus, report: FindingReport
) -> bool:
    """Tell whether all slaves can be addressed, after reporting those that cannot."""
    wrong = [
        slave.name
        for slave in description.slaves
        if not slave.name or any(each.isspace() or each == "/" for each in slave.name)
    ]
    for name in wrong:
        report.add(path, f"port {port.name} has a slave {name!r}", _SLAVE_NAME)
    return not wrong
