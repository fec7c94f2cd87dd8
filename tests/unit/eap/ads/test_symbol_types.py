"""Types of ADS symbols that have a definition, their entries, and parts of their variables."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.request import AdsRefusedError
from eap.ads.symbolparts import count_parts, find_by_number, find_by_path, find_path_at
from eap.ads.symbols import SymbolSpace, SymbolTable, SymbolVariable
from eap.ads.symboltypes import TypeEntries, memory_type, symbol_type
from eap.codec import datatypes
from eap.codec.ads import IndexGroup
from eap.codec.adssymbol import (
    AdsType,
    ArrayDimension,
    DataTypeEntry,
    DataTypeFlag,
    SymbolAddress,
    SymbolFlag,
    UploadInfo,
)
from tests.support.adsdevice import DictStore
from tests.support.adstypes import decode_entries, decode_entry, decode_types

G = IndexGroup
BIG = 0xFFFF_FFFF

POINT = "ST_Point<8/4:x@0 REAL,y@4 REAL>"
STATE = "E_State<INT:Off=0,On=1,Fault=-2>"
BITS = "ST_Bits<2/1:ready@0.0 BIT1,mode@0.1 BIT3,alarm@1.7 BIT1>"
AXIS = (
    f"ST_Axis<80/8:position@0 LREAL,state@8 {STATE},enable@10 BOOL,speed@12 T_Speed<INT>,"
    f"moved@16 TIME,name@20 WSTRING(7),path@36 {POINT}[1..2],label@52 STRING(5),odd@57 INT24,"
    f"bits@60 {BITS},u@64 U_Any<8/8:whole@0 ULINT,halves@0 UDINT[2],near@0 ST_Point>,"
    "grid@72 INT[2,1..2]>"
)
VALUES = {
    "axis": (AXIS, bytes(range(80))),
    "table": (f"{POINT}[3]", [{"x": n, "y": -n} for n in range(3)]),
    "state": (STATE, "On"),
    "limit": ("DINT(-5..5)", 3),
    "wide": ("INT24[1..3]", (1, -2, 3)),
    "names": ("STRING(4)[2]", ("ab", "cd")),
    "word": ("T_Name<STRING(6)>", "pump"),
    "text": ("STRING(6)", "pump"),
    "at": ("DT", "2026-11-23T12:00:00"),
    "level": ("USINT", 9),
}


@pytest.fixture
def store() -> DictStore:
    return DictStore(VALUES)


def table_of(store: DictStore, version: int = 1, read_only: str = "level") -> SymbolTable:
    return SymbolTable(
        (
            SymbolVariable(name, kind, "", "counts" if name == read_only else "")
            for name, kind in store.types.items()
        ),
        version,
    )


@pytest.fixture
def space(store: DictStore) -> SymbolSpace:
    return SymbolSpace(table_of(store), store)


def handle(space: SymbolSpace, name: str) -> int:
    return int.from_bytes(space.read_write(G.SYMBOL_HANDLE, 0, 4, name.encode() + b"\0"), "little")


def entry(space: SymbolSpace, name: str):
    return decode_entry(space.read_write(G.SYMBOL_ENTRY_BY_NAME, 0, 2000, name.encode()))[0]


def value(space: SymbolSpace, name: str) -> bytes:
    return space.read_write(G.VALUE_BY_NAME, 0, BIG, name.encode())


@pytest.mark.parametrize(
    ("text", "type_id", "name", "size"),
    [
        (POINT, AdsType.BIG, "ST_Point", 8),
        (f"{POINT}[2,1..3]", AdsType.BIG, "ARRAY [0..1,1..3] OF ST_Point", 48),
        ("REAL[4][-1..1]", AdsType.REAL32, "ARRAY [-1..1] OF ARRAY [0..3] OF REAL", 48),
        (STATE, AdsType.INT16, "E_State", 2),
        ("T_Speed<INT>", AdsType.INT16, "T_Speed", 2),
        ("DWORD(1..86400)", AdsType.UINT32, "DWORD", 4),
        ("DINT(-5..5)[2]", AdsType.INT32, "ARRAY [0..1] OF DINT", 8),
        ("TIME", AdsType.UINT32, "TIME", 4),
        ("TOD", AdsType.UINT32, "TOD", 4),
        ("DATE", AdsType.UINT32, "DATE", 4),
        ("DT", AdsType.UINT32, "DT", 4),
        ("LTIME", AdsType.UINT64, "LTIME", 8),
        ("LWORD", AdsType.UINT64, "LWORD", 8),
        ("WCHAR", AdsType.UINT16, "WCHAR", 2),
        ("WSTRING(80)", AdsType.WSTRING, "WSTRING(80)", 162),
        ("STRING(81)[2]", AdsType.STRING, "ARRAY [0..1] OF STRING(80)", 162),
        ("T_Name<STRING(81)>", AdsType.STRING, "T_Name", 81),
        ("T_Odd<INT24>", AdsType.UINT8, "T_Odd", 3),
        ("BOOL[8]", AdsType.BIT, "ARRAY [0..7] OF BOOL", 8),
    ],
)
def test_types_are_named_as_twincat_does(text: str, type_id: int, name: str, size: int) -> None:
    kind = symbol_type(datatypes.parse(text))
    assert (kind.id, kind.name, kind.size) == (type_id, name, size)


def test_every_type_that_a_symbol_refers_to_is_uploaded(space) -> None:
    types = decode_types(space.read(G.DATA_TYPE_UPLOAD, 0, BIG))
    info = UploadInfo.decode(space.read(G.SYMBOL_UPLOAD_INFO_2, 0, 24))
    assert (info.types, info.symbols) == (len(types), len(VALUES))
    symbols = decode_entries(space.read(G.SYMBOL_UPLOAD, 0, BIG))
    assert list(symbols) == list(VALUES)
    wanted = [(each.type_name, each.address.size) for each in symbols.values()]
    while wanted:
        name, size = wanted.pop()
        found = types[name]
        assert found.size == size or found.flags & DataTypeFlag.BIT_VALUES
        one = space.read_write(G.DATA_TYPE_BY_NAME, 0, BIG, name.upper().encode() + b"\0")
        assert decode_types(one) == {name: found}
        elements = 1
        for each in found.dimensions:
            elements *= each.elements
        if found.type_name:
            wanted.append((found.type_name, size // elements))
        for item in found.items:
            is_bits = item.flags & DataTypeFlag.BIT_VALUES
            assert item.offset + item.size <= size * (8 if is_bits else 1)
            wanted.append((item.type_name, item.size))


def test_struct_is_described_with_its_members(space) -> None:
    types = decode_types(space.read(G.DATA_TYPE_UPLOAD, 0, BIG))
    axis = types["ST_Axis"]
    assert (axis.type, axis.size, axis.type_name, axis.flags) == (
        AdsType.BIG, 80, "", DataTypeFlag.DATA_TYPE,
    )  # fmt: skip
    assert [(each.name, each.type_name, each.offset, each.size) for each in axis.items] == [
        ("position", "LREAL", 0, 8),
        ("state", "E_State", 8, 2),
        ("enable", "BOOL", 10, 1),
        ("speed", "T_Speed", 12, 2),
        ("moved", "TIME", 16, 4),
        ("name", "WSTRING(7)", 20, 16),
        ("path", "ARRAY [1..2] OF ST_Point", 36, 16),
        ("label", "STRING(4)", 52, 5),
        ("odd", "ARRAY [0..2] OF BYTE", 57, 3),
        ("bits", "ST_Bits", 60, 2),
        ("u", "U_Any", 64, 8),
        ("grid", "ARRAY [0..1,1..2] OF INT", 72, 8),
    ]
    assert axis.items[0].flags == DataTypeFlag.DATA_ITEM | DataTypeFlag.TYPE_GUID == 0x82
    assert [each.offset for each in types["U_Any"].items] == [0, 0, 0]
    assert [(b.name, b.type_name, b.offset, b.size, b.flags) for b in types["ST_Bits"].items] == [
        ("ready", "BIT", 0, 1, 0xA2),
        ("mode", "BIT3", 1, 3, 0x22),
        ("alarm", "BIT", 15, 1, 0xA2),
    ]
    assert (types["BIT"].size, types["BIT"].flags) == (1, 0xA1)
    assert types["ARRAY [0..1,1..2] OF INT"].dimensions == (
        ArrayDimension(0, 2),
        ArrayDimension(1, 2),
    )
    assert axis.items[-1].dimensions == (ArrayDimension(0, 2), ArrayDimension(1, 2))
    state = types["E_State"]
    assert (state.type_name, state.flags, state.values) == (
        "INT", 0x2001, (("Off", 0), ("On", 1), ("Fault", -2)),
    )  # fmt: skip
    assert types["T_Speed"].type_name == "INT"
    assert types["STRING(4)"].attributes == (("TcEncoding", "UTF-8"),)
    assert types["STRING(4)"].guid == bytes.fromhex("95190718 0000 0000 0000 000100000004")


def test_hash_of_a_type_changes_with_the_types_in_it() -> None:
    def described(text: str) -> DataTypeEntry:
        types = TypeEntries()
        return types.add(symbol_type(datatypes.parse(text)))

    one, same, other = map(described, (AXIS, AXIS, AXIS.replace("Fault=-2", "Fault=-3")))
    assert one.hash == same.hash != other.hash
    assert one.items[0].hash == other.items[0].hash != 0
    assert one.items[1].hash != other.items[1].hash
    assert one.items[1].type_hash == other.items[1].type_hash


MEMBERS = {
    "axis.position": ("LREAL", 0, 8),
    "axis.path[2].x": ("REAL", 44, 4),
    "axis.path[1]": ("ST_Point", 36, 8),
    "axis.u.halves[1]": ("UDINT", 68, 4),
    "axis.u.near.y": ("REAL", 68, 4),
    "axis.grid[1,2]": ("INT", 78, 2),
    "axis.name": ("WSTRING(7)", 20, 16),
}


@pytest.mark.parametrize("name", MEMBERS)
def test_member_is_a_symbol_by_name_handle_and_address(space, store, name: str) -> None:
    type_name, offset, size = MEMBERS[name]
    described = entry(space, name.upper())
    assert (described.name, described.type_name) == (name, type_name)
    assert described.address == SymbolAddress(G.DATA, offset, size)
    place = SymbolAddress.decode(space.read_write(G.SYMBOL_BY_NAME, 0, 12, name.encode()))
    assert place == described.address
    expected = bytes(range(offset, offset + size))
    number = handle(space, name.lower())
    assert value(space, name) == expected
    assert space.read(G.VALUE_BY_HANDLE, number, BIG) == expected
    assert space.read(G.DATA, offset, size) == expected
    assert space.watch(G.VALUE_BY_HANDLE, number, size)() == expected
    for group, at in ((G.VALUE_BY_HANDLE, number), (G.DATA, offset)):
        before = store.octets["axis"]
        fresh = bytes(octet ^ 0x55 for octet in before[offset : offset + size])
        if name == "axis.name":
            fresh = "fünf €".encode("utf-16-le").ljust(size, b"\0")
        space.write(group, at, fresh)
        after = bytearray(before)
        after[offset : offset + size] = fresh
        assert store.octets["axis"] == bytes(after)


def test_bit_field_is_a_symbol_of_one_byte(space, store) -> None:
    described = entry(space, "axis.bits.mode")
    assert described.address == SymbolAddress(G.DATA_BITS, 8 * 60 + 1, 1)
    assert (described.type, described.flags & SymbolFlag.BIT_VALUE) == (AdsType.BIT, 2)
    store.octets["axis"] = bytes(60) + b"\xff\xff" + bytes(18)
    for group, at in ((G.VALUE_BY_HANDLE, handle(space, "axis.bits.mode")), (G.DATA_BITS, 481)):
        assert space.read(group, at, BIG) == b"\7"
        space.write(group, at, b"\2")
        assert store.octets["axis"][60:62] == b"\xf5\xff"
        with pytest.raises(AdsRefusedError, match="VALUE"):
            space.write(group, at, b"\x08")
        store.octets["axis"] = bytes(60) + b"\xff\xff" + bytes(18)
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        space.read(G.DATA_BITS, 482, 1)
    with pytest.raises(AdsRefusedError, match="SIZE"):
        space.watch(G.DATA_BITS, 481, 2)


def test_written_struct_is_stored_byte_by_byte_without_its_padding(space, store) -> None:
    space.write(G.VALUE_BY_HANDLE, handle(space, "axis"), b"\xff" * 80)
    gaps = {11, 14, 15, 62, 63}
    octets = bytes(0 if at in gaps else 255 for at in range(80))
    # Of the bit fields, bits 4 to 14 are padding.
    assert store.octets["axis"] == octets[:60] + b"\x0f\x80" + octets[62:]


def test_text_members_are_written_shorter_than_they_are(space, store) -> None:
    for group, at in ((G.VALUE_BY_HANDLE, handle(space, "axis.label")), (G.DATA, 52)):
        store.octets["axis"] = b"\1" * 80
        space.write(group, at, b"ab\0")
        assert store.octets["axis"][51:58] == b"\1ab\0\0\0\1"
        space.write(group, at, b"abcde")
        assert store.octets["axis"][51:58] == b"\1abcde\1"
    name = handle(space, "axis.name")
    space.write(G.VALUE_BY_HANDLE, name, "é\0x".encode("utf-16-le"))
    assert store.octets["axis"][20:36] == b"\xe9".ljust(16, b"\0")
    for data in (b"abc", bytes(18)):
        with pytest.raises(AdsRefusedError, match="SIZE"):
            space.write(G.VALUE_BY_HANDLE, name, data)


def test_elements_of_a_widened_array_are_wide(space, store) -> None:
    place = entry(space, "wide[3]").address
    assert entry(space, "wide[3]").type_name == "DINT"
    assert place == SymbolAddress(G.DATA, entry(space, "wide").address.offset + 8, 4)
    assert value(space, "wide[2]") == b"\xfe\xff\xff\xff"
    space.write(G.VALUE_BY_HANDLE, handle(space, "wide[2]"), b"\x05\0\0\0")
    assert store.get("wide") == (1, 5, 3)
    with pytest.raises(AdsRefusedError, match="VALUE"):
        space.write(G.VALUE_BY_HANDLE, handle(space, "wide[2]"), b"\0\0\x80\0")


def test_members_of_a_variable_of_others_are_not_written(store) -> None:
    space = SymbolSpace(table_of(store, read_only="axis"), store)
    number = handle(space, "axis.position")
    assert entry(space, "axis.position").flags & SymbolFlag.READ_ONLY
    for group, at in ((G.VALUE_BY_HANDLE, number), (G.DATA, 0)):
        with pytest.raises(AdsRefusedError, match=r"ACCESS: axis\.position counts"):
            space.write(group, at, bytes(8))
    assert store.octets["axis"] == bytes(range(80))


@pytest.mark.parametrize(
    "name",
    [
        "axis[99999999999]",
        "axis.path[99999999999].x",
        "axis.path[0]",
        "axis.path[3].x",
        "axis.path[1,2]",
        "axis.path[]",
        "axis.path[1",
        "axis.grid[1]",
        "axis.grid[-1,1]",
        "axis.",
        "axis..x",
        "axis.position.x",
        "axis.position[0]",
        "axis.nothing",
        "level.x",
        "nobody.x",
        ".axis",
        "axis" + ".path" * 100,
        "axis" + ".a" * 30_000,
        "axis" + "[1]" * 20_000,
        "axis.path[" + "1," * 10_000 + "1]",
        "axis.path[" + "9" * 50_000 + "]",
        "a." * 30_000,
        "\u0130" * 500 + ".x",
    ],
)
@pytest.mark.parametrize("group", [G.SYMBOL_HANDLE, G.VALUE_BY_NAME, G.SYMBOL_ENTRY_BY_NAME])
def test_names_of_no_symbol_are_refused(space, name: str, group: int) -> None:
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        space.read_write(group, 0, BIG, name.encode())


def test_every_number_of_a_part_is_that_of_its_path(store) -> None:
    kind = store.types["axis"]
    parts = [find_by_number(kind, number) for number in range(count_parts(kind))]
    assert [part.number for part in parts] == list(range(len(parts)))
    assert len({part.path for part in parts}) == len(parts)
    for part in parts:
        assert find_by_path(kind, part.path.upper()) == part
        length = 0 if part.kind.is_bits else part.kind.bit_length
        found = find_by_path(kind, find_path_at(kind, part.bit_offset, length))
        assert (found.bit_offset, found.kind.bit_length) == (part.bit_offset, part.kind.bit_length)


def test_handles_of_all_symbols_and_parts_differ(store) -> None:
    table = table_of(store, version=0)
    names = [
        name + find_by_number(kind, number).path
        for name, kind in store.types.items()
        for number in range(count_parts(kind))
    ]
    handles = {table.find(name)[1]: name for name in names}
    assert len(handles) == len(names)
    assert min(handles) == 1
    assert {number: table.by_handle(number).name for number in handles} == handles
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        table.by_handle(max(handles) + 1)


def test_parts_beyond_the_handles_are_refused_by_name() -> None:
    inner = "U<8192/1:" + ",".join(f"m{n}@0 BYTE[8192]" for n in range(4000)) + ">"
    table = SymbolTable([SymbolVariable("a", datatypes.parse(inner))], 1)
    assert table.by_handle(table.find("a.m2000[0]")[1]).name == "a.m2000[0]"
    with pytest.raises(AdsRefusedError, match="NO_MORE_HANDLES"):
        table.find("a.m3999[0]")


def test_two_members_that_differ_in_case_are_found_by_their_exact_names() -> None:
    kind = datatypes.parse("ST_Case<3/1:Speed@0 BYTE,speed@1 BYTE,on@2 BYTE>")
    table = SymbolTable([SymbolVariable("a", kind)], 1)
    assert [table.find(f"a.{name}")[0].address.offset for name in ("Speed", "speed", "ON")] == [
        0, 1, 2,
    ]  # fmt: skip
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        table.find("a.SPEED")


def test_variable_with_the_name_of_a_path_goes_first() -> None:
    point = datatypes.parse(POINT)
    table = SymbolTable([SymbolVariable("a", point), SymbolVariable("a.x", point)], 1)
    assert table.find("a.x")[0].type.name == "ST_Point"
    assert table.find("a.x.y")[0].type.name == "REAL"
    assert table.find("a.y")[0].type.name == "REAL"
    with pytest.raises(AdsRefusedError, match=r"ST_Point has no member 'z'"):
        table.find("a.x.z")


def test_watch_of_a_member_follows_it_to_the_next_table(space, store) -> None:
    by_handle = space.watch(G.VALUE_BY_HANDLE, handle(space, "axis.position"), 8)
    by_address = space.watch(G.DATA, 0, 8)
    two_members = space.watch(G.DATA, 0, 10)
    assert two_members() == bytes(range(10))
    del store.types["level"]
    moved = AXIS.replace("ST_Axis<80", "ST_Axis<88").replace(
        "position@0 LREAL", "position@80 LREAL"
    )
    store.types["axis"] = datatypes.parse(moved)
    store.octets["axis"] = bytes(80) + b"\7" * 8
    space.replace(table_of(store, 2), store)
    assert by_handle() == by_address() == b"\7" * 8
    store.types["axis"] = datatypes.parse(moved.replace("LREAL", "LINT"))
    space.replace(table_of(store, 3), store)
    for watched in (by_handle, by_address, two_members):
        with pytest.raises(AdsRefusedError, match="SYMBOL_VERSION"):
            watched()


@given(st.integers(0, 100), st.integers(1, 100))
def test_any_range_of_a_struct_is_written_as_a_part_or_refused(offset: int, size: int) -> None:
    store = DictStore(VALUES)
    space = SymbolSpace(table_of(store), store)
    before = store.octets["axis"]
    with suppress(AdsRefusedError):
        space.write(G.DATA, offset, bytes(size))
    changed = [at for at in range(80) if store.octets["axis"][at] != before[at]]
    # A text is filled up with NUL.
    assert all(offset <= at < offset + max(size, 16) for at in changed)


def test_bytes_behind_the_nul_of_a_lone_text_do_not_matter() -> None:
    kind = memory_type(datatypes.parse("WSTRING(2)"))
    assert kind.from_client(b"\0a\0\0zz") == b"\0a" + bytes(4)
