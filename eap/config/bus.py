"""What is known of a bus before it is there: its slaves, and the variables they give a station.

A plant file names a bus file; whoever calls ``load`` brings the function that reads it, because
this package knows plants and not devices.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import NamedTuple, TypeAlias

import msgspec

from eap.config.finding import Finding
from eap.ids import ObjectId
from eap.pd.spec import BusEntrySpec, BusSlaveSpec

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


class BusDescription(msgspec.Struct, frozen=True):
    """A bus, in the order of the line."""

    slaves: tuple[DescribedSlave, ...] = ()


DescribeBus: TypeAlias = Callable[[Path], BusDescription | tuple[Finding, ...]]
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


def name_bus(port: str, description: BusDescription) -> NamedBus:
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
