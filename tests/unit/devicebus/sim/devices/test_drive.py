"""The axis behind the objects of a drive."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import SoeError
from devicebus.sim.devices.drive import (
    FOLLOWING_ERROR,
    TRANSITIONS,
    Axes,
    Drive,
    DriveCommand,
    DriveState,
    DriveStateMachine,
    command_of,
    complete,
    parameters,
)
from devicebus.sim.devices.objects import build_dictionary
from devicebus.sim.spec import ChannelSpec, DeviceKind, ObjectSpec, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.codec.soe import Element
from eap.od.model import OdState


@pytest.mark.parametrize(
    ("word", "command"),
    [
        (0x0000, DriveCommand.DISABLE_VOLTAGE), (0x000D, DriveCommand.DISABLE_VOLTAGE),
        (0x0002, DriveCommand.QUICK_STOP), (0x000B, DriveCommand.QUICK_STOP),
        (0x0006, DriveCommand.SHUTDOWN), (0x000E, DriveCommand.SHUTDOWN),
        (0x0007, DriveCommand.SWITCH_ON), (0x000F, DriveCommand.ENABLE),
        (0x010F, DriveCommand.ENABLE),
    ],
)  # fmt: skip
def test_control_word_is_a_command(word, command):
    assert command_of(word) is command


def test_drive_status_words_on_the_way_to_enabled():
    machine = DriveStateMachine()
    seen = [machine.status_word & 0x6F]
    for word in (0x06, 0x07, 0x0F):
        machine.control(word)
        seen.append(machine.status_word & 0x6F)
    assert seen == [0x40, 0x21, 0x23, 0x27]
    assert machine.is_enabled
    machine.control(0x02)
    assert machine.state is DriveState.QUICK_STOP_ACTIVE
    machine.control(0x0F)
    assert machine.is_enabled
    machine.control(0x00)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


def test_enable_alone_does_not_switch_on():
    machine = DriveStateMachine()
    machine.control(0x0F)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


def test_fault_is_left_by_the_edge_only():
    machine = DriveStateMachine()
    machine.control(0x80)
    machine.process(DriveCommand.FAULT)
    for word in (0x80, 0x06, 0x0F):
        machine.control(word)
        assert machine.state is DriveState.FAULT
    machine.control(0x8F)
    assert machine.state is DriveState.SWITCH_ON_DISABLED


@given(st.lists(st.integers(0, 0xFFFF), max_size=20))
def test_any_words_lead_to_a_known_state(words):
    machine = DriveStateMachine()
    for word in words:
        before = machine.state
        machine.control(word)
        assert machine.state is before or machine.state in TRANSITIONS.values()
        assert machine.status_word & 0x0210 == 0x0210


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


def test_drive_has_default_process_data():
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


@pytest.fixture
def idn_drive():
    return Drive(build_dictionary(complete(SlaveSpec(name="d", kind=DeviceKind.DRIVE)), 0x20192))


@pytest.fixture
def idns(idn_drive):
    return {str(each.idn): each for each in parameters(idn_drive, "1.2")}


def read(idns, idn):
    return idns[idn].read(Element.VALUE, 0)


def write(idns, idn, data, now_ns=0, state=OdState.PREOP):
    idns[idn].write(Element.VALUE, data, state, now_ns)


def test_operation_mode_has_four_octets(idns):
    assert read(idns, "S-0-0032") == b"\2\0\0\0"
    write(idns, "S-0-0032", b"\1\0\0\0")
    assert read(idns, "S-0-0032") == b"\1\0\0\0"


def test_drive_lists_its_idns(idns):
    assert read(idns, "S-0-0016") == bytes.fromhex("0400 2000 8700 3300")
    assert read(idns, "S-0-0024") == bytes.fromhex("0400 2000 8600 2f00")
    assert read(idns, "S-0-0030").endswith(b"1.2")


def test_master_control_word_switches_the_axis(idn_drive, idns):
    assert read(idns, "S-0-0135") == b"\0\0"
    write(idns, "S-0-0134", b"\0\0")
    assert read(idns, "S-0-0135") == b"\0\x40"
    write(idns, "S-0-0134", b"\0\xe0")
    assert read(idns, "S-0-0135") == b"\0\xc0"
    assert idn_drive.machine.is_enabled
    write(idns, "S-0-0134", b"\0\x60")
    assert not idn_drive.machine.is_enabled


def test_set_points_and_feedback_are_those_of_coe(idn_drive, idns):
    write(idns, "S-0-0047", (77).to_bytes(4, "little"))
    write(idns, "S-0-0134", b"\0\xe0")
    idn_drive.step(AlState.OP, 0)
    assert read(idns, "S-0-0051") == (77).to_bytes(4, "little")
    assert idn_drive.entry(0x607A).value == 77
    with pytest.raises(SoeError) as caught:
        write(idns, "S-0-0051", bytes(4))
    assert caught.value.code == 0x7004


def test_fault_is_reset_by_a_procedure(idn_drive, idns):
    idn_drive.fail(0x7500)
    assert read(idns, "S-0-0135") == b"\0\x20"
    write(idns, "S-0-0099", b"\3\0")
    assert idns["S-0-0099"].read(Element.DATA_STATE, 1000) == b"\7\0"
    assert idns["S-0-0099"].read(Element.DATA_STATE, 10_000_000) == b"\3\0"
    assert read(idns, "S-0-0135") == b"\0\0"


def test_homing_takes_its_time_and_an_axis_that_is_on(idn_drive, idns):
    with pytest.raises(SoeError) as caught:
        write(idns, "S-0-0148", b"\3\0")
    assert caught.value.code == 0x7012
    write(idns, "S-0-0134", b"\0\xe0")
    idn_drive.entry(0x6064).value = idn_drive.entry(0x607A).value = 900
    write(idns, "S-0-0148", b"\3\0")
    assert idns["S-0-0148"].read(Element.DATA_STATE, 49_999_999) == b"\7\0"
    assert idns["S-0-0148"].read(Element.DATA_STATE, 50_000_000) == b"\3\0"
    assert read(idns, "S-0-0051") == bytes(4)


def test_homing_of_an_axis_that_is_switched_off_fails(idn_drive, idns):
    write(idns, "S-0-0134", b"\0\xe0")
    write(idns, "S-0-0148", b"\3\0")
    write(idns, "S-0-0134", b"\0\0")
    assert idns["S-0-0148"].read(Element.DATA_STATE, 50_000_000) == b"\x0f\0"
