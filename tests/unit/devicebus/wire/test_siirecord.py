"""Sizes and places of the fixed parts of an EEPROM image, counted by hand from ETG.2010."""

from __future__ import annotations

import pytest

from devicebus.wire.siirecord import (
    SiiDc,
    SiiFixed,
    SiiGeneral,
    SiiPdoEntry,
    SiiPdoHeader,
    SiiSyncManager,
)


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
