"""Process image of a bus: layout in logical addresses and datagrams, and values by name.

Slaves share one logical datagram as long as it fits a frame.  A sync manager is never split,
because its slave accepts and provides its area as a whole.  A datagram contains all outputs, then
all inputs, so that one LRW, or an LWR and an LRD, exchange both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec

from devicebus.errors import BusError
from devicebus.master.link import MAX_DATA
from devicebus.master.pdo import ProcessDataChannel
from devicebus.wire.register import FMMU_READ, FMMU_WRITE, Fmmu, SyncManager
from eap.codec import datatypes
from eap.codec.datatypes import DataType, Value
from eap.ids import ObjectId

BASE = 0x0001_0000
"""First logical address."""
MAX_FMMUS = 16
"""Limit for the FMMUs of a controller."""
# Distance of the logical addresses of two datagrams, longer than one datagram.
_STRIDE = 0x0800


class SlaveProcessData(NamedTuple):
    """Process data of a slave, and the number of its FMMUs."""

    station: int
    channels: tuple[ProcessDataChannel, ...]
    fmmus: int = 16


class SlaveLayout(NamedTuple):
    """Part of a slave in the image; outputs and inputs each begin at a byte."""

    station: int
    outputs: int
    outputs_size: int
    inputs: int
    inputs_size: int
    group: int
    """Number of its datagram group."""
    fmmus: tuple[Fmmu, ...]
    sync_managers: tuple[tuple[int, SyncManager], ...]


class DatagramGroup(NamedTuple):
    """Process data that one LRW, or one LWR and one LRD, exchange."""

    address: int
    outputs: int
    outputs_size: int
    inputs: int
    inputs_size: int


class ProcessVariable(msgspec.Struct, frozen=True):
    """PDO entry in the image."""

    station: int
    name: str
    is_output: bool
    bit_offset: int
    """Offset from the start of all outputs, or of all inputs."""
    bit_length: int
    data_type: int
    index: int
    subindex: int


class ProcessDataLayout(NamedTuple):
    """Layout of the process data of all slaves."""

    slaves: dict[int, SlaveLayout]
    """Slaves by station address."""
    groups: tuple[DatagramGroup, ...]
    variables: tuple[ProcessVariable, ...]

    @property
    def outputs_size(self) -> int:
        """Size of all outputs in bytes."""
        return sum(group.outputs_size for group in self.groups)

    @property
    def inputs_size(self) -> int:
        """Size of all inputs in bytes."""
        return sum(group.inputs_size for group in self.groups)


def plan_image(slaves: Sequence[SlaveProcessData]) -> ProcessDataLayout:
    """Assign outputs, inputs, FMMUs and datagrams to every slave.

    Raises:
        BusError: a slave has more process data than a frame holds, or too few FMMUs.
    """
    layouts: dict[int, SlaveLayout] = {}
    groups: list[DatagramGroup] = []
    variables: list[ProcessVariable] = []
    outputs = inputs = 0
    for number, members in enumerate(_group(slaves)):
        # Each group has an address range of its own, so that no FMMU serves two datagrams.
        address = BASE + number * _STRIDE
        group_outputs = sum(_size(slave, is_output=True) for slave in members)
        start = outputs, inputs
        for slave in members:
            shift = (address - start[0], address + group_outputs - start[1])
            layout = _plan_slave(slave, number, (outputs, inputs), shift)
            layouts[slave.station] = layout
            variables += _variables(slave, layout)
            outputs += layout.outputs_size
            inputs += layout.inputs_size
        groups.append(
            DatagramGroup(address, start[0], outputs - start[0], start[1], inputs - start[1])
        )
    return ProcessDataLayout(layouts, tuple(groups), tuple(variables))


def replan_slave(layout: ProcessDataLayout, slave: SlaveProcessData) -> ProcessDataLayout:
    """Return the layout with the process data of one slave as it is now, at its offsets.

    Raises BusError if it has another size than planned.
    """
    old = layout.slaves[slave.station]
    group = layout.groups[old.group]
    shift = group.address - group.outputs, group.address + group.outputs_size - group.inputs
    new = _plan_slave(slave, old.group, (old.outputs, old.inputs), shift)
    if (new.outputs_size, new.inputs_size) != (old.outputs_size, old.inputs_size):
        raise BusError(
            f"slave {slave.station}: it has {new.outputs_size} bytes of outputs and"
            f" {new.inputs_size} of inputs, but {old.outputs_size} and {old.inputs_size} are"
            " planned: correct its description, or restart the bus"
        )
    variables = [each for each in layout.variables if each.station != slave.station]
    return layout._replace(
        slaves={**layout.slaves, slave.station: new},
        variables=(*variables, *_variables(slave, new)),
    )


def _group(slaves: Sequence[SlaveProcessData]) -> Iterator[list[SlaveProcessData]]:
    """Divide the slaves with process data into as few datagrams as possible, in their order."""
    members: list[SlaveProcessData] = []
    total = 0
    for slave in slaves:
        size = sum(channel.size for channel in slave.channels)
        if size > MAX_DATA:
            raise BusError(
                f"slave {slave.station}: {size} bytes of process data, expected at most {MAX_DATA}"
            )
        # Outputs and inputs together: one LRW carries both.
        if members and total + size > MAX_DATA:
            yield members
            members, total = [], 0
        members.append(slave)
        total += size
    if total:
        yield members


def _size(slave: SlaveProcessData, *, is_output: bool) -> int:
    return sum(each.size for each in slave.channels if each.is_output is is_output)


def _plan_slave(
    slave: SlaveProcessData, group: int, start: tuple[int, int], shift: tuple[int, int]
) -> SlaveLayout:
    """Plan one slave; *shift* converts image offsets to logical addresses."""
    ends = list(start)
    fmmus = []
    managers = []
    for channel in slave.channels:
        side = 0 if channel.is_output else 1
        if not channel.is_virtual:
            managers.append((channel.number, _sync_manager(channel)))
        if not channel.size:
            continue
        fmmus.append(
            Fmmu(
                shift[side] + ends[side],
                channel.size,
                physical_start=channel.start,
                type=FMMU_WRITE if channel.is_output else FMMU_READ,
                activate=1,
            )
        )
        ends[side] += channel.size
    if len(fmmus) > min(slave.fmmus, MAX_FMMUS):
        raise BusError(
            f"slave {slave.station}: {len(fmmus)} sync managers with process data, but"
            f" {min(slave.fmmus, MAX_FMMUS)} FMMUs"
        )
    sizes = [end - begin for begin, end in zip(start, ends, strict=True)]
    return SlaveLayout(
        slave.station, start[0], sizes[0], start[1], sizes[1], group, tuple(fmmus), tuple(managers)
    )


def _sync_manager(channel: ProcessDataChannel) -> SyncManager:
    control = channel.control
    return SyncManager(
        channel.start,
        channel.size,
        mode=control & 3,
        direction=control >> 2 & 3,
        ecat_interrupt=control >> 4 & 1,
        pdi_interrupt=control >> 5 & 1,
        watchdog=control >> 6 & 1,
        # A sync manager without data stays off: slaves check its length on the way to SAFEOP.
        enable=int(channel.size > 0),
    )


def _variables(slave: SlaveProcessData, layout: SlaveLayout) -> Iterator[ProcessVariable]:
    ends = [layout.outputs * 8, layout.inputs * 8]
    names: set[tuple[bool, str]] = set()
    for channel in slave.channels:
        side = 0 if channel.is_output else 1
        offset = ends[side]
        for entry in (entry for pdo in channel.pdos for entry in pdo.entries):
            if entry.index:
                plain = f"{entry.index:04X}:{entry.subindex:02X}"
                name = entry.name or plain
                # Entries of several channels may have one name; the index makes it unique.
                if (channel.is_output, name) in names:
                    name = f"{name} {plain}"
                names.add((channel.is_output, name))
                yield ProcessVariable(
                    slave.station, name, channel.is_output, offset, entry.bit_length,
                    entry.data_type, entry.index, entry.subindex,
                )  # fmt: skip
            offset += entry.bit_length
        ends[side] += 8 * channel.size


_NAMES = (
    "BOOL", "SINT", "INT", "DINT", "USINT", "UINT", "UDINT", "REAL", "LREAL", "INT24", "LINT",
    "UINT24", "ULINT", "BYTE", "WORD", "DWORD", *(f"BIT{bits}" for bits in range(1, 9)),
)  # fmt: skip
_KINDS = {kind.code: kind for kind in map(datatypes.parse, _NAMES)}


class BusImage:
    """Outputs and inputs of a bus.

    Attributes:
        outputs: Outputs of the next cycle.
        inputs: Inputs of the last cycle; a lost slave keeps its last inputs.
    """

    def __init__(self, layout: ProcessDataLayout) -> None:
        self.layout = layout
        self._planned: dict[int, SlaveProcessData] = {}
        self.outputs = bytearray(layout.outputs_size)
        self.inputs = bytearray(layout.inputs_size)
        self._variables = {(each.station, each.name): each for each in layout.variables}

    def replan_slave(self, slave: SlaveProcessData, *, is_described: bool) -> SlaveLayout:
        """Plan one slave again as it is now, at its offsets; return its part.

        Raises BusError if it has another size than planned or, if it was described, other entries.
        """
        if self._is_planned(slave):
            return self.layout.slaves[slave.station]
        layout = replan_slave(self.layout, slave)
        before, after = (_entries_of(each, slave.station) for each in (self.layout, layout))
        if is_described and before != after:
            wrong = next(each for each in (*after, *before) if (each in before) != (each in after))
            verb = "has" if wrong in after else "lacks"
            raise BusError(
                f"slave {slave.station}: its process data is not as described: it {verb}"
                f" {'output' if wrong.is_output else 'input'}"
                f" {ObjectId(wrong.object_index, wrong.subindex)} of {wrong.bit_length} bits at bit"
                f" {wrong.bit_offset}"
            )
        self.layout = layout
        self._variables = {(each.station, each.name): each for each in layout.variables}
        self._planned[slave.station] = slave
        return layout.slaves[slave.station]

    def _is_planned(self, slave: SlaveProcessData) -> bool:
        return self._planned.get(slave.station) == slave

    def variable(self, station: int, name: str) -> ProcessVariable:
        """Return an entry by its slave and name; raise BusError with the known names."""
        try:
            return self._variables[station, name]
        except KeyError:
            known = ", ".join(each for at, each in self._variables if at == station)
            raise BusError(
                f"slave {station} has no process data {name!r}, it has {known or 'none'}"
            ) from None

    def read(self, station: int, name: str) -> Value:
        """Return the value of an entry; raise BusError for an unknown entry."""
        variable = self.variable(station, name)
        octets = self.read_octets(variable)
        kind = data_type_of(variable)
        return kind.decode(octets, 0) if kind else octets

    def write(self, station: int, name: str, value: Value) -> None:
        """Set an output.

        Raises:
            BusError: the entry is unknown, or an input.
            ValueError: the value does not fit the type.
        """
        variable = self.variable(station, name)
        if not variable.is_output:
            raise BusError(f"slave {station}: {name!r} is an input, expected an output")
        kind = data_type_of(variable)
        if kind is None and not isinstance(value, bytes):
            raise ValueError(f"{value!r} for {name!r}, expected bytes")
        self.write_octets(variable, kind.encode(value) if kind else bytes(value))

    def read_octets(self, variable: ProcessVariable) -> bytes:
        """Return the bits of an entry, shifted to bit 0 of the first byte."""
        block = self.outputs if variable.is_output else self.inputs
        first, shift = divmod(variable.bit_offset, 8)
        bits = variable.bit_length
        end = first + (shift + bits + 7) // 8
        word = int.from_bytes(block[first:end], "little") >> shift & (1 << bits) - 1
        return word.to_bytes((bits + 7) // 8, "little")

    def write_octets(self, variable: ProcessVariable, octets: bytes) -> None:
        """Set the bits of an output; neighbouring bits stay unchanged."""
        first, shift = divmod(variable.bit_offset, 8)
        mask = (1 << variable.bit_length) - 1
        end = first + (shift + variable.bit_length + 7) // 8
        word = int.from_bytes(self.outputs[first:end], "little") & ~(mask << shift)
        word |= (int.from_bytes(octets, "little") & mask) << shift
        self.outputs[first:end] = word.to_bytes(end - first, "little")


class _Place(NamedTuple):
    is_output: bool
    object_index: int
    subindex: int
    bit_offset: int
    bit_length: int


def _entries_of(layout: ProcessDataLayout, station: int) -> list[_Place]:
    return [
        _Place(each.is_output, each.index, each.subindex, each.bit_offset, each.bit_length)
        for each in layout.variables
        if each.station == station
    ]


def data_type_of(variable: ProcessVariable) -> DataType | None:
    """Return the data type of an entry; without one, an unsigned number of its bit length."""
    kind = _KINDS.get(variable.data_type)
    # A type of another length than the mapped one is wrong: the mapped length counts.
    if kind is not None and kind.bit_length == variable.bit_length:
        return kind
    name = datatypes.untyped(variable.bit_length)
    return datatypes.parse(name) if name else None
