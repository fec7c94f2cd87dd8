from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import BusError
from devicebus.master.image import (
    BASE,
    BusImage,
    DatagramGroup,
    SlaveProcessData,
    data_type_of,
    plan_image,
)
from devicebus.master.link import MAX_DATA
from devicebus.master.pdo import Pdo, PdoEntry, ProcessDataChannel


def channel(number, *bits, is_output, start=0x1100, name=""):
    entries = tuple(PdoEntry(0x7000, sub, size, name) for sub, size in enumerate(bits, 1))
    control = 0x64 if is_output else 0x20
    return ProcessDataChannel(number, start, control, is_output, (Pdo(0x1600, entries),))


def shape(station, outputs=(), inputs=(), **options):
    channels = (channel(2, *outputs, is_output=True), channel(3, *inputs, is_output=False))
    return SlaveProcessData(station, channels, **options)


def test_outputs_come_first_then_inputs():
    layout = plan_image([shape(1, (8, 8), (16,)), shape(2, (1, 1), (32,))])
    assert layout.groups == (DatagramGroup(BASE, 0, 3, 0, 6),)
    one, two = layout.slaves.values()
    assert (one.outputs, one.outputs_size, one.inputs, one.inputs_size) == (0, 2, 0, 2)
    assert (two.outputs, two.outputs_size, two.inputs, two.inputs_size) == (2, 1, 2, 4)
    assert [(f.logical_start - BASE, f.length, f.type) for f in one.fmmus + two.fmmus] == [
        (0, 2, 2), (3, 2, 1), (2, 1, 2), (5, 4, 1),
    ]  # fmt: skip
    assert (layout.outputs_size, layout.inputs_size) == (3, 6)


def test_sync_managers_have_the_length_of_their_pdos_and_are_off_without_any():
    (place,) = plan_image([shape(1, (8, 3), ())]).slaves.values()
    (_, outputs), (_, inputs) = place.sync_managers
    assert (outputs.length, outputs.enable, outputs.watchdog, outputs.direction) == (2, 1, 1, 1)
    assert (inputs.length, inputs.enable) == (0, 0)
    assert len(place.fmmus) == 1


def test_entries_have_names_and_bits():
    padded = Pdo(0x1A00, (PdoEntry(0x6000, 1, 1, "a"), PdoEntry(0, 0, 7), PdoEntry(0x6000, 2, 16)))
    twice = Pdo(0x1A01, (PdoEntry(0x6010, 1, 8, "a"),))
    channels = (ProcessDataChannel(3, 0x1180, 0x20, False, (padded, twice)),)
    layout = plan_image([shape(1, (), (8,)), SlaveProcessData(2, channels)])
    assert [(v.station, v.name, v.bit_offset, v.bit_length) for v in layout.variables] == [
        (1, "7000:01", 0, 8), (2, "a", 8, 1), (2, "6000:02", 16, 16), (2, "a 6010:01", 32, 8),
    ]  # fmt: skip


def test_plan_image_splits_into_several_datagrams():
    layout = plan_image([shape(at, (8,) * 200, (8,) * 300) for at in range(1, 7)])
    assert [group.outputs_size + group.inputs_size for group in layout.groups] == [1000] * 3
    assert [group.address for group in layout.groups] == [BASE, BASE + 0x800, BASE + 0x1000]
    assert (layout.groups[1].outputs, layout.groups[1].inputs) == (400, 600)
    assert layout.slaves[3].fmmus[1].logical_start == BASE + 0x800 + 400


@given(st.lists(st.tuples(st.integers(0, 700), st.integers(0, 700)), max_size=12))
def test_plan_image_bytes_are_disjoint_and_slaves_whole(sizes):
    slaves = [shape(n, (8,) * out, (8,) * into) for n, (out, into) in enumerate(sizes)]
    layout = plan_image(slaves)
    used = []
    for place in layout.slaves.values():
        group = layout.groups[place.group]
        end = group.address + group.outputs_size + group.inputs_size
        for fmmu in place.fmmus:
            used += range(fmmu.logical_start, fmmu.logical_start + fmmu.length)
            assert group.address <= fmmu.logical_start
            assert fmmu.logical_start + fmmu.length <= end <= group.address + MAX_DATA
    assert len(used) == len(set(used)) == sum(map(sum, sizes))


def test_plan_image_without_process_data_is_empty():
    layout = plan_image([shape(1), SlaveProcessData(2, ())])
    assert layout == ({}, (), ())


def test_plan_image_refuses_too_much_process_data():
    with pytest.raises(BusError, match="slave 5: 1500 bytes of process data, expected at most"):
        plan_image([shape(5, (8,) * 1500)])
    with pytest.raises(BusError, match="slave 5: 2 sync managers with process data, but 1 FMMUs"):
        plan_image([shape(5, (8,), (8,), fmmus=1)])
    one = Pdo(0x1A00, (PdoEntry(0x6000, 1, 8, "a"),))
    channels = tuple(ProcessDataChannel(n, 0x1100, 0x20, False, (one,)) for n in range(17))
    with pytest.raises(BusError, match="slave 5: 17 sync managers with process data, but 16"):
        plan_image([SlaveProcessData(5, channels, 255)])


OUT = (
    PdoEntry(0x7000, 1, 1, "lamp", 0x01),
    PdoEntry(0x7000, 2, 3, "mode"),
    PdoEntry(0, 0, 4),
    PdoEntry(0x7010, 1, 16, "speed", 0x03),
    PdoEntry(0x7020, 1, 12, "odd"),
    PdoEntry(0x7030, 1, 32, "ratio", 0x08),
)
IN = (PdoEntry(0x6000, 1, 8, "count", 0x05), PdoEntry(0x6010, 1, 80, "raw"))


@pytest.fixture
def image():
    channels = (
        ProcessDataChannel(2, 0x1100, 0x64, True, (Pdo(0x1600, OUT),)),
        ProcessDataChannel(3, 0x1180, 0x20, False, (Pdo(0x1A00, IN),)),
    )
    return BusImage(
        plan_image([SlaveProcessData(1001, channels), SlaveProcessData(1002, channels)])
    )


def test_image_values_share_bytes(image):
    image.write(1001, "lamp", True)
    image.write(1001, "mode", 5)
    image.write(1001, "speed", -2)
    image.write(1001, "ratio", 0.5)
    assert image.outputs[:3] == b"\x0b\xfe\xff"
    assert [image.read(1001, each) for each in ("lamp", "mode", "speed", "ratio")] == [
        True, 5, -2, 0.5,
    ]  # fmt: skip
    image.write(1001, "lamp", False)
    assert image.read(1001, "mode") == 5
    assert not any(image.outputs[len(image.outputs) // 2 :])


def test_image_reads_inputs_of_the_last_cycle(image):
    size = len(image.inputs) // 2
    image.inputs[size] = 200
    image.inputs[size + 1 : size + 11] = b"0123456789"
    assert image.read(1002, "count") == 200
    assert image.read(1002, "raw") == b"0123456789"
    assert image.read(1001, "count") == 0


def test_octets_without_a_type(image):
    image.write(1001, "odd", b"\xcd\x0a")
    assert image.read(1001, "odd") == b"\xcd\x0a"
    with pytest.raises(ValueError, match="5 for 'odd', expected bytes"):
        image.write(1001, "odd", 5)


def test_image_unknown_entry_names_the_known_ones(image):
    with pytest.raises(BusError, match="slave 1001 has no process data 'x', it has lamp, mode"):
        image.read(1001, "x")
    with pytest.raises(BusError, match="slave 1009 has no process data 'x', it has none"):
        image.read(1009, "x")
    with pytest.raises(BusError, match="'count' is an input"):
        image.write(1001, "count", 1)
    with pytest.raises(ValueError, match="40000 is not a value of INT"):
        image.write(1001, "speed", 40000)


def test_image_type_of_another_width_is_unsigned(image):
    variable = image.variable(1001, "mode")
    assert data_type_of(variable).text == "BIT3"
    assert data_type_of(image.variable(1001, "lamp")).text == "BOOL"
    assert data_type_of(image.variable(1001, "odd")) is None
