"""Mapping between the process data of a bus and the process image of its station.

The plant file describes entries by slave, index and subindex; the slaves define their offsets in
the process data.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

from devicebus.master.image import BusImage, ProcessDataLayout, ProcessVariable
from devicebus.master.master import Master
from eap.codec import datatypes
from eap.codec.pd import PdHeader
from eap.ids import ObjectId
from eap.pd.copyplan import CopyPlan, Move
from eap.pd.image import Image
from eap.pd.layout import ImageLayout
from eap.pd.spec import BusEntrySpec, BusPortSpec, BusSlaveSpec, PortSpec, Writer

STATE = "state"
WKC_OK = "wkc_ok"
_Entry: TypeAlias = tuple[int, bool, int, int]
"""Station, whether an output, index, subindex."""


class BusMapping:
    """Mapping between a bus and the process image of its station; each image has its own.

    Args:
        port: The bus port.
        image: Of the station.
        memory_of: Returns where a station reads what a writer writes.

    Attributes:
        bus_image: The process data of the bus that the copies are planned for.
    """

    def __init__(
        self, port: PortSpec, image: Image, memory_of: Callable[[Writer], memoryview]
    ) -> None:
        slaves = (port.bus or BusPortSpec()).slaves
        self.bus_image: BusImage | None = None
        self._planner = BusPlanner(slaves, image.layout)
        self._states = BusStateVariables(port.name, slaves, image)
        self._memory = memory_of(Writer.ENGINE)
        self._memory_of = memory_of
        self._plan: BusPlan | None = None
        self._bus_inputs = self._bus_outputs = memoryview(b"")
        self._outputs: list[tuple[memoryview, CopyPlan]] = []

    @property
    def missing(self) -> tuple[str, ...]:
        """Entries that the slaves do not have, one line each."""
        return self._plan.missing if self._plan is not None else ()

    def lay_out(self, bus_image: BusImage | None) -> None:
        """Plan the copies between the station and *bus_image*."""
        self.bus_image = bus_image
        self._plan = None
        self._outputs = []
        if bus_image is None:
            return
        self._plan = self._planner.plan(bus_image.layout)
        self._bus_inputs = memoryview(bus_image.inputs)
        self._bus_outputs = memoryview(bus_image.outputs)
        self._outputs = [
            (self._memory_of(writer), plan) for writer, plan in self._plan.outputs.items()
        ]

    def keep_inputs(self) -> None:
        """Fill the inputs of the bus from the image, until its slaves send new ones."""
        if self._plan is not None:
            self._plan.kept.run(self._memory, self._bus_inputs)

    def copy_inputs(self, master: Master) -> None:
        """Copy the inputs of the last exchange and the states of the slaves into the image."""
        if self._plan is not None:
            self._plan.inputs.run(self._bus_inputs, self._memory)
        self._states.show(master)

    def put_outputs(self) -> None:
        """Copy the outputs out of the image."""
        for memory, plan in self._outputs:
            plan.run(memory, self._bus_outputs)


class BusPlan(NamedTuple):
    """Copies between a bus and a station in each cycle."""

    inputs: CopyPlan
    """From the inputs of the bus to the image."""
    kept: CopyPlan
    """From the image to the inputs of a bus whose slaves have sent nothing yet."""
    outputs: dict[Writer, CopyPlan]
    """To the outputs of the bus, from what each writer writes."""
    missing: tuple[str, ...]
    """Entries that the slaves do not have, one line each."""


class BusPlanner:
    """Plans the copies for *slaves* as described, in a process image with *layout*."""

    def __init__(self, slaves: Sequence[BusSlaveSpec], layout: ImageLayout) -> None:
        self._slaves = slaves
        self._slots = {slot.name: slot for slot in layout.variables}
        self._used = [
            (slot.bit_offset, datatypes.parse(slot.type).bit_length) for slot in layout.variables
        ]
        self._used += [(8 * slot.offset, 8 * PdHeader.SIZE) for slot in layout.rx]

    def plan(self, bus: ProcessDataLayout) -> BusPlan:
        """Find every described entry in *bus*, the process data as the slaves have it."""
        by_entry = _by_entry(bus.variables)
        missing: list[str] = []
        inputs: list[Move] = []
        outputs: dict[Writer, list[Move]] = defaultdict(list)
        for slave, entry, is_output in self._entries():
            known = by_entry[slave.station, is_output, entry.index, entry.subindex]
            if not known or known[-1].bit_length != entry.bit_length:
                missing.append(_missing(slave, entry, known, is_output=is_output))
                continue
            bus_bit = known.pop().bit_offset
            slot = self._slots[entry.variable]
            if is_output:
                outputs[slot.writer].append(Move(slot.bit_offset, bus_bit, entry.bit_length))
            else:
                inputs.append(Move(bus_bit, slot.bit_offset, entry.bit_length))
        on_bus = [(each.bit_offset, each.bit_length) for each in bus.variables if each.is_output]
        return BusPlan(
            CopyPlan(inputs, used=self._used),
            # Not run in each cycle, so it need not be bridged into few copies.
            CopyPlan([Move(target, source, bits) for source, target, bits in inputs]),
            {writer: CopyPlan(moves, used=on_bus) for writer, moves in outputs.items()},
            tuple(missing),
        )

    def _entries(self) -> Iterator[tuple[BusSlaveSpec, BusEntrySpec, bool]]:
        for slave in self._slaves:
            for entries, is_output in ((slave.outputs, True), (slave.inputs, False)):
                for entry in entries:
                    if entry.variable:
                        yield slave, entry, is_output


def _by_entry(variables: Iterable[ProcessVariable]) -> dict[_Entry, list[ProcessVariable]]:
    """Return the variables of each entry, the first one last."""
    by_entry: dict[_Entry, list[ProcessVariable]] = defaultdict(list)
    for each in variables:
        # An entry may be mapped more than once: the description and the bus name them in one order.
        by_entry[each.station, each.is_output, each.index, each.subindex].insert(0, each)
    return by_entry


def _missing(
    slave: BusSlaveSpec, entry: BusEntrySpec, known: Sequence[ProcessVariable], *, is_output: bool
) -> str:
    what = "output" if is_output else "input"
    has = f"one of {known[-1].bit_length} bits" if known else "none"
    return (
        f"{slave.name} (station {slave.station}) has no {what}"
        f" {ObjectId(entry.index, entry.subindex)} of {entry.bit_length} bits, but {has}:"
        f" {entry.variable} stays as it is"
    )


class BusStateVariables:
    """Variables ``PORT.state``, ``PORT.wkc_ok``, ``PORT.SLAVE.state``, where the image has them."""

    def __init__(self, port: str, slaves: Sequence[BusSlaveSpec], image: Image) -> None:
        self._image = image
        self._stations = [slave.station for slave in slaves]
        self._names = [
            f"{port}.{STATE}",
            f"{port}.{WKC_OK}",
            *(f"{port}.{slave.name}.{STATE}" for slave in slaves),
        ]
        self._shown = [-1] * len(self._names)
        self._seen: tuple[Master, int, bool] | None = None

    def show(self, master: Master) -> None:
        """Store the values that have changed; the caller has begun the engine's write."""
        cycle = master.cycle
        seen = master, master.changes, cycle is not None and cycle.is_full
        if seen == self._seen:
            return
        self._seen = seen
        slaves = master.slaves
        # The bus as a whole is as far as its last slave; absent optional ones do not count.
        present = [slave.al_state for slave in slaves.values() if not slave.is_absent]
        lowest = min(present, default=0)
        values = [lowest, int(seen[2])]
        values += [slaves[at].al_state if at in slaves else 0 for at in self._stations]
        for name, value, shown in zip(self._names, values, self._shown, strict=True):
            if value != shown and name in self._image.slots:
                self._image.store(name, bytes((value,)))
        self._shown = values
