from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.operation import AdsRefusedError
from eap.ads.symbols import symbol_type
from eap.codec import datatypes
from eap.codec.adssymbol import AdsType


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
def test_what_types_are_made_of(text: str, entries: list) -> None:
    assert symbol_type(datatypes.parse(text)).describe() == entries


TEXTS = ["INT24", "UINT56[3]", "BIT5", "REAL", "LINT[2]", "STRING(9)", "BLOCK(5)", "BOOL", "DWORD"]


@given(st.sampled_from(TEXTS), st.data())
def test_whatever_a_client_writes_is_a_value_it_reads_again(text: str, data: st.DataObject) -> None:
    kind = symbol_type(datatypes.parse(text))
    written = data.draw(st.binary(min_size=kind.size, max_size=kind.size))
    try:
        octets = kind.from_client(written)
    except AdsRefusedError:
        return
    assert len(octets) == kind.kind.size
    assert kind.from_client(kind.to_client(octets)) == octets
