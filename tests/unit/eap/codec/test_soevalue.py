from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.soe import (
    Display,
    SoeAttribute,
    decode_scalar,
    decode_value,
    encode_scalar,
    encode_value,
)
from eap.errors import CodecError, MalformedError, TruncatedError

UNSIGNED = SoeAttribute(length=2, display=Display.UNSIGNED)
IDNS = SoeAttribute(length=1, is_list=1, display=Display.IDN)
TEXT = SoeAttribute(length=0, is_list=1, display=Display.TEXT)


@pytest.mark.parametrize(
    ("display", "length", "value", "octets"),
    [
        (Display.UNSIGNED, 0, 200, "c8"),
        (Display.SIGNED, 0, -56, "c8"),
        (Display.HEXADECIMAL, 1, 0xBEEF, "efbe"),
        (Display.SIGNED, 2, -2, "feffffff"),
        (Display.BINARY, 3, 1 << 63, "0000000000000080"),
        (Display.FLOAT, 2, 1.5, "0000c03f"),
        (Display.FLOAT, 3, -2.0, "00000000000000c0"),
        (Display.FLOAT, 1, 3, "0300"),
        (Display.IDN, 1, 0x8064, "6480"),
    ],
)
def test_one_value(display: Display, length: int, value: float, octets: str) -> None:
    attribute = SoeAttribute(length=length, display=display)
    assert encode_value(attribute, value) == bytes.fromhex(octets)
    assert decode_value(attribute, bytes.fromhex(octets) + b"more") == value


def test_list_and_text() -> None:
    assert encode_value(IDNS, [32, 33], max_length=8) == bytes.fromhex("0400 0800 2000 2100")
    assert decode_value(IDNS, bytes.fromhex("0400 0800 2000 2100")) == [32, 33]
    assert encode_value(IDNS, 32) == bytes.fromhex("0200 0200 2000")
    assert decode_value(IDNS, bytes(4)) == []
    assert encode_value(TEXT, "drive") == bytes.fromhex("0500 0500") + b"drive"
    assert decode_value(TEXT, bytes.fromhex("0700 0700") + b"drive\0\0") == "drive"


@pytest.mark.parametrize("value", [-1, 1 << 32, "5", 1.5, None])
def test_what_is_no_value_is_refused(value: object) -> None:
    expected = "is no value of 4 octets: expected a whole number from 0 to 4294967295"
    with pytest.raises(ValueError, match=expected):
        encode_scalar(UNSIGNED, value)


def test_what_is_expected_instead_is_said() -> None:
    signed = SoeAttribute(length=0, display=Display.SIGNED)
    with pytest.raises(ValueError, match="expected a whole number from -128 to 127"):
        encode_scalar(signed, 128)
    single = SoeAttribute(length=2, display=Display.FLOAT)
    for value in ("5", 1e300):
        with pytest.raises(ValueError, match="expected a number"):
            encode_scalar(single, value)


def test_value_that_is_cut_is_truncated() -> None:
    with pytest.raises(TruncatedError, match="3 octets for a value of 4"):
        decode_scalar(UNSIGNED, bytes(3))
    with pytest.raises(MalformedError, match="3 octets for values of 2"):
        decode_value(IDNS, bytes.fromhex("0300 0400 200021"))


attributes = st.builds(
    SoeAttribute,
    length=st.integers(0, 3),
    is_list=st.integers(0, 1),
    display=st.integers(0, 7),
)


@given(attributes, st.binary(max_size=30))
def test_any_octets_are_a_value_or_codec_error(attribute: SoeAttribute, noise: bytes) -> None:
    try:
        value = decode_value(attribute, noise)
    except CodecError:
        return
    parts = value if isinstance(value, list) else [value]
    if attribute.display == Display.TEXT or any(x != x or math.isinf(x) for x in parts):  # noqa: PLR0124
        return
    again = encode_value(attribute, value)
    assert decode_value(attribute, again) == value
