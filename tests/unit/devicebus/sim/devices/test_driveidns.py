"""The same axis by SoE."""

from __future__ import annotations

import pytest

from devicebus.errors import SoeError
from devicebus.sim.devices.drive import Drive, complete
from devicebus.sim.devices.driveidns import parameters
from devicebus.sim.devices.objects import build_dictionary
from devicebus.sim.spec import DeviceKind, SlaveSpec
from devicebus.wire.alstatus import AlState
from eap.codec.soe import Element
from eap.od.model import OdState


@pytest.fixture
def drive():
    return Drive(build_dictionary(complete(SlaveSpec(name="d", kind=DeviceKind.DRIVE)), 0x20192))


@pytest.fixture
def idns(drive):
    return {str(each.idn): each for each in parameters(drive, "1.2")}


def read(idns, idn):
    return idns[idn].read(Element.VALUE, 0)


def write(idns, idn, data, now_ns=0, state=OdState.PREOP):
    idns[idn].write(Element.VALUE, data, state, now_ns)


def test_operation_mode_has_four_octets(idns):
    assert read(idns, "S-0-0032") == b"\2\0\0\0"
    write(idns, "S-0-0032", b"\1\0\0\0")
    assert read(idns, "S-0-0032") == b"\1\0\0\0"


def test_lists(idns):
    assert read(idns, "S-0-0016") == bytes.fromhex("0400 2000 8700 3300")
    assert read(idns, "S-0-0024") == bytes.fromhex("0400 2000 8600 2f00")
    assert read(idns, "S-0-0030").endswith(b"1.2")


def test_master_control_word_switches_the_axis(drive, idns):
    assert read(idns, "S-0-0135") == b"\0\0"
    write(idns, "S-0-0134", b"\0\0")
    assert read(idns, "S-0-0135") == b"\0\x40"
    write(idns, "S-0-0134", b"\0\xe0")
    assert read(idns, "S-0-0135") == b"\0\xc0"
    assert drive.machine.is_enabled
    write(idns, "S-0-0134", b"\0\x60")
    assert not drive.machine.is_enabled


def test_set_points_and_feedback_are_those_of_coe(drive, idns):
    write(idns, "S-0-0047", (77).to_bytes(4, "little"))
    write(idns, "S-0-0134", b"\0\xe0")
    drive.step(AlState.OP, 0)
    assert read(idns, "S-0-0051") == (77).to_bytes(4, "little")
    assert drive.entry(0x607A).value == 77
    with pytest.raises(SoeError) as caught:
        write(idns, "S-0-0051", bytes(4))
    assert caught.value.code == 0x7004


def test_fault_is_reset_by_a_procedure(drive, idns):
    drive.fail(0x7500)
    assert read(idns, "S-0-0135") == b"\0\x20"
    write(idns, "S-0-0099", b"\3\0")
    assert idns["S-0-0099"].read(Element.DATA_STATE, 1000) == b"\7\0"
    assert idns["S-0-0099"].read(Element.DATA_STATE, 10_000_000) == b"\3\0"
    assert read(idns, "S-0-0135") == b"\0\0"


def test_homing_takes_its_time_and_an_axis_that_is_on(drive, idns):
    with pytest.raises(SoeError) as caught:
        write(idns, "S-0-0148", b"\3\0")
    assert caught.value.code == 0x7012
    write(idns, "S-0-0134", b"\0\xe0")
    drive.entry(0x6064).value = drive.entry(0x607A).value = 900
    write(idns, "S-0-0148", b"\3\0")
    assert idns["S-0-0148"].read(Element.DATA_STATE, 49_999_999) == b"\7\0"
    assert idns["S-0-0148"].read(Element.DATA_STATE, 50_000_000) == b"\3\0"
    assert read(idns, "S-0-0051") == bytes(4)


def test_homing_of_an_axis_that_is_switched_off_fails(drive, idns):
    write(idns, "S-0-0134", b"\0\xe0")
    write(idns, "S-0-0148", b"\3\0")
    write(idns, "S-0-0134", b"\0\0")
    assert idns["S-0-0148"].read(Element.DATA_STATE, 50_000_000) == b"\x0f\0"
