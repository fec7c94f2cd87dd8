"""The axis behind the objects of a drive."""

from __future__ import annotations

import pytest

from devicebus.sim.devices.drive import FOLLOWING_ERROR, Axes, Drive, complete
from devicebus.sim.devices.objects import build_dictionary
from devicebus.sim.spec import ChannelSpec, DeviceKind, ObjectSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.od.model import OdState

MS = 1_000_000


@pytest.fixture
def dictionary():
    return build_dictionary(complete(SlaveSpec(name="d", kind=DeviceKind.DRIVE)), 0x20192)


@pytest.fixture
def drive(dictionary):
    return Drive(dictionary)


def enable(drive, state=AlState.OP):
    for number, word in enumerate((6, 7, 15)):
        drive.entry(0x6040).value = word
        drive.step(state, number)


def status(drive):
    return drive.entry(0x6041).value & 0x6F


def test_process_data_unless_other_is_asked_for():
    spec = complete(SlaveSpec(name="d", kind=DeviceKind.DRIVE))
    assert [each.name for each in spec.inputs] == ["statusword", "position"]
    own = complete(SlaveSpec(name="d", kind=DeviceKind.DRIVE, inputs=(ChannelSpec(name="x"),)))
    assert (len(own.inputs), own.outputs) == (1, ())


def test_own_object_goes_before_that_of_the_profile():
    own = ObjectSpec(index=0x6502, name="modes", type="UDINT", value=1)
    spec = complete(SlaveSpec(name="d", kind=DeviceKind.DRIVE, objects=(own,)))
    assert [each.name for each in spec.objects if each.index == 0x6502] == ["modes"]


def test_objects_of_the_contract(dictionary, drive):
    dictionary.download(0x8000, 1, b"\1\2\3\4", OdState.OP)
    assert dictionary.upload(0x8000, 1, OdState.OP) == b"\1\2\3\4"
    dictionary.download(0x6040, 0, b"\6\0", OdState.PREOP)
    assert status(drive) == 0x21
    assert dictionary.upload(0x6040, 0, OdState.PREOP) == b"\6\0"


def test_position_follows_while_enabled(drive):
    drive.entry(0x607A).value = 500
    drive.step(AlState.OP, 0)
    assert drive.entry(0x6064).value == 0
    enable(drive)
    drive.entry(0x607A).value = -700
    drive.step(AlState.OP, 2 + MS)
    assert (drive.entry(0x6064).value, drive.entry(0x606C).value) == (-700, -1_200_000)
    assert status(drive) == 0x27


def test_velocity_is_integrated(drive):
    drive.entry(0x6060).value = 9
    drive.entry(0x60FF).value = 2000
    enable(drive)
    drive.step(AlState.OP, 2 + 500 * MS)
    assert (drive.entry(0x6064).value, drive.entry(0x606C).value) == (1000, 2000)
    assert drive.entry(0x6061).value == 9


def test_position_wraps_like_its_type(drive):
    drive.entry(0x6060).value = 9
    drive.entry(0x60FF).value = (1 << 31) - 1
    enable(drive)
    drive.entry(0x6064).value = 2
    drive.step(AlState.OP, 2 + 1000 * MS)
    assert drive.entry(0x6064).value == -(1 << 31) + 1


def test_velocity_that_does_not_fit_is_cut(drive):
    enable(drive)
    drive.entry(0x607A).value = (1 << 31) - 1
    drive.step(AlState.OP, 3)
    assert drive.entry(0x606C).value == (1 << 31) - 1


def test_unknown_mode_stands_still(drive):
    drive.entry(0x6060).value = 1
    drive.entry(0x607A).value = 5
    enable(drive)
    assert (drive.entry(0x6064).value, drive.entry(0x6061).value) == (0, 1)


def test_leaving_op_switches_the_axis_off(drive):
    enable(drive)
    drive.step(AlState.SAFEOP, 10)
    assert status(drive) == 0x40


def test_fault_has_a_code_and_is_reset(drive):
    enable(drive)
    drive.fail(0x7500)
    assert (status(drive), drive.entry(0x603F).value) == (0x08, 0x7500)
    drive.command(0x80)
    assert (status(drive), drive.entry(0x6040).value) == (0x40, 0x80)
    assert drive.entry(0x603F).value == 0


def test_fault_and_its_end_are_reported(drive):
    reported = []
    drive.report = reported.append
    enable(drive)
    drive.fail(0x7500)
    drive.step(AlState.OP, 10)
    drive.entry(0x6040).value = 0x80
    drive.step(AlState.OP, 11)
    drive.reset()
    assert reported == [0x7500, 0]


def test_axis_that_cannot_follow_fails(drive):
    drive.entry(0x6065).value = 100
    enable(drive)
    drive.entry(0x607A).value = 100
    drive.step(AlState.OP, 10)
    assert drive.entry(0x6064).value == 100
    drive.entry(0x607A).value = -1
    drive.step(AlState.OP, 11)
    assert (status(drive), drive.entry(0x603F).value) == (0x08, FOLLOWING_ERROR)
    assert drive.entry(0x6064).value == 100


def test_axes_have_objects_and_pdos_of_their_own():
    spec = complete(SlaveSpec(name="d", kind=DeviceKind.DRIVE, axes=2))
    assert [each.name for each in spec.outputs] == [
        "controlword", "target_position", "controlword_1", "target_position_1",
    ]  # fmt: skip
    dictionary = build_dictionary(spec, 0x20192)
    assert [dictionary.entry(0x1C12, sub).value for sub in (0, 1, 2)] == [2, 0x1600, 0x1610]
    assert dictionary.entry(0x1A10, 1).value == 0x6841_0010
    axes = Axes(Drive(dictionary, axis) for axis in range(2))
    for number, word in enumerate((6, 7, 15)):
        axes.drives[1].entry(0x6040).value = word
        axes.step(AlState.OP, number)
    assert [status(drive) for drive in axes.drives] == [0x40, 0x27]
    assert dictionary.entry(0x6841, 0).value & 0x6F == 0x27
