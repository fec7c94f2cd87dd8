from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.datatypes import DataType, parse
from eap.errors import TruncatedError

INTEGERS = [
    *("SINT", "USINT", "INT", "UINT", "DINT", "UDINT", "LINT", "ULINT", "BYTE", "WORD", "DWORD"),
    *(f"{sign}INT{width}" for sign in ("", "U") for width in (24, 40, 48, 56)),
    *(f"BIT{width}" for width in range(1, 9)),
]
OTHERS = ["BOOL", "REAL", "LREAL", "STRING(9)", "BLOCK(5)", "INT[3]", "UINT24[2]", "LREAL[2]"]
any_type = st.sampled_from([parse(text) for text in INTEGERS + OTHERS])


def values(kind: DataType) -> st.SearchStrategy:
    """Any value of *kind*."""
    name, _, _ = kind.text.partition("(")
    if kind.count > 1:
        element = values(parse(kind.text.partition("[")[0]))
        return st.tuples(*[element] * kind.count)
    if name == "BOOL":
        return st.booleans()
    if name == "BLOCK":
        return st.binary(min_size=kind.size, max_size=kind.size)
    if name == "STRING":
        letters = st.characters(exclude_characters="\0", exclude_categories=["Cs"])
        return st.text(letters).filter(lambda text: len(text.encode()) <= kind.size)
    if "REAL" in name:
        return st.floats(width=32 if name == "REAL" else 64, allow_nan=False)
    return st.integers(*kind.scalar_range)


@given(any_type.flatmap(lambda kind: st.tuples(st.just(kind), values(kind))), st.integers(0, 4))
def test_round_trip_touches_only_its_octets(pair: tuple[DataType, Any], offset: int) -> None:
    kind, value = pair
    image = bytearray(b"\xa5" * (kind.size + 8))
    kind.write(memoryview(image), offset, value)
    assert kind.read(image, offset) == value
    assert kind.read(memoryview(image), offset) == value
    assert image[:offset] == b"\xa5" * offset
    assert image[offset + kind.size :] == b"\xa5" * (8 - offset)


@given(any_type.flatmap(lambda kind: st.tuples(st.just(kind), values(kind))))
def test_plain_form_round_trip(pair: tuple[DataType, Any]) -> None:
    kind, value = pair
    assert kind.from_plain(kind.to_plain(value)) == value


@given(any_type, st.binary(min_size=27, max_size=27))
def test_any_octets_read_as_a_value(kind: DataType, noise: bytes) -> None:
    value = kind.read(noise, 0)
    assert isinstance(value, type(kind.zero))


@given(any_type, st.data())
def test_short_buffer_is_truncated_and_untouched(kind: DataType, data: st.DataObject) -> None:
    size = data.draw(st.integers(0, kind.size - 1))
    image = bytearray(size)
    for offset in (0, -1, size + 1):
        with pytest.raises(TruncatedError, match="needs"):
            kind.read(image, offset)
        with pytest.raises(TruncatedError, match="needs"):
            kind.write(image, offset, kind.zero)
    assert image == bytes(size)


@pytest.mark.parametrize("text", INTEGERS)
def test_integer_limits(text: str) -> None:
    kind = parse(text)
    low, high = kind.scalar_range
    image = bytearray(kind.size)
    for value in (low, high):
        kind.write(image, 0, value)
        assert kind.read(image, 0) == value
    for value in (low - 1, high + 1):
        with pytest.raises(ValueError, match=rf"{value} is not a value of {text}: .*to {high}"):
            kind.write(image, 0, value)
    assert kind.read(image, 0) == high


@pytest.mark.parametrize(
    ("text", "value", "octets"),
    [
        ("INT", -2, "feff"),
        ("UINT24", 0x123456, "563412"),
        ("INT24", -1, "ffffff"),
        ("INT40", -(2**39), "0000000080"),
        ("ULINT", 1, "0100000000000000"),
        ("REAL", 1.5, "0000c03f"),
        ("LREAL", -2, "00000000000000c0"),
        ("BOOL", True, "01"),
        ("BIT3", 5, "05"),
        ("STRING(4)", "ä", "c3a40000"),
        ("BLOCK(2)", b"\x01\x02", "0102"),
        ("UINT[2]", [1, 2], "01000200"),
    ],
)
def test_octets(text: str, value: Any, octets: str) -> None:
    kind = parse(text)
    assert kind.encode(value).hex() == octets
    assert kind.encode(kind.read(bytes.fromhex(octets), 0)).hex() == octets


def test_octets_of_a_text_are_taken_as_they_are() -> None:
    assert parse("STRING(3)").encode(b"\xe4\xf6\0") == b"\xe4\xf6\0"


@pytest.mark.parametrize(
    ("text", "value", "reason"),
    [
        ("UINT", 1.5, "whole number from 0 to 65535"),
        ("UINT", "7", "whole number"),
        ("BOOL", 2, "true or false"),
        ("BOOL", "true", "true or false"),
        ("REAL", 1e39, "a number from -3.4"),
        ("LREAL", 10**400, "a number from -1.7"),
        ("REAL", "1", "a number"),
        ("STRING(3)", "abcd", "at most 3 bytes, this text has 4"),
        ("STRING(3)", "a\0b", "without NUL"),
        ("STRING(3)", "\ud800", "surrogates"),
        ("STRING(3)", b"ab", "a text"),
        ("BLOCK(3)", b"ab", "3 bytes, these are 2"),
        ("BLOCK(3)", "abc", "3 bytes"),
        ("UINT[2]", [1], "2 values, these are 1"),
        ("UINT[2]", [1, 70000], "element 1 of UINT"),
        ("UINT[2]", 7, "2 values"),
        ("UINT[2]", b"\1\2", "2 values"),
    ],
)
def test_wrong_value_is_refused_and_nothing_written(text: str, value: Any, reason: str) -> None:
    kind = parse(text)
    image = bytearray(b"\xa5" * kind.size)
    with pytest.raises(ValueError, match=reason):
        kind.write(image, 0, value)
    assert image == b"\xa5" * kind.size


def test_long_value_is_cut_in_the_message() -> None:
    with pytest.raises(ValueError, match="…") as caught:
        parse("BLOCK(600)").encode(bytes(599))
    assert len(str(caught.value)) < 140


def test_bits_beyond_the_field_are_ignored() -> None:
    assert parse("BIT3").read(b"\xfd", 0) == 5
    assert parse("BOOL").read(b"\x80", 0) is True


def test_text_ends_at_nul_and_survives_bad_octets() -> None:
    assert parse("STRING(6)").read(b"ab\0cde", 0) == "ab"
    assert parse("STRING(2)").read(b"a\xff", 0) == "a\N{REPLACEMENT CHARACTER}"


@pytest.mark.parametrize(
    ("octets", "text"),
    [
        ("610000006200", "a"),
        ("61006200", "ab"),
        ("00d86200", "\N{REPLACEMENT CHARACTER}b"),
        ("3dd800de", "\N{GRINNING FACE}"),
        ("61003dd800de", "a\N{REPLACEMENT CHARACTER}"),
    ],
)
def test_wide_text_ends_at_nul_and_survives_bad_units(octets: str, text: str) -> None:
    kind = parse("WSTRING(2)")
    # The last unit is that of the NUL, whatever a peer puts there.
    read = kind.read(bytes.fromhex(octets).ljust(6, b"\0"), 0)
    assert read == text
    assert kind.read(kind.encode(read), 0) == text


@pytest.mark.parametrize(
    ("text", "value", "reason"),
    [
        ("WSTRING(2)", "abc", "at most 2 units of UTF-16, this text has 3"),
        ("WSTRING(2)", "a\N{GRINNING FACE}", "this text has 3"),
        ("WSTRING(2)", "a\0", "without NUL"),
        ("WSTRING(2)", "\ud800", "surrogates"),
        ("WSTRING(2)", 5, "expected a text"),
        ("WCHAR", "ab", "one character below U.10000"),
        ("WCHAR", "\N{GRINNING FACE}", "one character"),
        ("WCHAR", "\ud800", "one character"),
        ("WCHAR", "\0", "one character"),
        ("WCHAR", 5, "one character"),
    ],
)
def test_wrong_wide_text_is_refused(text: str, value: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse(text).encode(value)


def test_wide_char_is_one_unit_or_empty() -> None:
    kind = parse("WCHAR")
    assert kind.encode("Ω").hex() == "a903"
    assert (kind.read(b"\xa9\x03", 0), kind.read(b"\0\0", 0)) == ("Ω", "")
    assert kind.parse_text("Ω") == "Ω"


def test_not_a_number_passes() -> None:
    kind = parse("LREAL")
    value = kind.read(struct.pack("<d", math.nan), 0)
    assert isinstance(value, float)
    assert math.isnan(value)


@pytest.mark.parametrize(
    ("text", "typed", "value"),
    [
        ("INT", "-5", -5),
        ("INT", "007", 7),
        ("UINT", "0xFF", 255),
        ("UINT", " 0b11 ", 3),
        ("BOOL", "True", True),
        ("BOOL", "off", False),
        ("REAL", "-1.5e3", -1500.0),
        ("STRING(5)", "a,b", "a,b"),
        ("BLOCK(3)", "01 02ff", b"\x01\x02\xff"),
        ("INT[3]", "1, 0x10,-3", (1, 16, -3)),
        ("REAL[2]", "[1,2.5]", (1.0, 2.5)),
    ],
)
def test_typed_value(text: str, typed: str, value: Any) -> None:
    assert parse(text).parse_text(typed) == value


@pytest.mark.parametrize(
    ("text", "typed", "reason"),
    [
        ("INT", "five", "whole number from -32768"),
        ("INT", "40000", "whole number"),
        ("BOOL", "yes?", "true or false"),
        ("REAL", "1,5", "a number such as"),
        ("REAL", "1e99", "a number from"),
        ("STRING(2)", "abc", "at most 2 bytes"),
        ("BLOCK(2)", "0g", "in hexadecimal"),
        ("BLOCK(2)", "010203", "2 bytes, these are 3"),
        ("INT[2]", "1,2,3", "2 values between commas, these are 3"),
        ("INT[2]", "1,x", "'x' is not a value of INT"),
    ],
)
def test_typed_value_refused(text: str, typed: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse(text).parse_text(typed)


def test_block_of_a_plant_file_is_hexadecimal_text() -> None:
    assert parse("BLOCK(2)").from_plain("01ff") == b"\x01\xff"
    for wrong in (511, "zz", b"\x01\xff"):
        with pytest.raises(ValueError, match="2 bytes"):
            parse("BLOCK(2)").from_plain(wrong)


def test_only_single_numbers_have_a_range() -> None:
    ranges = {text: parse(text).scalar_range for text in OTHERS}
    assert ranges["BOOL"] == (0, 1)
    assert ranges["REAL"] == pytest.approx((-3.4028234663852886e38, 3.4028234663852886e38))
    assert ranges["LREAL"] == (-math.nextafter(math.inf, 0), math.nextafter(math.inf, 0))
    assert [ranges[text] for text in ("STRING(9)", "BLOCK(5)", "INT[3]")] == [None] * 3
