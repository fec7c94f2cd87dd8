"""Entries as they are described, found where the slaves have them."""

from __future__ import annotations

from devicebus.master.image import ProcessDataLayout, ProcessVariable
from eap.engine.bus_mapping import BusPlanner
from eap.ids import InterfaceUri, NetId
from eap.pd.layout import plan_layout
from eap.pd.spec import (
    BusEntrySpec,
    BusPortSpec,
    BusSlaveSpec,
    PortKind,
    PortSpec,
    VariableSpec,
    Writer,
)
from tests.support.cyclic import image_of, station

INPUTS = (
    BusEntrySpec("a", 0x6000, 1, 1),
    BusEntrySpec("b", 0x6000, 2, 1),
    BusEntrySpec("", 0, 0, 6),
    BusEntrySpec("c", 0x6001, 0, 16),
)
OUTPUTS = (
    BusEntrySpec("p", 0x7000, 1, 1),
    BusEntrySpec("q", 0x7000, 2, 1),
    BusEntrySpec("", 0, 0, 6),
    BusEntrySpec("r", 0x7001, 0, 16),
)
SLAVE = BusSlaveSpec("io", 1001, 1, 2, inputs=INPUTS, outputs=OUTPUTS)
STATION = station(
    ports=(
        PortSpec(
            "bus0",
            PortKind.BUS,
            InterfaceUri.parse("sim://x"),
            NetId.parse("1.1.1.1.1.1"),
            bus=BusPortSpec("", (SLAVE,)),
        ),
    ),
    variables=(
        VariableSpec("other", "USINT", Writer.ENGINE),
        VariableSpec("a", "BOOL", Writer.ENGINE),
        VariableSpec("b", "BOOL", Writer.ENGINE),
        VariableSpec("c", "INT", Writer.ENGINE),
        VariableSpec("p", "BOOL", Writer.ENGINE),
        VariableSpec("q", "BOOL"),
        VariableSpec("r", "INT"),
    ),
)


def variables(entries, *, is_output, station=1001, first_bit=0):
    found = []
    for entry in entries:
        if entry.index:
            found.append(
                ProcessVariable(
                    station, "", is_output, first_bit, entry.bit_length, 0, entry.index,
                    entry.subindex,
                )
            )  # fmt: skip
        first_bit += entry.bit_length
    return found


def layout(*found):
    return ProcessDataLayout({}, (), tuple(found))


def plan(*found):
    return BusPlanner([SLAVE], plan_layout(STATION)).plan(layout(*found))


ALL = (*variables(INPUTS, is_output=False), *variables(OUTPUTS, is_output=True))


def test_inputs_come_into_the_image_and_back():
    image = image_of(STATION)
    image.write("other", 0xAA)
    made = plan(*ALL)
    made.inputs.run(memoryview(b"\x02\xfe\xff"), image.memory)
    assert [image.read(name) for name in ("a", "b", "c", "other")] == [False, True, -2, 0xAA]
    kept = bytearray(3)
    made.kept.run(image.memory, memoryview(kept))
    assert kept == b"\x02\xfe\xff"
    assert made.missing == ()


def test_mapping_copies_outputs_of_each_writer():
    image = image_of(STATION)
    for name, value in (("p", True), ("q", True), ("r", 0x1234)):
        image.write(name, value)
    made = plan(*ALL)
    assert set(made.outputs) == {Writer.ENGINE, Writer.APPLICATION}
    outputs = bytearray(3)
    made.outputs[Writer.ENGINE].run(image.memory, memoryview(outputs))
    assert outputs == b"\x01\0\0"
    made.outputs[Writer.APPLICATION].run(image.memory, memoryview(outputs))
    assert outputs == b"\x03\x34\x12"


def test_inputs_of_a_slave_are_one_copy():
    assert plan(*ALL).inputs.operations == 1


def test_plan_finds_entries_at_other_offsets():
    image = image_of(STATION)
    moved = variables([INPUTS[3], *INPUTS[:3]], is_output=False, first_bit=8)
    plan(*moved).inputs.run(memoryview(b"\xff\xfe\xff\x02"), image.memory)
    assert [image.read(name) for name in ("a", "b", "c")] == [False, True, -2]


def test_plan_reports_each_missing_entry_once():
    there = [each for each in ALL if each.index not in {0x6001, 0x7001}]
    other = ProcessVariable(1001, "", False, 8, 32, 0, 0x6001, 0)
    made = plan(*there, other)
    assert made.missing == (
        "io (station 1001) has no output 0x7001:00 of 16 bits, but none: r stays as it is",
        "io (station 1001) has no input 0x6001:00 of 16 bits, but one of 32 bits: c stays as it is",
    )
    outputs = bytearray(3)
    made.outputs[Writer.APPLICATION].run(image_of(STATION).memory, memoryview(outputs))


def test_plan_finds_entry_mapped_twice():
    twice = (BusEntrySpec("a", 0x6000, 1, 1), BusEntrySpec("b", 0x6000, 1, 1))
    slave = BusSlaveSpec("io", 1001, 1, 2, inputs=twice)
    image = image_of(STATION)
    made = BusPlanner([slave], image.layout).plan(layout(*variables(twice, is_output=False)))
    made.inputs.run(memoryview(b"\x02"), image.memory)
    assert (image.read("a"), image.read("b")) == (False, True)
