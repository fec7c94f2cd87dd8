"""EEPROM images: round trips, check sums, and lengths that lie."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.wire import sii
from devicebus.wire.sii import (
    Sii,
    SiiDc,
    SiiFixed,
    SiiGeneral,
    SiiPdo,
    SiiPdoEntry,
    SiiPdoHeader,
    SiiProtocol,
    SiiSyncManager,
)
from eap.codec.mailbox import MailboxType
from eap.errors import CodecError, TruncatedError


@pytest.mark.parametrize(
    ("record", "size"),
    [
        (SiiFixed, 0x80),
        (SiiGeneral, 32),
        (SiiSyncManager, 8),
        (SiiPdoHeader, 8),
        (SiiPdoEntry, 8),
        (SiiDc, 24),
    ],
)
def test_size(record, size):
    assert len(record.LAYOUT.pack(*record.LAYOUT.unpack(bytes(size)))) == size


@pytest.mark.parametrize(
    ("field", "word"),
    [("alias", 4), ("checksum", 7), ("vendor", 8), ("product", 0xA), ("revision", 0xC),
     ("serial", 0xE), ("boot_receive_offset", 0x14), ("receive_offset", 0x18),
     ("protocols", 0x1C), ("size", 0x3E), ("version", 0x3F)],
)  # fmt: skip
def test_place_of_a_word(field, word):
    image = SiiFixed(version=0).encode()
    marked = SiiFixed(**{"version": 0, field: 0x4D}).encode()
    assert [at for at in range(0x80) if image[at] != marked[at]] == [2 * word]


def test_general_ends_with_ports_behind_the_current():
    octets = SiiGeneral(name=3, coe_sdo=1, coe_complete_access=1, ebus_current=-2,
                        port_physics=0x0011).encode()  # fmt: skip
    assert octets[:6] == bytes((0, 0, 0, 3, 0, 0x21))
    assert octets[12:18] == bytes.fromhex("feff 0000 1100")


DRIVE = Sii(
    fixed=SiiFixed(pdi_control=0x0E08, alias=7, vendor=0x1234, product=5, serial=9, protocols=0x3C,
                   receive_offset=0x1000, receive_size=256, send_offset=0x1100, send_size=256),
    strings=("Drive", "Servo drives", "Grün"),
    general=SiiGeneral(group=2, name=1, coe_sdo=1, coe_info=1),
    fmmus=(1, 2, 3),
    sync_managers=(SiiSyncManager(0x1000, 256, 0x26, type=1), SiiSyncManager(0x1100, 256, 0x22)),
    tx_pdos=(SiiPdo(SiiPdoHeader(0x1A00, 1, 3), (SiiPdoEntry(0x6041, 0, bit_length=16),)),),
    rx_pdos=(SiiPdo(SiiPdoHeader(0x1600, 2, 2),
                    (SiiPdoEntry(0x6040, 0, bit_length=16), SiiPdoEntry(0, 0, bit_length=4))),),
    dc=(SiiDc(assign_activate=0x300, sync0_factor=1),),
    other=((2000, b"\x01\x02"),),
)  # fmt: skip


def test_round_trip_keeps_everything_but_the_checksum():
    image = sii.encode(DRIVE)
    read = sii.decode(image)
    assert read.fixed.checksum == image[14]
    assert sii.encode(read) == image
    assert (read.name, read.string(2), read.string(3)) == ("Drive", "Servo drives", "Grün")
    assert read.fmmus == (1, 2, 3, 0)  # filled up to whole words
    assert read.rx_pdos == DRIVE.rx_pdos
    assert read.rx_pdos[0].bit_length == 20
    assert (read.tx_pdos, read.dc, read.other) == (DRIVE.tx_pdos, DRIVE.dc, DRIVE.other)
    assert (read.general, read.sync_managers) == (DRIVE.general, DRIVE.sync_managers)


def test_layout_of_the_first_category():
    image = sii.encode(Sii(fixed=SiiFixed(), strings=("ab",)))
    assert image[0x80:] == bytes.fromhex("0a00 0200 01 02 6162 ffff")


def test_damage_shows_in_the_checksum():
    image = bytearray(sii.encode(DRIVE))
    assert sii.is_intact(image)
    image[8] ^= 1
    assert not sii.is_intact(image)


def test_sii_checksum_is_crc8_from_0xff():
    # The empty message leaves the initial value; one zero byte gives 0xF3 by hand division.
    assert sii.checksum(b"") == 0xFF
    assert sii.checksum(b"\0") == 0xF3


@pytest.mark.parametrize("number", [0, 4, 255])
def test_unknown_string_is_empty(number):
    assert DRIVE.string(number) == ""


def test_device_without_general_category_has_no_name():
    assert Sii(fixed=SiiFixed(), strings=("x",)).name == ""


@given(st.data())
def test_every_prefix_is_truncated(data):
    image = sii.encode(DRIVE)
    cut = data.draw(st.integers(0, len(image) - 1))
    with pytest.raises(TruncatedError):
        sii.decode(image[:cut])


@pytest.mark.parametrize(
    "category",
    [
        struct.pack("<HH", 10, 0xFFFE),
        struct.pack("<HHBB", 10, 1, 255, 0),
        struct.pack("<HHBB", 10, 1, 1, 200),
        struct.pack("<HHHBBBBH", 50, 4, 0x1A00, 255, 3, 0, 0, 0),
        struct.pack("<HHH", 30, 1, 0),
    ],
)
def test_lengths_that_lie_are_truncated(category):
    with pytest.raises(TruncatedError):
        sii.decode(SiiFixed().encode() + category + b"\xff\xff")


@given(st.binary(max_size=400))
def test_garbage_never_escapes(noise):
    with contextlib.suppress(CodecError):
        sii.decode(SiiFixed().encode() + noise)


@pytest.mark.parametrize("text", ["€", "x" * 256])
def test_string_that_does_not_fit(text):
    with pytest.raises(CodecError, match="StringCount"):
        sii.encode(Sii(fixed=SiiFixed(), strings=(text,)))


def test_protocols_have_the_names_and_titles_of_mailbox_types():
    bits = {kind: SiiProtocol.of(kind) for kind in MailboxType}
    assert bits.pop(MailboxType.ERR) == SiiProtocol(0)
    assert sorted(bits.values()) == sorted(SiiProtocol)
    assert all(bit.title == kind.title for kind, bit in bits.items())
    assert SiiProtocol.COE.title == "CoE"
