from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.codec.datatypes import layout


@pytest.mark.parametrize(
    ("types", "bit_offsets", "size"),
    [
        ([], (), 0),
        (["BOOL"], (0,), 1),
        (["BOOL", "BOOL", "BIT3", "BIT4"], (0, 1, 2, 5), 2),
        (["BOOL", "UINT", "BOOL"], (0, 8, 24), 4),
        (["UDINT", "REAL", "LREAL"], (0, 32, 64), 16),
        (["USINT", "UDINT"], (0, 8), 5),
        (["UINT24", "BLOCK(5)", "STRING(3)", "INT[2]"], (0, 24, 64, 88), 15),
    ],
)
def test_layout_packs_bits_and_starts_the_rest_on_octets(types, bit_offsets, size):
    assert layout(datatypes.parse(text) for text in types) == (bit_offsets, size)


@given(st.lists(st.sampled_from(["BOOL", "BIT2", "BIT7", "USINT", "UINT24", "LREAL", "BLOCK(3)"])))
def test_nothing_overlaps_and_no_octet_is_wasted(texts):
    types = [datatypes.parse(text) for text in texts]
    offsets, size = layout(types)
    end = 0
    for kind, offset in zip(types, offsets, strict=True):
        assert end <= offset < end + 8
        assert kind.is_bits or offset % 8 == 0
        end = offset + kind.bit_length
    assert end <= size * 8 < end + 8
