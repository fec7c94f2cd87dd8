from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.codec.datatypes import layout, parse

# Index, bits and octets as the table of base data types in ETG.1020 gives them.
TABLE = {
    "BOOL": (0x01, 1, 1),
    "SINT": (0x02, 8, 1),
    "INT": (0x03, 16, 2),
    "DINT": (0x04, 32, 4),
    "USINT": (0x05, 8, 1),
    "UINT": (0x06, 16, 2),
    "UDINT": (0x07, 32, 4),
    "REAL": (0x08, 32, 4),
    "INT24": (0x10, 24, 3),
    "LREAL": (0x11, 64, 8),
    "INT40": (0x12, 40, 5),
    "INT48": (0x13, 48, 6),
    "INT56": (0x14, 56, 7),
    "LINT": (0x15, 64, 8),
    "UINT24": (0x16, 24, 3),
    "UINT40": (0x18, 40, 5),
    "UINT48": (0x19, 48, 6),
    "UINT56": (0x1A, 56, 7),
    "ULINT": (0x1B, 64, 8),
    "BYTE": (0x1E, 8, 1),
    "WORD": (0x1F, 16, 2),
    "DWORD": (0x20, 32, 4),
    "BIT1": (0x30, 1, 1),
    "BIT8": (0x37, 8, 1),
    "STRING(7)": (0x09, 56, 7),
    "BLOCK(7)": (0x0A, 56, 7),
}


@pytest.mark.parametrize("text", TABLE)
def test_base_type(text: str) -> None:
    kind = parse(text)
    assert (kind.code, kind.bit_length, kind.size) == TABLE[text]
    assert (kind.text, kind.count) == (text, 1)
    assert kind.is_bits == text.startswith("B") * (text[:3] in ("BOO", "BIT"))


@pytest.mark.parametrize(
    ("alias", "text"),
    [
        ("boolean", "BOOL"),
        ("bit", "BIT1"),
        *((name, "SINT") for name in ("I8", "INT8", "INTEGER8", "sint")),
        *((name, "USINT") for name in ("U8", "UINT8", "UNSIGNED8")),
        *((name, "INT") for name in ("i16", "INT16", "Integer16")),
        *((name, "INT24") for name in ("I24", "INTEGER24")),
        *((name, "UINT24") for name in ("U24", "UNSIGNED24")),
        *((name, "ULINT") for name in ("U64", "UINT64", "UNSIGNED64")),
        *((name, "REAL") for name in ("REAL32", "Real")),
        *((name, "LREAL") for name in ("REAL64", "lreal")),
        ("visible_string(3)", "STRING(3)"),
        ("OCTET_STRING( 3 )", "BLOCK(3)"),
        (" u16 [ 8 ] ", "UINT[8]"),
        ("ARRAY [0..7] OF UINT", "UINT[8]"),
        ("array [1..3] of real", "REAL[1..3]"),
        ("ARRAY [1..3, 0..1] OF REAL", "REAL[1..3,2]"),
        ("array[-1..1] of string(3)", "STRING(3)[-1..1]"),
        ("ARRAY [0..2] OF ARRAY [1..2] OF bool", "BOOL[1..2][3]"),
        ("BOOL8[3]", "BOOL[3]"),
        ("dint (-10..10)", "DINT(-10..10)"),
        ("time_of_day", "TOD"),
        ("Date_And_Time", "DT"),
    ],
)
def test_alias(alias: str, text: str) -> None:
    assert parse(alias) == parse(text)
    assert parse(alias).text == text


def test_array_has_the_code_of_its_elements() -> None:
    kind = parse("UINT24[4]")
    assert (kind.code, kind.bit_length, kind.size, kind.count) == (0x16, 96, 12, 4)
    assert kind.zero == (0, 0, 0, 0)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("UNIT", "'UNIT' is not a data type, did you mean UINT"),
        ("STRIN(4)", "did you mean STRING"),
        ("zzz", "is not a data type .such as UINT"),
        ("", "is not a data type"),
        ("UINT 16", "is not a data type"),
        ("STRING", "lacks its length in bytes, such as STRING.16."),
        ("UINT(3)", "UINT has a fixed length, arrays are UINT.3."),
        ("BIT2[8]", "arrays of bits are not supported"),
        ("WSTRING", "lacks its length in characters, such as WSTRING.16."),
        ("WSTRING(32767)", "has 65536 bytes"),
        ("REAL[1,2,3,4,5,6,7,8,9]", "has 9 dimensions: at most 8"),
        ("DINT(5..1)", "5..1 is no range of DINT: expected a range within -2147483648"),
        ("USINT(0..256)", "0..256 is no range of USINT"),
        ("REAL(0..1)", "is not a data type"),
        ("UINT[0]", "'UINT.0.' has no elements: expected a number of elements"),
        ("STRING(0)", "has 0 bytes"),
        ("ARRAY [3..0] OF UINT", "has no elements: expected .* such as 1..3"),
        ("BLOCK(65536)", "has 65536 bytes"),
        ("UINT[32768]", "has 65536 bytes"),
        ("UINT[2]2]", "is not a data type"),
    ],
)
def test_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse(text)


@given(st.text(max_size=20))
def test_any_text_names_a_type_or_raises_value_error(text: str) -> None:
    try:
        kind = parse(text)
    except ValueError as exc:
        # The message must show what was read, or the name in it that is no type.
        shown = [text, *re.findall(r"[A-Za-z_][A-Za-z0-9_.]*", text)]
        assert any(repr(each).strip("'") in str(exc) for each in shown)  # noqa: PT017
    else:
        assert parse(kind.text) is kind or parse(kind.text) == kind


def test_types_are_shared_and_cannot_be_changed() -> None:
    assert parse("UINT") is parse("UINT")
    with pytest.raises(AttributeError):
        parse("UINT").size = 3


@pytest.mark.parametrize(("name", "meant"), [("FLOAT", "REAL"), ("Double", "LREAL")])
def test_type_names_of_other_languages_are_refused_with_the_right_one(
    name: str, meant: str
) -> None:
    with pytest.raises(ValueError, match=f"'{name}' is not a data type, did you mean {meant}\\?"):
        parse(name)


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


def test_untyped_value_has_the_unsigned_type_of_its_length():
    named = {bits: name for bits in range(-1, 70) if (name := datatypes.untyped(bits))}
    assert list(named) == [*range(1, 9), 16, 32, 64]
    assert (named[1], named[2], named[8], named[64]) == ("BOOL", "BIT2", "USINT", "ULINT")
    assert all(datatypes.parse(name).bit_length == bits for bits, name in named.items())
