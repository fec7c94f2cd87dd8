from __future__ import annotations

import pytest

from devicebus.errors import BusError
from devicebus.master.image import BusImage, kind_of
from devicebus.master.layout import SlaveShape, lay_out
from devicebus.master.pdo import Channel, Pdo, PdoEntry

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
        Channel(2, 0x1100, 0x64, True, (Pdo(0x1600, OUT),)),
        Channel(3, 0x1180, 0x20, False, (Pdo(0x1A00, IN),)),
    )
    return BusImage(lay_out([SlaveShape(1001, channels), SlaveShape(1002, channels)]))


def test_values_lie_side_by_side(image):
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


def test_inputs_are_read_where_they_came(image):
    size = len(image.inputs) // 2
    image.inputs[size] = 200
    image.inputs[size + 1 : size + 11] = b"0123456789"
    assert image.read(1002, "count") == 200
    assert image.read(1002, "raw") == b"0123456789"
    assert image.read(1001, "count") == 0


def test_octets_without_a_type(image):
    image.write(1001, "odd", b"\xcd\x0a")
    assert image.read(1001, "odd") == b"\xcd\x0a"
    with pytest.raises(ValueError, match="5 for 'odd', expected octets"):
        image.write(1001, "odd", 5)


def test_what_is_not_there_names_what_is(image):
    with pytest.raises(BusError, match="slave 1001 has no process data 'x', it has lamp, mode"):
        image.read(1001, "x")
    with pytest.raises(BusError, match="slave 1009 has no process data 'x', it has none"):
        image.read(1009, "x")
    with pytest.raises(BusError, match="'count' is an input"):
        image.write(1001, "count", 1)
    with pytest.raises(ValueError, match="40000 is not a value of INT"):
        image.write(1001, "speed", 40000)


def test_a_type_of_another_width_is_a_number_of_those_bits(image):
    variable = image.variable(1001, "mode")
    assert kind_of(variable).text == "BIT3"
    assert kind_of(image.variable(1001, "lamp")).text == "BOOL"
    assert kind_of(image.variable(1001, "odd")) is None
