from __future__ import annotations

import math
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.bridges.opcua.values import (
    DURATION,
    MISMATCH,
    SCALAR,
    BuiltIn,
    Definition,
    UaType,
    converter,
    definitions_of,
)
from eap.codec.datatypes import parse

NOON = datetime(2026, 11, 23, 12, 30, 15, tzinfo=UTC)
UNION = "U<4/4:whole@0 UDINT,low@0 UINT>"
POINT = "ST_Point<8/4:x@0 REAL,y@4 REAL>"
STATE = "E_State<INT:Stopped=0,Moving=1,Fault=2>"
AXIS = f"ST_Axis<24/8:position@0 LREAL,state@8 {STATE},on@10 BOOL8,moved@12 TIME,name@16 STRING(8)>"


@pytest.mark.parametrize(
    ("text", "built_in", "plain", "value"),
    [
        ("BOOL", BuiltIn.BOOLEAN, True, True),
        ("SINT", BuiltIn.SBYTE, -128, -128),
        ("BYTE", BuiltIn.BYTE, 255, 255),
        ("BIT3", BuiltIn.BYTE, 7, 7),
        ("INT", BuiltIn.INT16, -2, -2),
        ("WORD", BuiltIn.UINT16, 65535, 65535),
        ("INT24", BuiltIn.INT32, -3, -3),
        ("UINT24", BuiltIn.UINT32, 3, 3),
        ("UDINT", BuiltIn.UINT32, 4294967295, 4294967295),
        ("INT56", BuiltIn.INT64, -4, -4),
        ("ULINT", BuiltIn.UINT64, (1 << 64) - 1, (1 << 64) - 1),
        ("REAL", BuiltIn.FLOAT, 1.5, 1.5),
        ("LREAL", BuiltIn.DOUBLE, 1e300, 1e300),
        ("STRING(8)", BuiltIn.STRING, "grün", "grün"),
        ("WSTRING(8)", BuiltIn.STRING, "", ""),
        ("BLOCK(3)", BuiltIn.BYTESTRING, "00ff10", b"\x00\xff\x10"),
        ("TIME", BuiltIn.DOUBLE, "T#1m30s5ms", 90005.0),
        ("LTIME", BuiltIn.DOUBLE, "LTIME#1us500ns", 0.0015),
        ("TOD", BuiltIn.DOUBLE, "TOD#00:00:01.25", 1250.0),
        (
            "DT",
            BuiltIn.DATETIME,
            "DT#2026-11-23-12:30:15",
            NOON,
        ),
        ("LDATE", BuiltIn.DATETIME, "LDATE#2026-11-23", datetime(2026, 11, 23, tzinfo=UTC)),
        (STATE, BuiltIn.INT32, "Moving", 1),
        (STATE, BuiltIn.INT32, 7, 7),
        ("E_Big<UDINT:On=4000000000>", BuiltIn.UINT32, "On", 4000000000),
        ("INT[3]", BuiltIn.INT16, [1, 2, 3], [1, 2, 3]),
        ("INT[2,2]", BuiltIn.INT16, [[1, 2], [3, 4]], [[1, 2], [3, 4]]),
        (
            UNION,
            BuiltIn.BYTESTRING,
            {"whole": 258, "low": 258},
            b"\x02\x01\0\0",
        ),
    ],
)
def test_value_of_each_type_is_that_of_a_variant_and_comes_back(text, built_in, plain, value):
    made = converter(parse(text))
    assert made.type.built_in is built_in
    assert made.from_plain(plain) == value
    assert made.to_plain(value) == plain


def test_type_has_data_type_rank_and_dimensions():
    assert converter(parse("REAL[4]")).type == UaType(BuiltIn.FLOAT, BuiltIn.FLOAT, 1, (4,))
    assert converter(parse("REAL[1..3,2]")).type.dimensions == (3, 2)
    assert converter(parse("TIME")).type == UaType(BuiltIn.DOUBLE, DURATION)
    assert converter(parse("UINT")).type.rank == SCALAR


# By hand, as OPC 10000-6 encodes Double, Int32, Boolean, Double and String.
ENCODED = bytes.fromhex("0000000000000c400100000001000000000040bf40040000006c656674")


def test_struct_has_the_binary_encoding_of_its_members():
    made = converter(parse(AXIS))
    plain = {"position": 3.5, "state": "Moving", "on": True, "moved": "T#8s", "name": "left"}
    assert made.from_plain(plain) == ENCODED
    assert made.to_plain(ENCODED) == plain
    definition = made.type.data_type
    assert isinstance(definition, Definition)
    assert [each.name for each in definition.fields] == ["position", "state", "on", "moved", "name"]
    assert [each.name for each in definitions_of(made.type)] == ["E_State", "ST_Axis"]


def test_struct_of_structs_and_arrays_comes_back():
    made = converter(parse(f"ST_Line<40/4:ends@0 {POINT}[2],grid@16 INT[2,3],at@28 {POINT}>"))
    ends = [{"x": 1.0, "y": 2.0}, {"x": 3.0, "y": 4.0}]
    plain = {"ends": ends, "grid": [[1, 2, 3], [4, 5, 6]], "at": ends[0]}
    assert made.to_plain(made.from_plain(plain)) == plain
    # Clients disagree about arrays of several dimensions in structures: it is a flat one.
    assert made.type.data_type.fields[1].type == UaType(BuiltIn.INT16, BuiltIn.INT16, 1, (6,))


def test_another_definition_of_the_same_name_is_another_type():
    one = converter(parse(POINT)).type.data_type
    two = converter(parse("ST_Point<16/8:x@0 LREAL,y@8 LREAL>")).type.data_type
    assert one.name == two.name
    assert one.node_id != two.node_id
    assert converter(parse(POINT + "[3]")).type.data_type.node_id == one.node_id


def test_number_that_json_cannot_carry_is_not_a_number():
    assert math.isnan(converter(parse("REAL")).from_plain(None))
    assert math.isnan(converter(parse("LREAL[2]")).from_plain([1.0, None])[1])


@pytest.mark.parametrize(
    ("text", "plain"),
    [
        ("UINT", 65536), ("UINT", 1.5), ("UINT", "1"), ("UINT", True), ("BOOL", 1), ("REAL", "x"),
        ("REAL", 1e39), ("STRING(4)", 5), (STATE, "Flying"), ("INT[3]", 5), (POINT, {"x": 1.0}),
        (POINT, None), ("BLOCK(2)", "xyz"), ("TIME", 5),
    ],
)  # fmt: skip
def test_plain_value_of_another_type_is_refused(text, plain):
    with pytest.raises(MISMATCH):
        converter(parse(text)).from_plain(plain)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("REAL", math.inf), ("LREAL", math.nan), ("UINT", -1), ("TIME", -1.0), ("TIME", math.inf),
        ("TIME", 1e20), ("TOD", 86_400_000.0), ("DT", datetime(1969, 1, 1, tzinfo=UTC)),
        ("BLOCK(2)", b"abc"),
        ("INT[3]", [1, 2]), ("INT[2,2]", [1, 2, 3, 4]), ("INT[2]", None), (AXIS, ENCODED + b"x"),
        (AXIS, ENCODED[:-1]), (AXIS, b""),
    ],
)  # fmt: skip
def test_value_of_a_client_that_the_type_lacks_is_refused(text, value):
    with pytest.raises(MISMATCH):
        converter(parse(text)).to_plain(value)


@given(st.binary(max_size=64))
def test_arbitrary_structure_of_a_client_is_read_or_refused(data):
    made = converter(parse(f"ST_Any<64/8:axis@0 {AXIS},ends@24 {POINT}[2],raw@40 BLOCK(4)>"))
    try:
        plain = made.to_plain(data)
    except MISMATCH:
        return
    assert made.to_plain(made.from_plain(plain)) == plain
