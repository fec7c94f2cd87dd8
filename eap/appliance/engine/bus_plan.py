"""Which bits of a bus belong where in a station's process image.

The plant file describes entries by slave, index and subindex; the slaves say themselves where these
lie in their process data.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple, TypeAlias

from devicebus.master.layout import Layout, Variable
from eap.codec import datatypes
from eap.codec.pd import PdHeader
from eap.ids import ObjectId
from eap.pd.copyplan import CopyPlan, Move
from eap.pd.layout import ImageLayout
from eap.pd.spec import BusEntrySpec, BusSlaveSpec, Writer

_Entry: TypeAlias = tuple[int, bool, int, int]
"""Station, whether an output, index, subindex."""


class BusPlan(NamedTuple):
    """What is copied between a bus and a station in each cycle."""

    inputs: CopyPlan
    """From the inputs of the bus to the image."""
    kept: CopyPlan
    """The way back: what a bus shows before its slaves have said anything new."""
    outputs: dict[Writer, CopyPlan]
    """To the outputs of the bus, from what each writer writes."""
    missing: tuple[str, ...]
    """Entries that the slaves do not have, one line each."""


class BusPlanner:
    """Knows the station's side: *slaves* as described, and the *layout* of its process image."""

    def __init__(self, slaves: Sequence[BusSlaveSpec], layout: ImageLayout) -> None:
        self._slaves = slaves
        self._places = {place.name: place for place in layout.variables}
        self._used = [
            (place.bit_offset, datatypes.parse(place.type).bit_length) for place in layout.variables
        ]
        self._used += [(8 * place.offset, 8 * PdHeader.SIZE) for place in layout.rx]

    def plan(self, bus: Layout) -> BusPlan:
        """Find every described entry in *bus*, the process data as the slaves have it."""
        there = _by_entry(bus.variables)
        missing: list[str] = []
        inputs: list[Move] = []
        outputs: dict[Writer, list[Move]] = defaultdict(list)
        for slave, entry, is_output in self._entries():
            known = there[slave.station, is_output, entry.index, entry.subindex]
            if not known or known[-1].bit_length != entry.bit_length:
                missing.append(_missing(slave, entry, known, is_output=is_output))
                continue
            bus_bit = known.pop().bit_offset
            place = self._places[entry.variable]
            if is_output:
                outputs[place.writer].append(Move(place.bit_offset, bus_bit, entry.bit_length))
            else:
                inputs.append(Move(bus_bit, place.bit_offset, entry.bit_length))
        on_bus = [(each.bit_offset, each.bit_length) for each in bus.variables if each.is_output]
        return BusPlan(
            CopyPlan(inputs, used=self._used),
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


def _by_entry(variables: Iterable[Variable]) -> dict[_Entry, list[Variable]]:
    """Return what there is of each entry, the first one last."""
    there: dict[_Entry, list[Variable]] = defaultdict(list)
    for each in variables:
        there[each.station, each.is_output, each.index, each.subindex].insert(0, each)
    return there


def _missing(
    slave: BusSlaveSpec, entry: BusEntrySpec, known: Sequence[Variable], *, is_output: bool
) -> str:
    what = "output" if is_output else "input"
    has = f"one of {known[-1].bit_length} bits" if known else "none"
    return (
        f"{slave.name} (station {slave.station}) has no {what}"
        f" {ObjectId(entry.index, entry.subindex)} of {entry.bit_length} bits, but {has}:"
        f" {entry.variable} stays as it is"
    )
