"""The EEPROM through its registers."""

from __future__ import annotations

import pytest

from devicebus.sim.eeprom import READ_NS, RELOAD_NS, WRITE_NS, Eeprom
from devicebus.wire import sii
from devicebus.wire.register import EepromCommand, EepromControl, Register
from devicebus.wire.sii import Sii, SiiFixed

IMAGE = sii.encode(
    Sii(fixed=SiiFixed(pdi_control=0x0E08, alias=0x1234, vendor=0xABCDEF01, product=7))
)


@pytest.fixture
def memory():
    return bytearray(0x1000)


@pytest.fixture
def eeprom(memory):
    return Eeprom(memory, bytearray(IMAGE))


def command(eeprom, memory, what, word=0, *, write_enable=0, data=b""):
    memory[Register.EEPROM_DATA : Register.EEPROM_DATA + len(data)] = data
    memory[Register.EEPROM_ADDRESS : Register.EEPROM_ADDRESS + 4] = word.to_bytes(4, "little")
    control = EepromControl(write_enable=write_enable, command=what)
    memory[Register.EEPROM_CONTROL : Register.EEPROM_CONTROL + 2] = control.encode()
    eeprom.control_written(0)
    eeprom.finish_command(WRITE_NS)
    return EepromControl.decode(memory, Register.EEPROM_CONTROL)


def test_power_on_loads_configuration_and_alias(eeprom, memory):
    assert memory[0x0140:0x0142] == b"\x08\x0e"
    assert memory[0x0012:0x0014] == b"\x34\x12"
    assert eeprom.is_with_master


def test_read_gives_eight_octets(eeprom, memory):
    status = command(eeprom, memory, EepromCommand.READ, 8)
    assert memory[0x0508:0x0510] == bytes.fromhex("01efcdab 07000000")
    assert (status.read_eight, status.busy, status.command_error) == (1, 0, 0)


@pytest.mark.parametrize(
    ("what", "took_ns"),
    [(EepromCommand.READ, READ_NS), (EepromCommand.WRITE, WRITE_NS),
     (EepromCommand.RELOAD, RELOAD_NS)],
)  # fmt: skip
def test_eeprom_command_takes_time(eeprom, memory, what, took_ns):
    control = EepromControl(write_enable=1, command=what)
    memory[0x0502:0x0504] = control.encode()
    memory[0x0508:0x050A] = b"\x55\xaa"
    eeprom.control_written(1000)
    eeprom.finish_command(1000 + took_ns - 1)
    status = EepromControl.decode(memory, Register.EEPROM_CONTROL)
    assert (status.busy, status.command) == (1, what)
    assert eeprom.busy_until_ns == 1000 + took_ns
    eeprom.finish_command(1000 + took_ns)
    status = EepromControl.decode(memory, Register.EEPROM_CONTROL)
    assert (status.busy, status.command, eeprom.busy_until_ns) == (0, 0, None)
    assert (eeprom.image[:2] == b"\x55\xaa") is (what is EepromCommand.WRITE)


def test_eeprom_broken_acknowledges_nothing(eeprom, memory):
    eeprom.is_broken = True
    status = command(eeprom, memory, EepromCommand.WRITE, 4, write_enable=1, data=b"\x78\x56")
    assert (status.command_error, status.busy) == (1, 0)
    assert eeprom.image == IMAGE


def test_read_behind_the_end_is_erased(eeprom, memory):
    command(eeprom, memory, EepromCommand.READ, 0xFFFF_FFFF)
    assert memory[0x0508:0x0510] == b"\xff" * 8


def test_eeprom_write_needs_write_enable(eeprom, memory):
    status = command(eeprom, memory, EepromCommand.WRITE, 4, data=b"\x78\x56")
    assert status.write_enable_error
    assert eeprom.image == IMAGE
    status = command(eeprom, memory, EepromCommand.WRITE, 4, write_enable=1, data=b"\x78\x56\xff")
    assert not status.write_enable_error
    assert eeprom.image[:12] == IMAGE[:8] + b"\x78\x56" + IMAGE[10:12]


def test_eeprom_write_behind_the_end_and_unknown_command(eeprom, memory):
    last = len(IMAGE) // 2
    assert command(eeprom, memory, EepromCommand.WRITE, last, write_enable=1).command_error
    assert command(eeprom, memory, 3).command_error
    assert not command(eeprom, memory, EepromCommand.NONE).command_error


def test_reload_judges_the_check_sum_and_leaves_the_alias(eeprom, memory):
    command(eeprom, memory, EepromCommand.WRITE, 4, write_enable=1, data=b"\x78\x56")
    assert command(eeprom, memory, EepromCommand.RELOAD).crc_error
    eeprom.image[14] = sii.checksum(eeprom.image[:14])
    assert not command(eeprom, memory, EepromCommand.RELOAD).crc_error
    assert memory[0x0012:0x0014] == b"\x34\x12"


def test_eeprom_with_wrong_check_sum_loads_nothing(memory):
    Eeprom(memory, bytearray(256))
    assert EepromControl.decode(memory, Register.EEPROM_CONTROL).crc_error
    assert memory[0x0012:0x0014] == bytes(2)


def test_interface_is_given_away_and_taken_by_force(eeprom, memory):
    memory[0x0500] = 1
    memory[0x0501] = 1
    eeprom.ownership_written()
    assert (eeprom.is_with_master, memory[0x0501]) == (False, 1)
    memory[0x0500] = 2
    eeprom.ownership_written()
    assert (eeprom.is_with_master, memory[0x0501]) == (True, 0)
