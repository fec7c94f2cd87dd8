"""Types, tables and values of ADS symbols."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.request import AdsRefusedError
from eap.ads.symbols import SymbolSpace, SymbolTable, SymbolVariable
from eap.ads.symboltypes import TypeEntries, symbol_type
from eap.codec import datatypes
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adssymbol import (
    AdsType,
    SymbolAddress,
    SymbolEntry,
    SymbolFlag,
    UploadInfo,
)
from tests.support.adsdevice import VALUES, DictStore, variables
from tests.support.adstypes import decode_entries, decode_entry, decode_types


@pytest.mark.parametrize(
    ("text", "type_id", "name", "size"),
    [
        ("BOOL", AdsType.BIT, "BOOL", 1),
        ("SINT", AdsType.INT8, "SINT", 1),
        ("INT", AdsType.INT16, "INT", 2),
        ("DINT", AdsType.INT32, "DINT", 4),
        ("LINT", AdsType.INT64, "LINT", 8),
        ("USINT", AdsType.UINT8, "USINT", 1),
        ("UINT", AdsType.UINT16, "UINT", 2),
        ("UDINT", AdsType.UINT32, "UDINT", 4),
        ("ULINT", AdsType.UINT64, "ULINT", 8),
        ("REAL", AdsType.REAL32, "REAL", 4),
        ("LREAL", AdsType.REAL64, "LREAL", 8),
        ("BYTE", AdsType.UINT8, "BYTE", 1),
        ("WORD", AdsType.UINT16, "WORD", 2),
        ("DWORD", AdsType.UINT32, "DWORD", 4),
        ("BIT1", AdsType.UINT8, "USINT", 1),
        ("INT24", AdsType.INT32, "DINT", 4),
        ("UINT40", AdsType.UINT64, "ULINT", 8),
        ("INT56[2]", AdsType.INT64, "ARRAY [0..1] OF LINT", 16),
        ("REAL[4]", AdsType.REAL32, "ARRAY [0..3] OF REAL", 16),
        ("WORD[3]", AdsType.UINT16, "ARRAY [0..2] OF WORD", 6),
        ("STRING(80)", AdsType.STRING, "STRING(80)", 81),
        ("BLOCK(600)", AdsType.UINT8, "ARRAY [0..599] OF BYTE", 600),
    ],
)
def test_types_that_clients_know(text: str, type_id: int, name: str, size: int) -> None:
    kind = symbol_type(datatypes.parse(text))
    assert (kind.id, kind.name, kind.size) == (type_id, name, size)
    assert len(kind.to_client(bytes(kind.kind.size))) == size


@pytest.mark.parametrize(
    ("text", "octets", "client"),
    [
        ("BOOL", b"\1", b"\1"),
        ("BIT3", b"\5", b"\5"),
        ("INT24", b"\xfd\xff\xff", b"\xfd\xff\xff\xff"),
        ("UINT24", b"\xfd\xff\xff", b"\xfd\xff\xff\0"),
        ("INT40[2]", b"\xff" * 5 + b"\1\0\0\0\0", b"\xff" * 8 + b"\1" + bytes(7)),
        ("STRING(4)", b"pump", b"pump\0"),
        ("STRING(4)", b"a\0\0\0", b"a\0\0\0\0"),
        ("BLOCK(2)", b"\0\1", b"\0\1"),
        ("UINT[2]", b"\1\0\2\0", b"\1\0\2\0"),
    ],
)
def test_octets_go_and_come(text: str, octets: bytes, client: bytes) -> None:
    kind = symbol_type(datatypes.parse(text))
    assert kind.to_client(octets) == client
    assert kind.from_client(client) == octets


@pytest.mark.parametrize(
    ("text", "data", "result"),
    [
        ("UINT", b"\1", "SIZE"),
        ("UINT", b"\1\0\0", "SIZE"),
        ("INT24", b"\1\0\0", "SIZE"),
        ("INT24", b"\0\0\x80\0", "VALUE"),
        ("UINT40", b"\0\0\0\0\0\1\0\0", "VALUE"),
        ("BIT3", b"\x08", "VALUE"),
        ("STRING(2)", b"abc", "SIZE"),
        ("STRING(2)", b"a\0\0\0", "SIZE"),
        ("BLOCK(2)", b"a", "SIZE"),
    ],
)
def test_octets_that_do_not_fit(text: str, data: bytes, result: str) -> None:
    with pytest.raises(AdsRefusedError, match=result):
        symbol_type(datatypes.parse(text)).from_client(data)


def test_texts_may_be_shorter_and_truth_any_octet() -> None:
    text = symbol_type(datatypes.parse("STRING(4)"))
    assert [text.from_client(data) for data in (b"", b"ab", b"ab\0", b"abcd")] == [
        bytes(4),
        b"ab\0\0",
        b"ab\0\0",
        b"abcd",
    ]
    assert symbol_type(datatypes.parse("BOOL")).from_client(b"\x80") == b"\1"


@pytest.mark.parametrize(
    ("text", "entries"),
    [
        ("UINT", [("UINT", AdsType.UINT16, 2, "", 0)]),
        ("STRING(5)", [("STRING(5)", AdsType.STRING, 6, "", 0)]),
        (
            "INT24[3]",
            [
                ("DINT", AdsType.INT32, 4, "", 0),
                ("ARRAY [0..2] OF DINT", AdsType.INT32, 12, "DINT", 3),
            ],
        ),
        (
            "BLOCK(7)",
            [
                ("BYTE", AdsType.UINT8, 1, "", 0),
                ("ARRAY [0..6] OF BYTE", AdsType.UINT8, 7, "BYTE", 7),
            ],
        ),
    ],
)
def test_type_describes_its_elements(text: str, entries: list) -> None:
    types = TypeEntries()
    types.add(symbol_type(datatypes.parse(text)))
    described = decode_types(b"".join(types.encode().values())).values()
    assert entries == [
        (each.name, each.type, each.size, each.type_name, sum(d.elements for d in each.dimensions))
        for each in described
    ]


TEXTS = ["INT24", "UINT56[3]", "BIT5", "REAL", "LINT[2]", "STRING(9)", "BLOCK(5)", "BOOL", "DWORD"]


@given(st.sampled_from(TEXTS), st.data())
def test_written_value_is_read_back_by_client(text: str, data: st.DataObject) -> None:
    kind = symbol_type(datatypes.parse(text))
    written = data.draw(st.binary(min_size=kind.size, max_size=kind.size))
    try:
        octets = kind.from_client(written)
    except AdsRefusedError:
        return
    assert len(octets) == kind.kind.size
    assert kind.from_client(kind.to_client(octets)) == octets


def test_case_of_names_matters_only_between_two_that_differ_in_it() -> None:
    kind = datatypes.parse("USINT")
    table = SymbolTable([SymbolVariable(name, kind) for name in ("Pump", "valve", "Valve")], 0)
    assert table.find("PUMP") == table.find("Pump")
    assert table.find("valve") != table.find("Valve")
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        table.find("VALVE")


def test_table_without_symbols() -> None:
    table = SymbolTable([], 3)
    assert table.info == UploadInfo(0, 0)
    assert (table.upload, table.type_upload) == (b"", b"")
    with pytest.raises(AdsRefusedError, match="INDEX_OFFSET"):
        table.at(0)


KINDS = st.sampled_from(["BOOL", "INT24", "STRING(9)", "REAL[3]", "BLOCK(5)", "ULINT"])


@given(st.lists(KINDS, max_size=20), st.integers(0, 400))
def test_every_offset_belongs_to_one_symbol_or_none(kinds: list[str], offset: int) -> None:
    table = SymbolTable(
        [SymbolVariable(f"v{n}", datatypes.parse(kind)) for n, kind in enumerate(kinds)], 0
    )
    places = [table.by_handle(n + 1).address for n in range(len(kinds))]
    owners = [p for p in places if p.offset <= offset < p.offset + p.size]
    assert len(owners) <= 1
    try:
        symbol, start = table.at(offset)
    except AdsRefusedError:
        assert not owners
    else:
        assert owners == [symbol.address]
        assert start == offset - symbol.address.offset


G = IndexGroup
BIG = 0xFFFF_FFFF


@pytest.fixture
def store() -> DictStore:
    return DictStore()


@pytest.fixture
def space(store: DictStore) -> SymbolSpace:
    return SymbolSpace(SymbolTable(variables(store), 1), store)


def handle(space: SymbolSpace, name: str) -> int:
    return int.from_bytes(space.read_write(G.SYMBOL_HANDLE, 0, 4, name.encode() + b"\0"), "little")


def test_value_by_name_handle_and_offset_is_equal(space, store) -> None:
    for name, kind in store.types.items():
        place = SymbolAddress.decode(space.read_write(G.SYMBOL_BY_NAME, 0, 12, name.encode()))
        by_name = space.read_write(G.VALUE_BY_NAME, 0, BIG, name.encode())
        assert space.read(G.VALUE_BY_HANDLE, handle(space, name), BIG) == by_name
        assert space.read(G.SYMBOL_NOTIFICATION, handle(space, name), BIG) == by_name
        assert space.read(place.group, place.offset, place.size) == by_name
        assert (place.group, place.offset % 8, place.size) == (G.DATA, 0, len(by_name))
        if by_name[: kind.size] == store.octets[name]:
            assert space.read(place.group, place.offset, 1) == store.octets[name][:1]


def test_table_is_uploaded(space) -> None:
    count, size = (
        int.from_bytes(space.read(G.SYMBOL_UPLOAD_INFO, 0, 8)[n : n + 4], "little") for n in (0, 4)
    )
    octets = space.read(G.SYMBOL_UPLOAD, 0, size)
    entries = decode_entries(octets)
    assert (count, size) == (len(VALUES), len(octets))
    assert list(entries) == list(VALUES)
    one, end = decode_entry(space.read_write(G.SYMBOL_ENTRY_BY_NAME, 0, 798, b"count"))
    assert one == entries["count"]
    assert one == SymbolEntry(
        SymbolAddress(G.DATA, 16, 4),
        AdsType.UINT32,
        SymbolFlag.READ_ONLY | SymbolFlag.TYPE_GUID,
        "count",
        "UDINT",
        "comment of count",
        guid=bytes.fromhex("95190718 0000 0000 0000 000000000008"),
    )
    assert end == len(space.read_write(G.SYMBOL_ENTRY_BY_NAME, 0, 798, b"count"))
    info = space.read(G.SYMBOL_UPLOAD_INFO_2, 0, 1024)
    assert info[:8] == space.read(G.SYMBOL_UPLOAD_INFO, 0, 1024)
    assert len(info) == 64
    with pytest.raises(AdsRefusedError, match="SIZE"):
        space.read(G.SYMBOL_UPLOAD, 0, size - 1)


def test_types_of_symbols_are_uploaded(space) -> None:
    info = UploadInfo.decode(space.read(G.SYMBOL_UPLOAD_INFO_2, 0, 24))
    octets = space.read(G.DATA_TYPE_UPLOAD, 0, BIG)
    assert len(octets) == info.type_size
    entries = decode_types(octets)
    assert len(entries) == info.types
    assert {"INT", "ARRAY [0..3] OF INT", "STRING(15)", "BYTE", "BOOL"} <= set(entries)
    for name, entry in entries.items():
        one = space.read_write(G.DATA_TYPE_BY_NAME, 0, BIG, name.lower().encode())
        assert decode_types(one) == {name: entry}
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        space.read_write(G.DATA_TYPE_BY_NAME, 0, BIG, b"ST_PUMP")
    with pytest.raises(AdsRefusedError, match="SIZE"):
        space.read_write(G.DATA_TYPE_BY_NAME, 0, 40, b"INT")


def test_handle_answer_includes_type_if_it_fits(space) -> None:
    octets = space.read_write(G.SYMBOL_HANDLE, 0, BIG, b"count")
    assert octets == bytes.fromhex("03000001 04000000 00000000 0500") + b"UDINT\0"
    assert space.read_write(G.SYMBOL_HANDLE, 0, len(octets), b"count") == octets
    assert space.read_write(G.SYMBOL_HANDLE, 0, len(octets) - 1, b"count") == octets[:4]


def test_values_are_written(space, store) -> None:
    space.write(G.VALUE_BY_HANDLE, handle(space, "depth"), b"\xfe\xff\xff\xff")
    assert store.get("depth") == -2
    place = SymbolAddress.decode(space.read_write(G.SYMBOL_BY_NAME, 0, 12, b"curve"))
    space.write(place.group, place.offset, bytes(range(8)))
    assert store.octets["curve"] == bytes(range(8))
    for offset, data, result in (
        (place.offset + 2, bytes(6), "SIZE"),
        (place.offset, bytes(6), "SIZE"),
        (place.offset + 8, bytes(8), "SIZE"),
    ):
        with pytest.raises(AdsRefusedError, match=result):
            space.write(place.group, offset, data)
    with pytest.raises(AdsRefusedError, match="ACCESS"):
        space.write(G.VALUE_BY_HANDLE, handle(space, "count"), bytes(4))


def test_elements_of_a_list_are_read_by_offset(space) -> None:
    place = SymbolAddress.decode(space.read_write(G.SYMBOL_BY_NAME, 0, 12, b"curve"))
    assert space.read(place.group, place.offset + 2, 2) == b"\xfe\xff"
    assert space.read(place.group, place.offset + 6, BIG) == b"\xfc\xff"


def test_handles_of_an_older_table_are_refused_as_such(space, store) -> None:
    old = handle(space, "count")
    version = space.watch(G.SYMBOL_VERSION, 0, 1)
    assert version() == b"\1"
    space.replace(SymbolTable(variables(store)[:2], 0x102), store)
    assert (version(), space.read(G.SYMBOL_VERSION, 0, 9)) == (b"\2", b"\2")
    with pytest.raises(AdsRefusedError, match="SYMBOL_VERSION"):
        space.read(G.VALUE_BY_HANDLE, old, 4)
    space.write(G.RELEASE_HANDLE, 0, old.to_bytes(4, "little"))
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        handle(space, "count")


def test_watch_continues_for_symbol_of_the_next_table(space, store) -> None:
    value = space.watch(G.VALUE_BY_HANDLE, handle(space, "count"), 4)
    space.replace(SymbolTable(reversed(variables(store)), 2), store)
    store.set("count", 5)
    assert value() == b"\5\0\0\0"
    other = [SymbolVariable("count", datatypes.parse("UINT"))]
    for without in (other, []):
        space.replace(SymbolTable(without, 3), store)
        with pytest.raises(AdsRefusedError, match="SYMBOL_VERSION"):
            value()


@pytest.mark.parametrize("number", [1 << 24, (1 << 24) + len(VALUES) + 4 + 2 + 1])
def test_handles_that_never_were_any(space, number: int) -> None:
    with pytest.raises(AdsRefusedError, match="SYMBOL_NOT_FOUND"):
        space.read(G.VALUE_BY_HANDLE, number, 4)


def test_watch_returns_the_requested_length(space, store) -> None:
    place = SymbolAddress.decode(space.read_write(G.SYMBOL_BY_NAME, 0, 12, b"curve"))
    second = space.watch(G.DATA, place.offset + 2, 2)
    store.set("curve", (1, 2, 3, 4))
    assert second() == b"\2\0"
    for group, offset, length in (
        (G.DATA, place.offset + 2, 7),
        (G.VALUE_BY_HANDLE, handle(space, "curve"), 9),
        (G.SYMBOL_VERSION, 0, 2),
    ):
        with pytest.raises(AdsRefusedError, match="SIZE"):
            space.watch(group, offset, length)


@pytest.mark.parametrize(
    ("attempt", "result"),
    [
        (lambda s: s.read_write(G.SYMBOL_HANDLE, 0, 4, b"nobody"), "SYMBOL_NOT_FOUND"),
        (lambda s: s.read_write(G.SYMBOL_HANDLE, 0, 3, b"count"), "SIZE"),
        (lambda s: s.read_write(G.SYMBOL_ENTRY_BY_NAME, 0, 30, b"count"), "SIZE"),
        (lambda s: s.read_write(G.VALUE_BY_HANDLE, 0, 4, b"count"), "ACCESS"),
        (lambda s: s.read(G.SYMBOL_HANDLE, 0, 4), "ACCESS"),
        (lambda s: s.write(G.SYMBOL_UPLOAD, 0, b"abcd"), "ACCESS"),
        (lambda s: s.write(G.RELEASE_HANDLE, 0, b"abc"), "SIZE"),
        (lambda s: s.watch(G.SYMBOL_UPLOAD, 0, 4), "ACCESS"),
        (lambda s: s.read(G.DATA, 4, 4), "INDEX_OFFSET"),
        (lambda s: s.read(G.DATA, BIG, 4), "INDEX_OFFSET"),
    ],
)
def test_refusals(space, attempt, result: str) -> None:
    with pytest.raises(AdsRefusedError, match=result):
        attempt(space)


def test_symbol_space_returns_refusal_of_the_store(space, store) -> None:
    store.broken["motor.speed"] = AdsError.BUSY
    number = handle(space, "motor.speed")
    with pytest.raises(AdsRefusedError, match="BUSY"):
        space.read(G.VALUE_BY_HANDLE, number, 4)
    with pytest.raises(AdsRefusedError, match="BUSY"):
        space.write(G.VALUE_BY_HANDLE, number, bytes(4))
