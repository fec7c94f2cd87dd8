from __future__ import annotations

import pytest

from devicebus.errors import SiiError, WorkingCounterError
from devicebus.master import eeprom
from devicebus.master.procedure import Sleep
from devicebus.master.scan import assign_stations
from devicebus.sim.eeprom import Eeprom
from devicebus.wire import sii
from devicebus.wire.datagram import Command, DatagramReply
from devicebus.wire.register import EepromControl, Register
from devicebus.wire.sii import Sii, SiiFixed
from tests.support.busline import Bench, Line, drive, run, segment, slave


@pytest.fixture
def line():
    line = Line(Bench(), segment(slave("a", serial=0x12345678)))
    run(line, assign_stations([(0, 1001)]))
    return line


class Chip:
    """An EEPROM made by hand: four bytes a read, and what else goes wrong."""

    def __init__(self, image, *, busy=0, refuse=0, wkc=1):
        self.image = image
        self.busy = busy
        self.refuse = refuse
        self.wkc = wkc
        self.commands = []
        self.pending = 0

    def __call__(self, access):
        if access.command is Command.FPWR:
            if access.ado == Register.EEPROM_CONTROL:
                self.commands.append(access.data)
                self.pending = self.busy
            return DatagramReply(access.data, self.wkc)
        failed = int(self.refuse > 0)
        if self.pending:
            self.pending -= 1
            return DatagramReply(EepromControl(busy=1).encode() + bytes(12), self.wkc)
        self.refuse -= failed
        at = 2 * int.from_bytes(self.commands[-1][2:6], "little")
        data = self.image[at : at + 4].ljust(8, b"\xff")
        control = EepromControl(command_error=failed).encode()
        return DatagramReply(control + self.commands[-1][2:6] + data, self.wkc)


def test_read_image_ends_at_the_end_mark(line):
    image = run(line, eeprom.read_image(1001))
    assert line.segment.slaves[0].esc.image.startswith(image)
    assert image.endswith(b"\xff\xff")
    assert sii.decode(image).fixed.serial == 0x12345678


def test_controllers_that_give_four_octets_are_read_as_well():
    image = sii.encode(Sii(fixed=SiiFixed(vendor=5), strings=("one",)))
    chip = Chip(image)
    assert drive(eeprom.read_image(1001), chip) == image
    assert len(chip.commands) == len(image) // 4 + 1


def test_write_image_writes_changed_words_only(line, monkeypatch):
    image = bytearray(run(line, eeprom.read_image(1001)))
    image[8:10] = b"\x34\x12"
    image[14] = sii.checksum(image[:14])
    words = []
    write_word = Eeprom._write_word
    monkeypatch.setattr(
        Eeprom, "_write_word", lambda self, offset: (words.append(offset), write_word(self, offset))
    )
    run(line, eeprom.write_image(1001, bytes(image)))
    assert line.segment.slaves[0].esc.eeprom.image[: len(image)] == image
    assert words == [8, 14]
    run(line, eeprom.reload(1001))
    assert run(line, eeprom.read_image(1001)) == image


def test_write_image_refuses_odd_lengths():
    with pytest.raises(SiiError, match="3 bytes, expected whole words"):
        drive(eeprom.write_image(1001, b"abc"), Chip(b""))


def test_eeprom_busy_times_out_after_20_ms():
    assert drive(eeprom.read_words(1001, 0), Chip(b"abcd", busy=100)) == b"abcd"
    with pytest.raises(SiiError, match="slave 1001: EEPROM, reading word 0x0004: busy"):
        drive(eeprom.read_words(1001, 4), Chip(b"abcd", busy=300))


def test_eeprom_command_without_acknowledge_is_repeated():
    chip = Chip(b"abcd", refuse=3)
    assert drive(eeprom.read_words(1001, 0), chip) == b"abcd"
    assert len(chip.commands) == 4
    with pytest.raises(SiiError, match="writing word 0x0002: not acknowledged, tried 4 times"):
        drive(eeprom.write_word(1001, 2, b"ab"), Chip(b"", refuse=4))


def watched(procedure, pauses):
    step = next(procedure)
    while True:
        if isinstance(step, Sleep):
            pauses.append(step.duration_ns)
        outcome = yield step
        try:
            step = procedure.send(outcome)
        except StopIteration as end:
            return end.value


def test_eeprom_write_waits_10_ms_for_a_word():
    pauses = []
    chip = Chip(b"abcd", refuse=3)
    assert drive(watched(eeprom.read_words(1001, 0), pauses), chip) == b"abcd"
    assert sum(pauses) >= 10_000_000


def test_eeprom_lost_slave_is_named():
    with pytest.raises(WorkingCounterError, match="slave 1001"):
        drive(eeprom.read_image(1001), Chip(b"", wkc=0))


FIXED = SiiFixed().encode()


@pytest.mark.parametrize(
    ("tail", "text"),
    [
        (b"\x0a\0\xff\xff", "category 10 ends at byte 131202, expected at most 4096"),
        (b"\x0a\0\0\0" * 2000, "no end of the EEPROM within its 4096 bytes"),
    ],
)
def test_lengths_that_cannot_be_end_in_an_error(tail, text):
    with pytest.raises(SiiError, match=text):
        drive(eeprom.read_image(1001), Chip(FIXED + tail))
