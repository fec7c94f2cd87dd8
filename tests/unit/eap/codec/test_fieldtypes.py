"""Values in data blocks and registers: bytes by the manuals, alignment, and round trips."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.codec.fieldaddresses import FieldPlace, modbus_point, place_text, s7_point
from eap.codec.fieldtypes import FieldStruct, modbus_type, s7_type

# Manuals of Siemens: S7-1200/1500 data types.  16#… of WinCC's examples where they have them.
S7 = [
    ("BOOL", "", True, "01"),
    ("SINT", "", -2, "fe"),
    ("UINT", "", 0x1234, "1234"),
    ("DINT", "", -2, "fffffffe"),
    ("LINT", "", 1, "0000000000000001"),
    ("REAL", "", 1.0, "3f800000"),
    ("LREAL", "", -2.0, "c000000000000000"),
    ("REAL", "INT", 234.6, "00eb"),
    ("INT", "REAL", 2, "40000000"),
    ("BOOL", "BYTE", True, "01"),
    ("STRING(8)", "", "AB", "0802" + "4142" + "00" * 6),
    ("STRING(8)", "STRING[2]", "é", "0201" + "e900"),
    ("STRING(8)", "CHAR", "A", "41"),
    ("WSTRING(3)", "", "Ä", "00030001" + "00c4" + "0000" * 2),
    ("WCHAR", "", "Ä", "00c4"),
    ("TIME", "", "T#1s", "000003e8"),
    ("LTIME", "", "LTIME#1us", "00000000000003e8"),
    ("TIME", "S5TIME", "T#1m3s", "1630"),
    ("TIME", "S5TIME", "T#9990ms", "0999"),
    ("TIME", "S5TIME", "T#12s340ms", "1123"),
    ("TOD", "", "TOD#00:00:01", "000003e8"),
    ("LTOD", "", "LTOD#00:00:00.000001", "00000000000003e8"),
    ("DATE", "", "D#1990-01-02", "0001"),
    ("LDATE", "", "LDATE#1990-01-02", "0001"),
    # 24 December 2026 is a Thursday: day 5 of the week.
    ("DT", "", "DT#2026-12-24-20:30:15", "07ea0c1805141e0f00000000"),
    ("LDT", "DTL", "LDT#2026-12-24-20:30:15.250", "07ea0c1805141e0f0ee6b280"),
    ("LDT", "DATE_AND_TIME", "LDT#2026-12-24-20:30:15.123", "2612242030151235"),
    ("LDT", "", "LDT#1970-01-01-00:00:01", "000000003b9aca00"),
    ("BLOCK(3)", "", "010203", "01020300"),
    ("BOOL[10]", "", [True, *[False] * 8, True], "0102"),
    ("INT[2]", "", [1, -1], "0001ffff"),
    ("BYTE[3]", "", [1, 2, 3], "01020300"),
    ("STRING(1)[2]", "", ["a", "b"], "0101" + "61" + "00" + "0101" + "62" + "00"),
    ("INT (0..9)", "", 7, "0007"),
    ("E<INT:Off=0,On=1>", "", "On", "0001"),
    (
        "S<16/4:a@0 BOOL8,b@1 BOOL8,c@4 REAL,d@8 USINT,e@12 BYTE[3],f@15 SINT>",
        "",
        {"a": True, "b": True, "c": 1.0, "d": 5, "e": [1, 2, 3], "f": -1},
        "0300" + "3f800000" + "0500" + "01020300" + "ff00",
    ),
]
MODBUS = [
    ("INT", "", -2, "fffe"),
    ("USINT", "", 7, "0007"),
    ("SINT", "", -1, "ffff"),
    ("BOOL", "", True, "0001"),
    ("REAL", "", 1.0, "3f800000"),
    ("REAL", "INT", 12.4, "000c"),
    ("ULINT", "", 1, "0000000000000001"),
    ("STRING(3)", "", "abc", "61626300"),
    ("WSTRING(1)", "", "Ä", "00c40000"),
    ("TIME", "", "T#1s", "000003e8"),
    ("BLOCK(3)", "", "010203", "01020300"),
    ("DINT[2]", "", [1, -1], "00000001ffffffff"),
    ("S<8/4:a@0 BOOL8,c@4 REAL>", "", {"a": True, "c": 1.0}, "0001" + "3f800000"),
]


def value_of(kind: datatypes.DataType, plain: Any) -> Any:
    return kind.from_plain(plain)


@pytest.mark.parametrize(("text", "other", "plain", "octets"), S7)
def test_s7_value_has_the_bytes_of_the_manual(
    text: str, other: str, plain: Any, octets: str
) -> None:
    kind = datatypes.parse(text)
    field = s7_type(kind, other)
    data = field.encode(value_of(kind, plain))
    assert data.hex() == octets
    assert len(data) == field.size
    again = kind.to_plain(field.decode(data))
    if other not in {"INT", "S5TIME"}:
        assert again == kind.to_plain(value_of(kind, plain))


@pytest.mark.parametrize(
    ("text", "other", "octets"),
    [("DATE", "", "0000"), ("LDATE", "", "0000"), ("DT", "DATE_AND_TIME", "9001010000000002")],
)
def test_date_that_was_never_set_is_the_first_one_of_s7(text: str, other: str, octets: str) -> None:
    kind = datatypes.parse(text)
    field = s7_type(kind, other)
    assert field.encode(kind.zero).hex() == octets
    assert "1990-01-01" in str(kind.to_plain(field.decode(bytes.fromhex(octets))))
    with pytest.raises(ValueError, match="out of range"):
        field.encode(kind.from_plain(str(kind.to_plain(kind.zero)).replace("1970", "1989")))


@pytest.mark.parametrize(("text", "other", "plain", "octets"), MODBUS)
def test_register_value_has_its_bytes(text: str, other: str, plain: Any, octets: str) -> None:
    kind = datatypes.parse(text)
    field = modbus_type(kind, other)
    data = field.encode(value_of(kind, plain))
    assert data.hex() == octets
    if not other:
        assert kind.to_plain(field.decode(data)) == kind.to_plain(value_of(kind, plain))


@pytest.mark.parametrize(
    ("words", "octets", "expected"),
    [(False, False, "0a0b0c0d"), (True, False, "0c0d0a0b"),
     (False, True, "0b0a0d0c"), (True, True, "0d0c0b0a")],
)  # fmt: skip
def test_orders_of_words_and_bytes(*, words: bool, octets: bool, expected: str) -> None:
    kind = datatypes.parse("UDINT")
    field = modbus_type(kind, words_swapped=words, bytes_swapped=octets)
    assert field.encode(0x0A0B0C0D).hex() == expected
    assert field.decode(bytes.fromhex(expected)) == 0x0A0B0C0D


@pytest.mark.parametrize(
    ("text", "other", "part"),
    [
        ("REAL", "STRING[3]", "does not hold STRING"),
        ("STRING(4)", "STRING", "lacks its length"),
        ("STRING(300)", "", "1 to 254 characters"),
        ("REAL", "RAEL", "did you mean REAL?"),
        ("INT24", "", "no counterpart"),
        ("TIME", "INT", "does not hold INT"),
        ("U<4/4:a@0 REAL,b@0 DINT>", "", "is a union"),
    ],
)
def test_types_without_counterpart_are_refused(text: str, other: str, part: str) -> None:
    with pytest.raises(ValueError, match=part.replace("?", r"\?")):
        s7_type(datatypes.parse(text), other)


@pytest.mark.parametrize(
    ("text", "other", "octets"),
    [
        ("INT", "REAL", "7fc00000"),
        ("USINT", "INT", "0100"),
        ("TIME", "", "ffffffff"),
        ("DT", "", "07ea0d1805141e0f00000000"),
        ("DT", "DATE_AND_TIME", "2612244030151235"),
        ("TIME", "S5TIME", "0a00"),
        ("INT (0..9)", "", "000a"),
    ],
)
def test_bytes_that_the_variable_cannot_hold_are_refused(
    text: str, other: str, octets: str
) -> None:
    with pytest.raises(ValueError, match=r"."):
        s7_type(datatypes.parse(text), other).decode(bytes.fromhex(octets))


@pytest.mark.parametrize(
    ("text", "other", "value"),
    [("REAL", "INT", 40000.0), ("REAL", "INT", float("nan")), ("STRING(8)", "STRING[2]", "abc"),
     ("STRING(8)", "", "Ω")],
)  # fmt: skip
def test_values_that_do_not_fit_are_refused(text: str, other: str, value: Any) -> None:
    with pytest.raises(ValueError, match=r"."):
        s7_type(datatypes.parse(text), other).encode(value)


@given(st.binary(min_size=16, max_size=16))
def test_any_bytes_are_a_value_or_refused(data: bytes) -> None:
    for text, other, _, _ in S7:
        field = s7_type(datatypes.parse(text), other)
        if field.size > len(data):
            continue
        try:
            value = field.decode(data[: field.size])
        except ValueError:
            continue
        field.encode(value)


def test_struct_is_laid_out_as_a_data_block_is() -> None:
    field = s7_type(datatypes.parse("S<8/4:a@0 BOOL8,b@4 REAL>"))
    assert isinstance(field, FieldStruct)
    assert [each.offset for each in field.members] == [0, 16]


@pytest.mark.parametrize(
    ("kind", "address", "other", "place"),
    [
        ("REAL", "DB1.DBD4", "", FieldPlace("DB1", 32)),
        ("BOOL", "db12.dbx3.7", "", FieldPlace("DB12", 31)),
        ("INT", "DB1,DBW2", "", FieldPlace("DB1", 16)),
        ("REAL", "DB1.8", "INT", FieldPlace("DB1", 64)),
        ("LREAL", "DB1.DBB8", "", FieldPlace("DB1", 64)),
        ("BOOL", "M10.1", "", FieldPlace("M", 81)),
        ("WORD", "AW4", "", FieldPlace("Q", 32)),
        ("BYTE", "EB4", "", FieldPlace("I", 32)),
    ],
)
def test_s7_addresses(kind: str, address: str, other: str, place: FieldPlace) -> None:
    point = s7_point(datatypes.parse(kind), address, other)
    assert point.place == place
    again = s7_point(datatypes.parse(kind), place_text(point), other)
    assert again.place == place


@pytest.mark.parametrize(
    ("kind", "address", "place"),
    [
        ("REAL", "holding:100", FieldPlace("holding", 1600)),
        ("BOOL", "coil:7", FieldPlace("coil", 7)),
        ("BOOL", "holding:1.0", FieldPlace("holding", 24)),
        ("BOOL", "input:1.15", FieldPlace("input", 23)),
    ],
)
def test_modbus_addresses(kind: str, address: str, place: FieldPlace) -> None:
    point = modbus_point(datatypes.parse(kind), address)
    assert point.place == place
    assert place_text(point) == address


@pytest.mark.parametrize(
    ("kind", "address", "part"),
    [
        ("REAL", "DB1.DBW4", "has 16 bits, REAL has 32"),
        ("BOOL", "DB1.DBB4", "expected a bit"),
        ("REAL", "DB1.DBX4.0", "expected no bit"),
        ("REAL", "DB0.DBD4", "from 1 to 65535"),
        ("REAL", "D4", "no S7 address"),
        ("LREAL", "DB1.DBB65535", "behind the last address"),
    ],
)
def test_wrong_s7_address_is_refused(kind: str, address: str, part: str) -> None:
    with pytest.raises(ValueError, match=part):
        s7_point(datatypes.parse(kind), address)


@pytest.mark.parametrize(
    ("kind", "address", "part"),
    [
        ("REAL", "40001", "no address"),
        ("REAL", "coil:1", "no single bit"),
        ("BOOL", "holding:1.16", "from 0 to 15"),
        ("REAL", "holding:65535", "behind the last address"),
    ],
)
def test_wrong_modbus_address_is_refused(kind: str, address: str, part: str) -> None:
    with pytest.raises(ValueError, match=part):
        modbus_point(datatypes.parse(kind), address)
