"""Values of entries in text and JSON."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.od.notation import parse, plain, show

KINDS = ["BOOL", "BIT3", "SINT", "UINT", "UDINT", "LINT", "REAL", "LREAL", "REAL[3]", "UINT24[2]",
         "BLOCK(6)", "BLOCK(4)", "BLOCK(9)"]  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "name", "octets", "value"),
    [
        ("BLOCK(6)", "Destination MAC", "010105040000", "01:01:05:04:00:00"),
        ("BLOCK(6)", "Publisher", "7f0001010201", "127.0.1.1.2.1"),
        ("BLOCK(6)", "Destination NetID", "7f0001010201", "127.0.1.1.2.1"),
        ("BLOCK(6)", "Key", "7f0001010201", "7f0001010201"),
        ("BLOCK(4)", "Monitor IP", "7f000101", "127.0.1.1"),
        ("BLOCK(4)", "Recipe", "7f000101", "7f000101"),
        ("UINT", "Level", "0001", 256),
        ("UINT", "Level", "00", None),
        ("STRING(8)", "Name", "6162", "ab"),
        ("STRING(8)", "Name", "61620000", "ab"),
        ("REAL[2]", "Curve", "0000803f0000c03f", [1.0, 1.5]),
    ],
)
def test_plain(kind, name, octets, value):
    assert plain(datatypes.parse(kind), name, bytes.fromhex(octets)) == value


@pytest.mark.parametrize(
    ("kind", "value", "text"),
    [
        ("REAL", 2.01, "2.01"),
        ("REAL", 0.0, "0.0"),
        ("REAL", 16777217.0, "16777216.0"),
        ("REAL", 3.4028234663852886e38, "3.4028235e+38"),
        ("REAL", math.inf, "inf"),
        ("LREAL", 2.01, "2.01"),
        ("LREAL", 1 / 3, "0.3333333333333333"),
    ],
)
def test_numbers_are_shown_with_as_many_digits_as_they_have(kind, value, text):
    parsed = datatypes.parse(kind)
    assert show(parsed, "Level", parsed.encode(value)) == text


@pytest.mark.parametrize(
    ("kind", "text", "octets"),
    [
        ("BLOCK(6)", "01-01-05-04-00-00", "010105040000"),
        ("BLOCK(6)", "127.0.1.1.2.1", "7f0001010201"),
        ("BLOCK(6)", "7f 00 01 01 02 01", "7f0001010201"),
        ("BLOCK(4)", "127.0.1.1", "7f000101"),
        ("STRING(8)", "ab", "6162"),
        ("STRING(8)", "", ""),
        ("UDINT", "0x1A00", "001a0000"),
        ("BOOL", "on", "01"),
        ("UINT[2]", "1,2", "01000200"),
        ("UDINT", "0x6000:01/32", "20010060"),
        ("UDINT", "6000:01/32", "20010060"),  # as dumps had it before
        ("UINT", "0x1A00", "001a"),
    ],
)
def test_parse(kind, text, octets):
    assert parse(datatypes.parse(kind), text).hex() == octets


@pytest.mark.parametrize(
    ("kind", "text", "reason"),
    [
        ("UINT", "65536", "0 to 65535"),
        ("BLOCK(4)", "300.0.0.1", "300"),
        ("BLOCK(6)", "300.0.0.1.1.1", "above 255"),
        ("BLOCK(6)", "127.0.1.1", "hexadecimal"),
        ("STRING(2)", "abc", "STRING"),
    ],
)
def test_parse_says_what_was_expected(kind, text, reason):
    with pytest.raises(ValueError, match=reason):
        parse(datatypes.parse(kind), text)


@given(
    st.sampled_from(KINDS),
    st.binary(min_size=24, max_size=24),
    st.sampled_from(["", "NetID", "Mapping 1", "PDO index"]),
)
def test_shown_value_is_parsed_back(text, octets, name):
    kind = datatypes.parse(text)
    value = kind.decode(octets[: kind.size], 0)
    numbers = value if isinstance(value, tuple) else (value,)
    if any(isinstance(number, float) and math.isnan(number) for number in numbers):
        return  # there are many of them
    exact = kind.encode(value)
    shown = show(kind, name, exact)
    assert shown is not None
    assert parse(kind, shown) == exact


@pytest.mark.parametrize(
    ("kind", "name", "octets", "text"),
    [
        ("UDINT", "Mapping 3", "20010060", "0x6000:01/32"),
        ("UDINT", "Cycle time", "10270000", "10000"),
        ("UINT", "PDO index", "001a", "0x1A00"),
        ("UINT", "TxPD 1", "00d0", "0xD000"),
        ("UINT", "Poll request RxPD", "00e0", "0xE000"),
        ("UINT", "Version", "0a00", "10"),
        ("BOOL", "Enabled", "01", "true"),
        ("BLOCK(6)", "Publisher", "7f0001010201", "127.0.1.1.2.1"),
        ("UINT", "Version", "0a", None),
    ],
)
def test_show(kind, name, octets, text):
    assert show(datatypes.parse(kind), name, bytes.fromhex(octets)) == text
