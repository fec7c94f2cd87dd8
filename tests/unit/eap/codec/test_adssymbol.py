"""ADS symbols and data types."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.adssymbol import (
    AdsType,
    ArrayDimension,
    DataTypeEntry,
    DataTypeFlag,
    SymbolAddress,
    SymbolEntry,
    SymbolFlag,
    UploadInfo,
    decode_name,
    encode_data_type,
    encode_entry,
    encode_text,
)
from tests.support.adstypes import decode_entry, decode_type
from tests.support.wirerecords import records

TEXTS = st.text(st.characters(codec="cp1252", exclude_characters="\0"), max_size=30)
ENTRIES = st.builds(
    SymbolEntry,
    records(SymbolAddress),
    st.integers(0, 0xFFFF_FFFF),
    st.sampled_from((0, SymbolFlag.READ_ONLY)),
    TEXTS,
    TEXTS,
    TEXTS,
    st.lists(records(ArrayDimension), max_size=3).map(tuple),
    st.sampled_from((b"", bytes(range(16)))),
    st.lists(st.tuples(TEXTS, TEXTS), max_size=2).map(tuple),
)


def test_attributes_stand_behind_the_texts() -> None:
    """As the open client ads-client takes them apart."""
    bare = SymbolEntry(SymbolAddress(1, 2, 3), AdsType.STRING, 0, "a", "b", "c")
    octets = encode_entry(bare._replace(attributes=(("TcEncoding", "UTF-8"),)))
    behind = b"\1\0\x0a\5TcEncoding\0UTF-8\0"
    assert octets.endswith(b"a\0b\0c\0" + behind)
    decoded, end = decode_entry(octets)
    assert decoded.flags == SymbolFlag.ATTRIBUTES
    assert decoded.attributes == (("TcEncoding", "UTF-8"),)
    assert end == len(octets) == len(encode_entry(bare)) + len(behind)


def test_upload_info_has_newest_version_that_fits() -> None:
    info = UploadInfo(1, 2, 3, 4)
    assert info.encode_for(8) == b"\1\0\0\0\2\0\0\0"
    assert info.encode_for(63) == info.encode()
    third = info.encode() + bytes(4) + (1252).to_bytes(4, "little") + bytes(32)
    assert info.encode_for(64) == info.encode_for(99) == third


def test_entry_matches_description_of_pyads() -> None:
    """The example in the class SAdsSymbolEntry of pyads, without what TwinCAT puts behind it."""
    entry = SymbolEntry(
        SymbolAddress(16448, 385000, 2),
        AdsType.UINT16,
        8,
        "GVL.counter",
        "UINT",
        " Counter (in pulses)",
    )
    octets = (
        bytes.fromhex("44000000 40400000 e8df0500 02000000 12000000 08000000 0b00 0400 1400")
        + b"GVL.counter\0UINT\0 Counter (in pulses)\0"
    )
    assert encode_entry(entry) == octets


def test_upload_info_has_24_octets() -> None:
    assert UploadInfo(3, 177).encode() == bytes.fromhex("03000000b1000000") + bytes(16)


def test_texts_are_cut_and_hold_no_nul() -> None:
    entry = SymbolEntry(
        SymbolAddress(1, 2, 3), AdsType.BIT, SymbolFlag.READ_ONLY, "x" * 300, "a\0b", "€→"
    )
    read, _ = decode_entry(encode_entry(entry))
    assert (read.name, read.type_name, read.comment) == ("x" * 255, "a?b", "€?")
    assert encode_text("ä") == b"\xe4"


@given(ENTRIES)
def test_entry_is_read_by_a_client_as_written(entry: SymbolEntry) -> None:
    octets = encode_entry(entry)
    decoded, end = decode_entry(octets)
    assert end == len(octets)
    flags = entry.flags
    flags |= SymbolFlag.TYPE_GUID if entry.guid else 0
    flags |= SymbolFlag.ATTRIBUTES if entry.attributes else 0
    assert decoded == entry._replace(flags=flags)


@pytest.mark.parametrize(
    ("octets", "name"),
    [
        (b"main\0", "main"),
        (b"main", "main"),
        (b"a\0b\0", "a"),
        ("Füllstand".encode(), "Füllstand"),
        ("Füllstand".encode("cp1252"), "Füllstand"),
        (b"", ""),
        (b"\x81", "\ufffd"),
    ],
)
def test_names_come_in_two_encodings(octets: bytes, name: str) -> None:
    assert decode_name(octets) == name


def test_number_lies_as_clients_read_it() -> None:
    """In the order in which the function parseAdsResponseDataType of ads-client takes it apart."""
    assert encode_data_type(DataTypeEntry("UINT", AdsType.UINT16, 2)) == (
        bytes.fromhex("31000000 01000000 00000000 00000000 02000000 00000000 12000000 01000000")
        + bytes.fromhex("0400 0000 0000 0000 0000")
        + b"UINT\0\0\0"
    )


def test_array_ends_with_its_dimensions() -> None:
    dimensions = (ArrayDimension(0, 4), ArrayDimension(-1, 3))
    octets = encode_data_type(
        DataTypeEntry("ARRAY [0..3] OF INT", AdsType.INT16, 8, "INT", dimensions=dimensions)
    )
    assert octets[:4] == len(octets).to_bytes(4, "little")
    assert octets[32:42] == bytes.fromhex("1300 0300 0000 0200 0000")
    assert octets[42:] == b"ARRAY [0..3] OF INT\0INT\0\0" + bytes.fromhex(
        "00000000 04000000 ffffffff 03000000"
    )


def test_struct_has_entries_of_its_members_and_enumeration_its_values() -> None:
    """In the order of ads-client: texts, dimensions, members, GUID, attributes, values."""
    flags = DataTypeFlag.DATA_ITEM | DataTypeFlag.BIT_VALUES
    member = DataTypeEntry("on", AdsType.BIT, 1, "BIT", flags=flags, offset=9)
    struct = DataTypeEntry("S", AdsType.BIG, 2, "", "c", items=(member,), hash=7)
    octets = encode_data_type(struct)
    assert octets[:32] == bytes.fromhex(
        "61000000 01000000 07000000 00000000 02000000 00000000 41000000 01000000"
    )
    assert octets[32:47] == bytes.fromhex("0100 0000 0100 0000 0100") + b"S\0\0c\0"
    assert octets[47:79] == bytes.fromhex(
        "32000000 01000000 00000000 00000000 01000000 09000000 21000000 22000000"
    )
    assert octets[79:] == bytes.fromhex("0200 0300 0000 0000 0000") + b"on\0BIT\0\0"
    mode = DataTypeEntry(
        "E", AdsType.INT16, 2, "INT", guid=bytes(range(16)), values=(("Off", 0), ("On", -1))
    )
    behind = encode_data_type(mode)[42:]
    assert behind == (
        b"E\0INT\0\0" + bytes(range(16)) + b"\2\0" + b"\3Off\0\0\0" + b"\2On\0\xff\xff"
    )
    decoded, end = decode_type(octets + behind)
    assert (decoded, end) == (struct, len(octets))
