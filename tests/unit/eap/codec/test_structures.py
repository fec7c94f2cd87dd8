from __future__ import annotations

import ctypes
import zlib
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.arrays import Array
from eap.codec.basetypes import (
    Block,
    Boolean,
    DataType,
    Integer,
    Real,
    WideChar,
    WideString,
)
from eap.codec.datatypes import find_part, is_finite, parse, parts_of, split_paths
from eap.codec.enumerations import Enumeration, EnumValue, make_enumeration
from eap.codec.literals import write_literal
from eap.codec.structures import Member, Structure, lay_out_structure, make_structure
from eap.codec.times import TIMES
from tests.support.ctypes_layout import c_layout, c_type

STATE = "E_State<INT:Off=0,On=1,Fault=-3>"
INNER = [("a", "BYTE"), ("b", "LREAL"), ("c", "INT[3]")]
FORTY = [
    ("flag", "BOOL"),
    ("byte", "BYTE"),
    ("word", "WORD"),
    ("dword", "DWORD"),
    ("lword", "LWORD"),
    ("sint", "SINT"),
    ("int_", "INT"),
    ("dint", "DINT"),
    ("lint", "LINT"),
    ("usint", "USINT"),
    ("uint", "UINT"),
    ("udint", "UDINT"),
    ("ulint", "ULINT"),
    ("real", "REAL"),
    ("flag2", "BOOL"),
    ("lreal", "LREAL"),
    ("time", "TIME"),
    ("ltime", "LTIME"),
    ("date", "DATE"),
    ("tod", "TOD"),
    ("dt", "DT"),
    ("ldate", "LDATE"),
    ("ltod", "LTOD"),
    ("ldt", "LDT"),
    ("text", "STRING(13)"),
    ("wide", "WSTRING(7)"),
    ("char", "WCHAR"),
    ("flags", "BOOL[3]"),
    ("texts", "STRING(5)[2]"),
    ("grid", "ARRAY [1..3, 0..1] OF REAL"),
    ("state", STATE),
    ("states", f"{STATE}[2]"),
    ("speed", "T_Speed<DINT(-1000..1000)>"),
    ("raw", "BLOCK(3)"),
    ("inner", "INNER"),
    ("inners", "INNER[2]"),
    ("times", "LTIME[2]"),
    ("either", "EITHER"),
    ("last", "UINT"),
    ("end", "USINT"),
]


def forty(pack: int) -> Structure:
    """The type of 40 members, with structs, a union and arrays of them."""
    nested = {
        "INNER": lay_out_structure("ST_Inner", [(n, parse(t)) for n, t in INNER], pack=pack),
        "EITHER": lay_out_structure(
            "U_Either", [("r", parse("LREAL")), ("w", parse("WORD[5]"))], pack=pack, union=True
        ),
    }
    nested["INNER[2]"] = parse(f"{nested['INNER'].text}[2]")
    kinds = [(name, nested.get(text) or _member_type(text)) for name, text in FORTY]
    return lay_out_structure("ST_Forty", kinds, pack=pack)


def _member_type(text: str) -> DataType:
    return parse("BOOL8" if text == "BOOL" else text)


@pytest.mark.parametrize("pack", [1, 2, 4, 8])
def test_struct_of_forty_members_is_laid_out_as_in_c(pack: int) -> None:
    kind = forty(pack)
    assert len(kind.members) == 40
    rows = [(each.name, each.bit_offset // 8, each.kind.size) for each in kind.members]
    assert (kind.size, rows) == c_layout(kind, pack)
    assert parse(kind.text) == kind
    assert parse(kind.text).text == kind.text


VALUES: dict[str, Any] = {
    "flag": True,
    "byte": 1,
    "word": 0x1234,
    "dword": 0x12345678,
    "lword": 2**64 - 1,
    "sint": -1,
    "int_": -2,
    "dint": -3,
    "lint": -(2**63),
    "usint": 255,
    "uint": 65535,
    "udint": 7,
    "ulint": 8,
    "real": 1.5,
    "flag2": False,
    "lreal": -0.1,
    "time": "T#1h2m3s500ms",
    "ltime": "LTIME#5us1ns",
    "date": "D#2026-11-23",
    "tod": "TOD#12:30:15.25",
    "dt": "DT#2026-11-23-12:30:15",
    "ldate": "LDATE#2026-11-23",
    "ltod": "LTOD#23:59:59.999999999",
    "ldt": "LDT#2026-11-23-12:30:15.000000001",
    "text": "äöü",
    "wide": "Ωmega",
    "char": "Ω",
    "flags": [True, False, True],
    "texts": ["one", "two"],
    "grid": [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]],
    "state": "On",
    "states": ["Fault", "Off"],
    "speed": -1000,
    "raw": "01ff02",
    "inner": {"a": 1, "b": 2.5, "c": [1, 2, 3]},
    "inners": [{"a": 2, "b": 3.5, "c": [4, 5, 6]}, {"a": 3, "b": 4.5, "c": [7, 8, 9]}],
    "times": ["LTIME#1ns", "LTIME#0s"],
    "either": {"r": 0.0, "w": [0, 0, 0, 0, 7]},
    "last": 5,
    "end": 6,
}


@pytest.mark.parametrize("pack", [1, 2, 4, 8])
def test_values_of_forty_members_survive_bytes_plain_and_text(pack: int) -> None:
    kind = forty(pack)
    value = kind.from_plain(VALUES)
    assert kind.to_plain(value) == VALUES
    octets = kind.encode(value)
    assert kind.decode(octets, 0) == value
    assert octets[kind.by_name["word"].bit_offset // 8 :][:2] == b"\x34\x12"
    assert octets[kind.by_name["wide"].bit_offset // 8 :][:4] == "Ωm".encode("utf-16-le")
    as_json = msgspec.json.encode(kind.to_plain(value)).decode()
    assert kind.parse_text(as_json) == value


# The examples of Beckhoff's page on alignment: sizes for pack 1, 2, 4, 8.
@pytest.mark.parametrize(
    ("members", "sizes"),
    [
        (["BYTE", "LREAL"], [9, 10, 12, 16]),
        (["LREAL", "BYTE"], [9, 10, 12, 16]),
    ],
)
def test_size_follows_packing(members: list[str], sizes: list[int]) -> None:
    kinds = [(f"m{n}", parse(text)) for n, text in enumerate(members)]
    assert [lay_out_structure("S", kinds, pack=p).size for p in (1, 2, 4, 8)] == sizes


SCALARS = [
    *("BOOL8", "SINT", "USINT", "INT", "UINT", "DINT", "UDINT", "LINT", "ULINT", "BYTE", "WORD"),
    *("DWORD", "LWORD", "REAL", "LREAL", "TIME", "LTIME", "DATE", "TOD", "DT", "LDATE", "LTOD"),
    *("LDT", "WCHAR", "STRING(5)", "WSTRING(3)", "BLOCK(3)", STATE, "DINT(-5..5)"),
]


def _arrays(kind: DataType, dimensions: list[tuple[int, int]]) -> DataType:
    bounds = ",".join(f"{low}..{low + count - 1}" for low, count in dimensions)
    return parse(f"{kind.compose({})}[{bounds}]")


packs = st.sampled_from([1, 2, 4, 8])


def _structs(inner: st.SearchStrategy[DataType], pack: int) -> st.SearchStrategy[DataType]:
    dimension = st.tuples(st.integers(-2, 3), st.integers(1, 3))
    array = st.builds(_arrays, inner, st.lists(dimension, min_size=1, max_size=3))
    kinds = st.lists(inner | array, min_size=1, max_size=6)
    return st.builds(
        lambda kinds, union: lay_out_structure(
            f"S{zlib.crc32(repr(kinds).encode()) % 10**6}",
            [(f"m{n}", kind) for n, kind in enumerate(kinds)],
            pack=pack,
            union=union,
        ),
        kinds,
        st.booleans(),
    )


def structs(pack: int) -> st.SearchStrategy[Structure]:
    """Any struct or union, nested."""
    scalars = st.sampled_from(SCALARS).map(parse)
    nested = st.recursive(scalars, lambda inner: _structs(inner, pack), max_leaves=12)
    return _structs(nested, pack)


@given(packs.flatmap(lambda pack: st.tuples(st.just(pack), structs(pack))))
def test_any_struct_is_laid_out_as_in_c(pair: tuple[int, Structure]) -> None:
    pack, kind = pair
    made = c_type(kind, pack)
    assert kind.size == ctypes.sizeof(made)
    for each in kind.members:
        assert each.bit_offset == 8 * getattr(made, each.name).offset
    again = parse(kind.text)
    assert again == kind
    assert again.compose({}) == kind.text
    assert [m[:2] for m in again.members] == [m[:2] for m in kind.members]


@given(packs.flatmap(structs), st.data())
def test_any_octets_read_as_a_value_of_a_struct(kind: Structure, data: st.DataObject) -> None:
    octets = data.draw(st.binary(min_size=kind.size, max_size=kind.size))
    value = kind.decode(octets, 0)
    plain = kind.to_plain(value)
    assert kind.to_plain(kind.decode(octets, 0)) == plain or "nan" in repr(plain)
    zero = kind.zero
    assert kind.encode(zero) == bytes(kind.size)
    assert kind.from_plain(kind.to_plain(zero)) == zero


def values(kind: DataType) -> st.SearchStrategy[Any]:
    """Any value of *kind* that is one, of a union one member."""
    if isinstance(kind, Structure):
        members = {each.name: values(each.kind) for each in kind.members}
        if not kind.is_union:
            return st.fixed_dictionaries(members)
        return st.one_of([st.fixed_dictionaries({name: each}) for name, each in members.items()])
    if not isinstance(kind, Array):
        return _scalars(kind)
    found = values(kind.element)
    for _, count in reversed(kind.dimensions):
        found = st.lists(found, min_size=count, max_size=count)
    return found


def _scalars(kind: DataType) -> st.SearchStrategy[Any]:
    if isinstance(kind, Enumeration):
        return st.sampled_from([*kind.numbers, *kind.numbers.values()])
    octets = st.binary(min_size=kind.size, max_size=kind.size)
    if isinstance(kind, Block):
        return octets
    if kind in TIMES or isinstance(kind, Boolean | Real | WideString | WideChar):
        return octets.map(lambda each: kind.decode(each, 0))
    if isinstance(kind, Integer):
        return st.integers(*kind.scalar_range)
    return st.text("aä', {}[]\"\n", max_size=kind.size // 2)


def has_lossy_union(kind: DataType, *, in_union: bool = False) -> bool:
    """True if a union has a member whose values are not all the bytes that others may write."""
    if isinstance(kind, Structure):
        deeper = in_union or kind.is_union
        return any(has_lossy_union(each.kind, in_union=deeper) for each in kind.members)
    if isinstance(kind, Array):
        return has_lossy_union(kind.element, in_union=in_union)
    is_whole = type(kind) in {Integer, Real, Block} and not getattr(kind, "bounds", None)
    return in_union and not is_whole


small = packs.flatmap(structs).filter(lambda kind: kind.size <= 200)


@given(small.flatmap(lambda kind: st.tuples(st.just(kind), values(kind))))
def test_value_of_a_struct_survives_bytes_plain_json_and_literal(
    pair: tuple[Structure, Any],
) -> None:
    kind, given_value = pair
    octets = kind.encode(given_value)
    value = kind.decode(octets, 0)
    # NaN equals nothing, and JSON has none.
    if not is_finite(value) or has_lossy_union(kind):
        return
    assert kind.encode(value) == octets
    plain = kind.to_plain(value)
    for again in (
        kind.from_plain(plain),
        kind.parse_text(msgspec.json.encode(plain).decode()),
        kind.parse_text(write_literal(plain)),
    ):
        assert again == value


def test_bits_share_a_byte_as_long_as_they_fit() -> None:
    bits = [("a", "BIT"), ("b", "BIT3"), ("c", "BIT5"), ("d", "UINT"), ("e", "BIT")]
    kind = lay_out_structure("S", [(name, parse(text)) for name, text in bits])
    assert [each.offset_text for each in kind.members] == ["0.0", "0.1", "1.0", "2", "4.0"]
    assert (kind.size, list(kind.gaps())) == (6, [(4, 4), (13, 3), (33, 15)])
    octets = kind.encode({"a": 1, "b": 5, "c": 31, "d": 0x1234, "e": 1})
    assert octets.hex() == "0b1f34120100"
    assert kind.decode(octets, 0) == {"a": 1, "b": 5, "c": 31, "d": 0x1234, "e": 1}
    assert parse(kind.text).text == kind.text


def test_struct_that_extends_another_begins_with_it() -> None:
    base = lay_out_structure("Base", [("a", parse("LREAL")), ("b", parse("BYTE"))])
    kind = lay_out_structure("S", [("c", parse("BYTE"))], base=base)
    # Its own members start behind the padding of the base.
    assert [(m.name, m.bit_offset) for m in kind.members] == [("a", 0), ("b", 64), ("c", 128)]
    assert kind.size == 24


def test_definition_that_occurs_again_is_its_name() -> None:
    state = parse(STATE)
    inner = lay_out_structure("I", [("s", state)])
    kind = lay_out_structure("S", [("a", inner), ("b", inner), ("c", state)])
    assert kind.text == f"S<6/2:a@0 I<2/2:s@0 {STATE}>,b@2 I,c@4 E_State>"
    assert parse(kind.text).by_name["c"].kind == state
    other = make_enumeration("E_State", parse("INT"), {"Other": 1})
    both = lay_out_structure("S", [("a", state), ("b", other), ("c", state)])
    kinds = [each.kind for each in parse(both.text).members]
    assert kinds == [state, other, state]


def test_union_takes_one_member_or_several_that_agree() -> None:
    members = [("text", parse("STRING(4)")), ("word", parse("WORD")), ("real", parse("REAL"))]
    kind = lay_out_structure("U", members, union=True)
    assert kind.is_union
    assert kind.encode({"word": 0x4142}).hex() == "42410000"
    value = kind.decode(b"AB\0C", 0)
    assert (value["text"], value["word"]) == ("AB", 0x4241)
    assert kind.encode(value) == b"AB\0C"  # not that of the text, which has lost its end
    with pytest.raises(ValueError, match="contradict each other: expected one of text, word"):
        kind.encode({"text": "AB", "word": 1})
    with pytest.raises(ValueError, match="is empty: expected one of its members"):
        kind.encode({})


def test_value_of_a_struct_comes_from_mapping_dataclass_and_record() -> None:
    kind = parse("S<4/2:a@0 INT,b@2 INT>")

    @dataclass
    class Pair:
        a: int
        b: int

    class Record(msgspec.Struct):
        a: int
        b: int

    expected = kind.encode({"a": 1, "b": 2})
    assert kind.encode(Pair(1, 2)) == kind.encode(Record(1, 2)) == expected


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ({"a": 1}, "a value of S lacks b: expected all members, or one member by its path"),
        ({"a": 1, "b": {"x": 1}, "c": 2}, "S has no member 'c'"),
        ({"a": 70000, "b": {"x": 1}}, "a of S: 70000 is not a value of INT"),
        ({"a": 1, "b": {"x": "z"}}, "b of S: x of I: 'z' is not a value of INT"),
        (5, "5 is not a value of S: expected members such as"),
        (int, "is not a value of S"),
        ({"a": 1, "b": {"z": 1}}, "b of S: I has no member 'z'; members: x"),
    ],
)
def test_wrong_value_of_a_struct_names_the_member(value: Any, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse("S<4/2:a@0 INT,b@2 I<2/2:x@0 INT>>").encode(value)


def test_typed_value_of_a_struct() -> None:
    kind = parse(f"S<40/8:a@0 INT,t@4 TIME,s@8 {STATE},n@10 STRING(9),g@20 INT[2,2],d@32 LREAL>")
    typed = "{a: 5, t: T#1m5s, s: On, n: 'x, y', g: [[1,2],[3,4]], d: -1.5e3}"
    value = kind.parse_text(typed)
    assert value == {
        "a": 5,
        "t": timedelta(minutes=1, seconds=5),
        "s": 1,
        "n": "x, y",
        "g": ((1, 2), (3, 4)),
        "d": -1500.0,
    }
    as_json = msgspec.json.encode(kind.to_plain(value)).decode()
    assert kind.parse_text(as_json) == value


@pytest.mark.parametrize(
    ("typed", "reason"),
    [
        ("5", "'5' is not a value of S: expected members"),
        ("{a: 5", "'the end' at character 6 of a value: expected a comma or }"),
        ("{a 5}", "expected a colon behind the name of a member"),
        ("{a: 5, a: 6}", "member 'a' is given twice"),
        ("{a: 5} x", "expected a comma or the end"),
        ("{a: x, b: 1}", "a of S: 'x' is not a value of INT"),
        ("{a: [1], b: 1}", "a of S: .* is not a value of INT: expected a single value"),
        ("{" * 40, "expected a colon"),
        ("{a: " + "[" * 40, "nested too deeply"),
    ],
)
def test_typed_value_of_a_struct_refused(typed: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse("S<4/2:a@0 INT,b@2 INT>").parse_text(typed)


def test_enumeration_has_names_and_takes_numbers() -> None:
    kind = parse(STATE)
    assert kind.name == "E_State"
    assert (kind.code, kind.size) == (0x03, 2)
    value = kind.decode(b"\xfd\xff", 0)
    assert (value, value.name, str(value)) == (-3, "Fault", "Fault")
    assert repr(value) == "EnumValue(-3, 'Fault')"
    for given_value in ("On", "on", "E_State.On", 1, EnumValue(1, "On")):
        assert kind.encode(given_value) == b"\1\0"
    assert kind.parse_text("0x1") == kind.parse_text(" On ") == 1
    unknown = kind.decode(b"\7\0", 0)
    assert (unknown, unknown.name, str(unknown), kind.to_plain(unknown)) == (7, "", "7", 7)


@pytest.mark.parametrize("value", [7, "Of", None, 1.0, True, "E_State.", "1"])
def test_enumeration_refuses_what_it_has_not(value: Any) -> None:
    with pytest.raises(ValueError, match=r"expected Off \(0\), On \(1\), Fault \(-3\)"):
        parse(STATE).encode(value)


def test_subrange_refuses_numbers_beyond_and_shows_those_that_came() -> None:
    kind = parse("T_Speed<DINT(-1000..1000)>")
    assert (kind.name, kind.wire, kind.scalar_range) == ("T_Speed", "DINT", (-1000, 1000))
    with pytest.raises(ValueError, match="a whole number from -1000 to 1000"):
        kind.encode(1001)
    assert kind.decode((5000).to_bytes(4, "little"), 0) == 5000
    with pytest.raises(ValueError, match=r"element 1 of .* to 5"):
        parse("INT(0..5)[2]").encode([5, 6])


@pytest.mark.parametrize(
    ("name", "divided"),
    [
        ("axis.position", [("axis", ".position")]),
        ("table[2].x", [("table[2]", ".x"), ("table", "[2].x")]),
        ("a.b.c", [("a.b", ".c"), ("a", ".b.c")]),
        ("plain", []),
        (".x", []),
    ],
)
def test_path_is_divided_longest_variable_first(name: str, divided: list) -> None:
    assert list(split_paths(name)) == divided


def test_part_of_a_type_by_its_path() -> None:
    inner = "P<4/2:x@0 INT,f@2.3 BIT>"
    kind = parse(f"S<40/2:a@0 INT,p@2 {inner}[1..3,2],q@26 P>")
    assert find_part(kind, ".p[2,1].x") == (parse("INT"), 8 * (2 + 4 * 3))
    assert find_part(kind, ".p[1, 0].f") == (parse("BIT"), 8 * 2 + 19)
    assert find_part(kind, ".q").kind.name == "P"
    assert [path for path, _ in parts_of(kind)] == [".a", ".p", ".q", ".q.x", ".q.f"]


@pytest.mark.parametrize(
    ("path", "reason"),
    [
        (".z", "S has no member 'z'"),
        (".a.b", ".a is INT and has no members"),
        (".a[0]", ".a is INT and has no elements"),
        (".p[4]", r"has no element 4: 1 to 3"),
        (".p[1,2]", "has 1 dimensions"),
        (".p[99999999999999]", "is no path such as .member or"),
        (".p[x]", "is no path"),
        ("[0]", "it is S and has no elements"),
        (".", "is no path"),
    ],
)
def test_part_that_is_not_there_is_named(path: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        find_part(parse("S<8/2:a@0 INT,p@2 INT[1..3]>"), path)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("S<2/2:>", "is not a data type"),
        ("S<0/1:a@0 BYTE>", "'S' has 0 bytes|has 0 bytes"),
        ("S<70000/1:a@0 BYTE>", "has 70000 bytes: expected 1 to 65535"),
        ("S<3/2:a@0 INT>", "3 bytes, which is no multiple of its alignment 2"),
        ("S<4/3:a@0 INT>", "no multiple of its alignment 3"),
        ("S<2/2:a@1 INT>", "a of S at 1 ends behind the 2 bytes"),
        ("S<4/2:a@0 INT,b@1 INT>", "b of S lies on a"),
        ("S<4/2:a@0 INT,a@2 INT>", "S has two members a"),
        ("S<4/2:a@0.1 INT>", "does not start on a whole byte"),
        ("S<4/2:a@0.6 BIT3>", "has bits of two bytes"),
        ("S<4/2:a@0 T>", "'T' is not a data type"),
        ("S<4/2:a@0 S>", "'S' is not a data type"),
        ("UINT<4/2:a@0 INT>", "gives UINT another meaning"),
        ("E<REAL:a=1>", "expected a whole number such as INT"),
        ("E<SINT:a=200>", "a of E: 200 is not a value of SINT"),
        ("E<INT:a=1,a=2>", "E has two values a"),
        ("E<INT:>", "is not a data type"),
        ("E<INT:a=999999999999999999999999>", "is not a data type"),
        ("S<99999999999999999999999/1:a@0 BYTE>", "is not a data type"),
        ("S<8/1:a@99999999999 BYTE>", "ends behind the 8 bytes"),
        ("S<60000/1:a@0 BYTE[60000,60000]>", "3600000000 bytes"),
        ("A<" * 40 + "INT" + ">" * 40, "^A is nested too deeply: expected 16 levels at most"),
        ("ARRAY [0..0] OF " * 40 + "INT", "nested too deeply"),
        ("INT" + "[1]" * 100_000, "of 300003 characters: at most 262144"),
        ("S<8/1:" + ",".join(f"m{n}@0 BYTE" for n in range(4097)) + ">", "more than 4096 members"),
        ("E<DINT:" + ",".join(f"m{n}={n}" for n in range(4097)) + ">", "4097 values, at most 4096"),
    ],
)
def test_hostile_text_of_a_type_is_refused(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        parse(text)


def test_chain_of_brackets_ends() -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse("INT" + "[1]" * 80_000)


@given(st.text(alphabet="S<>/:@,.[]()0123 aINT=BYE-\n", max_size=60))
def test_any_text_of_a_struct_is_a_type_or_refused(text: str) -> None:
    try:
        kind = parse(text)
    except ValueError:
        return
    assert parse(kind.text) == kind


def test_struct_with_members_out_of_order_and_given_places() -> None:
    kind = make_structure("S", [Member("b", parse("INT"), 32), Member("a", parse("INT"), 0)], 8, 2)
    assert kind.encode({"a": 1, "b": 2}).hex() == "0100000002000000"
    assert list(kind.gaps()) == [(16, 16), (48, 16)]
