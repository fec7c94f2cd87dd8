"""ADS symbols and data types."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.adssymbol import (
    AdsType,
    DataTypeEntry,
    SymbolAddress,
    SymbolEntry,
    SymbolFlag,
    UploadInfo,
    decode_entry,
    decode_name,
    encode_data_type,
    encode_entry,
    encode_text,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.wirerecords import records

TEXTS = st.text(st.characters(codec="cp1252", exclude_characters="\0"), max_size=30)
ENTRIES = st.builds(
    SymbolEntry,
    records(SymbolAddress),
    st.integers(0, 0xFFFF_FFFF),
    st.integers(0, 0xFFFF_FFFF),
    TEXTS,
    TEXTS,
    TEXTS,
    attributes=st.just(()),
)


def test_attributes_stand_behind_the_texts() -> None:
    """As the open client ads-client takes them apart."""
    bare = SymbolEntry(SymbolAddress(1, 2, 3), AdsType.STRING, 0, "a", "b", "c")
    octets = encode_entry(bare._replace(attributes=(("TcEncoding", "UTF-8"),)))
    behind = b"\1\0\x0a\5TcEncoding\0UTF-8\0"
    assert octets.endswith(b"a\0b\0c\0" + behind)
    decoded, end = decode_entry(octets)
    assert decoded == bare._replace(flags=SymbolFlag.ATTRIBUTES)
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
    assert decode_entry(b"." + octets, 1) == (entry, 69)


def test_upload_info_has_24_octets() -> None:
    assert UploadInfo(3, 177).encode() == bytes.fromhex("03000000b1000000") + bytes(16)


def test_entry_attributes_are_skipped() -> None:
    octets = bytearray(encode_entry(SymbolEntry(SymbolAddress(1, 2, 3), 4, 5, "n", "t")))
    octets[:4] = (len(octets) + 10).to_bytes(4, "little")
    entry, end = decode_entry(octets + bytes(30))
    assert (entry.name, entry.comment, end) == ("n", "", len(octets) + 10)


def test_texts_are_cut_and_hold_no_nul() -> None:
    entry = SymbolEntry(
        SymbolAddress(1, 2, 3), AdsType.BIT, SymbolFlag.READ_ONLY, "x" * 300, "a\0b", "€→"
    )
    read, _ = decode_entry(encode_entry(entry))
    assert (read.name, read.type_name, read.comment) == ("x" * 255, "a?b", "€?")
    assert encode_text("ä") == b"\xe4"


def test_broken_entries() -> None:
    octets = encode_entry(SymbolEntry(SymbolAddress(1, 2, 3), 4, 5, "name", "type"))
    with pytest.raises(TruncatedError, match="AdsSymbolEntry"):
        decode_entry(octets[:-1])
    with pytest.raises(MalformedError, match="do not hold texts"):
        decode_entry((20).to_bytes(4, "little") + octets[4:])


@given(ENTRIES)
def test_entry_round_trip(entry: SymbolEntry) -> None:
    octets = encode_entry(entry)
    assert decode_entry(octets) == (entry, len(octets))


@given(st.binary(max_size=80))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        _, end = decode_entry(noise)
    except CodecError:
        return
    assert 30 < end <= len(noise)


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


def test_list_ends_with_its_dimension() -> None:
    octets = encode_data_type(DataTypeEntry("ARRAY [0..3] OF INT", AdsType.INT16, 8, "INT", 4))
    assert octets[:4] == len(octets).to_bytes(4, "little")
    assert octets[32:42] == bytes.fromhex("1300 0300 0000 0100 0000")
    assert octets[42:] == b"ARRAY [0..3] OF INT\0INT\0\0" + bytes.fromhex("00000000 04000000")
