"""What each kind of device adds, and how it behaves."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.build import build_slave
from devicebus.sim.devices.drive import Axes
from devicebus.sim.devices.kinds import complete, device_type
from devicebus.sim.devices.signal import Signals
from devicebus.sim.spec import ChannelSpec, DeviceKind, SlaveSpec


def spec(kind, **more):
    return SlaveSpec(name="x", kind=DeviceKind(kind), **more)


@pytest.mark.parametrize("kind", ["coupler", "digital", "analogue", "drive", "generic"])
def test_kind_gives_a_product_code_unless_there_is_one(kind):
    assert complete(spec(kind), {}).product > 0
    assert complete(spec(kind, product=77), {}).product == 77


def test_kind_fills_the_last_byte_of_each_pdo():
    inputs = (
        ChannelSpec(name="a"),
        ChannelSpec(name="b", type="UINT", pdo=0x1A01),
        ChannelSpec(name="c", type="UINT", bits=12, pdo=0x1A02),
    )
    filled = complete(spec("digital", inputs=inputs), {}).inputs
    assert filled[:3] == inputs
    assert [(each.object, each.bits, each.pdo) for each in filled[3:]] == [
        ("0", 7, 0),
        ("0", 4, 0x1A02),
    ]


def test_profile_of_a_drive():
    assert (device_type(spec("drive")), device_type(spec("digital"))) == (0x20192, 5001)


def test_behaviour():
    assert isinstance(build_slave(spec("drive")).device.behaviour, Axes)
    assert build_slave(spec("digital")).device.behaviour is None
    noisy = spec("analogue", inputs=(ChannelSpec(name="a", type="INT", noise=1),))
    assert isinstance(build_slave(noisy).device.behaviour, Signals)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (spec("esi", esi="x.xml"), "needs its file"),
        (spec("coupler", inputs=(ChannelSpec(name="a"),)), "has no process data"),
    ],
)
def test_description_that_cannot_be(given, message):
    with pytest.raises(ValueError, match=message):
        complete(given, {})
