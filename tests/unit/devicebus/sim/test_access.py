"""Which octets of the register space a master may read and write."""

from __future__ import annotations

import pytest

from devicebus.sim.access import REGISTERS, access_map

SMALL = access_map(3, 4, has_dc=False)
LARGE = access_map(8, 16, has_dc=True)


@pytest.mark.parametrize(
    ("address", "readable", "writable"),
    [
        (0x0000, 1, 0), (0x0010, 1, 1), (0x0012, 1, 0), (0x0101, 1, 1), (0x0110, 1, 0),
        (0x0120, 1, 1), (0x0130, 1, 0), (0x0136, 0, 0), (0x0300, 1, 1), (0x0501, 1, 0),
        (0x0600, 1, 1), (0x062C, 1, 1), (0x062D, 1, 0), (0x0630, 0, 0), (0x081D, 1, 0),
        (0x081E, 1, 1), (0x081F, 1, 0), (0x0820, 0, 0), (0x0910, 0, 0), (0x0FFF, 0, 0),
    ],
)  # fmt: skip
def test_small_controller(address, readable, writable):
    assert (SMALL.readable[address], SMALL.writable[address]) == (readable, writable)


@pytest.mark.parametrize(
    ("address", "readable", "writable"),
    [(0x0670, 1, 1), (0x0680, 0, 0), (0x0878, 1, 1), (0x0910, 1, 1), (0x092C, 1, 0), (0x0981, 1, 1),
     (0x0982, 1, 0), (0x09A0, 1, 1)],
)  # fmt: skip
def test_large_controller_with_clock(address, readable, writable):
    assert (LARGE.readable[address], LARGE.writable[address]) == (readable, writable)


@pytest.mark.parametrize("small_or_large", [SMALL, LARGE])
def test_what_can_be_written_can_be_read(small_or_large):
    assert len(small_or_large.readable) == len(small_or_large.writable) == REGISTERS
    assert all(r >= w for r, w in zip(*small_or_large, strict=True))
