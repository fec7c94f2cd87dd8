"""Bit positions against captured register contents of real slaves."""

from __future__ import annotations

from devicebus.wire.register import (
    FMMU_READ,
    AlControl,
    AlStatus,
    DlStatus,
    EepromControl,
    Fmmu,
    SyncManager,
)


def test_sizes_are_those_of_the_registers() -> None:
    sizes = [r.SIZE for r in (AlControl, AlStatus, DlStatus, SyncManager, Fmmu, EepromControl)]
    assert sizes == [2, 6, 2, 8, 16, 2]


def test_al_status() -> None:
    refused = AlStatus.decode(bytes.fromhex("1400 0000 1b00"))
    assert (refused.state, refused.error, refused.code) == (4, 1, 0x1B)
    assert AlControl(8, acknowledge=1).encode() == b"\x18\0"


def test_usual_sync_managers() -> None:
    """Mailbox out 0x26, mailbox in 0x22, outputs 0x64, inputs 0x20."""
    mailbox_out = SyncManager.decode(bytes.fromhex("0010 8000 26 00 01 00"))
    assert (mailbox_out.start, mailbox_out.length) == (0x1000, 0x80)
    assert (mailbox_out.mode, mailbox_out.direction, mailbox_out.pdi_interrupt) == (2, 1, 1)
    assert mailbox_out.enable == 1
    outputs = SyncManager(0x1100, 2, direction=1, pdi_interrupt=1, watchdog=1, enable=1)
    assert outputs.encode() == bytes.fromhex("0011 0200 64 00 01 00")
    repeat = SyncManager.decode(bytes.fromhex("8010 8000 22 08 03 02"))
    assert (repeat.repeat, repeat.repeat_acknowledge) == (1, 1)


def test_fmmu() -> None:
    inputs = Fmmu(0x01000000, 1, 2, 3, 0x1000, type=FMMU_READ, activate=1)
    octets = bytes.fromhex("00000001 0100 02 03 0010 00 01 01 000000")
    assert inputs.encode() == octets
    assert Fmmu.decode(octets) == inputs


def test_dl_status() -> None:
    line_end = DlStatus.decode(b"\x17\x56")  # port 0 connected, loops closed elsewhere
    assert (line_end.link, line_end.communication0, line_end.loop0) == (1, 1, 0)
    assert (line_end.loop1, line_end.loop2, line_end.loop3) == (1, 1, 1)


def test_eeprom_control() -> None:
    read = EepromControl(command=1)
    assert read.encode() == b"\x00\x01"
    busy = EepromControl.decode(b"\x40\x81")
    assert (busy.read_eight, busy.command, busy.busy) == (1, 1, 1)
