"""SoE messages, error codes and values."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.soe import (
    Display,
    Element,
    Idn,
    ListHead,
    SoeAttribute,
    SoeErrorCode,
    SoeHeader,
    SoeOpcode,
    decode_list,
    decode_message,
    decode_scalar,
    decode_value,
    encode_fragments,
    encode_list,
    encode_message,
    encode_scalar,
    encode_value,
    error_code_of,
    name_of,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.vectors import load_message
from tests.support.wirerecords import records


def test_read_request_matches_wire_layout() -> None:
    octets = encode_message(SoeOpcode.READ_REQUEST, Idn.parse("S-0-0032").number, drive=1)
    assert octets == bytes.fromhex("21 40 2000")


def test_refusal_matches_wire_layout() -> None:
    octets = encode_message(
        SoeOpcode.READ_RESPONSE, 0x8064, b"\x01\x10", elements=Element.NAME, error=True
    )
    assert octets == bytes.fromhex("12 02 6480 0110")
    header, body = decode_message(octets)
    assert header == SoeHeader(SoeOpcode.READ_RESPONSE, 0, 1, 0, Element.NAME, 0x8064)
    assert error_code_of(body) == 0x1001


def test_error_code_is_the_last_two_octets() -> None:
    assert error_code_of(b"\0\0\x09\x70") == 0x7009
    with pytest.raises(TruncatedError, match="an error of 1 bytes"):
        error_code_of(b"\1")


def test_attribute_matches_wire_layout() -> None:
    attribute = SoeAttribute(
        factor=1, length=1, is_list=1, display=Display.IDN, decimals=3, protected_op=1
    )
    assert attribute.encode() == bytes.fromhex("0100 5543")
    assert attribute.size == 2


@pytest.mark.parametrize(
    ("text", "number"),
    [("S-0-0032", 32), ("P-0-0100", 0x8064), ("S-7-4095", 0x7FFF), ("P-3-0001", 0xB001)],
)
def test_idn_has_a_written_form(text: str, number: int) -> None:
    assert Idn.parse(text).number == number
    assert str(Idn.of(number)) == text


@given(st.integers(0, 0xFFFF))
def test_every_number_has_an_idn(number: int) -> None:
    idn = Idn.of(number)
    assert idn.number == number
    assert Idn.parse(str(idn).lower()) == idn


@pytest.mark.parametrize("text", ["", "S-0-4096", "S-8-0001", "X-0-1", "32", "S-0-", "S-0-00001"])
def test_other_text_is_no_idn(text: str) -> None:
    with pytest.raises(ValueError, match="is not an IDN"):
        Idn.parse(text)


@given(st.binary(max_size=60), st.integers(1, 20), st.integers(0, 0xFFFF))
def test_fragments_count_down_and_hold_everything(body: bytes, room: int, idn: int) -> None:
    header = SoeHeader(SoeOpcode.WRITE_REQUEST, 0, 0, 3, Element.VALUE, idn)
    read = [decode_message(message) for message in encode_fragments(header, body, room)]
    assert b"".join(bytes(part) for _, part in read) == body
    assert all(len(part) <= room for _, part in read)
    assert [head.incomplete for head, _ in read] == [1] * (len(read) - 1) + [0]
    assert [head.idn for head, _ in read] == [*range(len(read) - 1, 0, -1), idn]
    assert {(head.opcode, head.drive, head.elements) for head, _ in read} == {(3, 3, 0x40)}


@given(st.binary(max_size=30), st.integers(0, 9))
def test_list_round_trip(octets: bytes, more: int) -> None:
    head, read = decode_list(encode_list(octets, len(octets) + more) + b"surplus")
    assert (head, read) == (ListHead(len(octets), len(octets) + more), octets)
    assert decode_list(encode_list(octets))[0].max_length == len(octets)


def test_list_that_contradicts_its_head_is_refused() -> None:
    with pytest.raises(TruncatedError, match="length 4, but 3 bytes follow"):
        decode_list(bytes.fromhex("0400 0400 010203"))
    with pytest.raises(MalformedError, match="length 2 of at most 1"):
        decode_list(bytes.fromhex("0200 0100 0102"))


@pytest.mark.parametrize("record", [SoeHeader, SoeAttribute, ListHead])
@given(data=st.data())
def test_round_trip_and_every_prefix_is_truncated(record: type, data: st.DataObject) -> None:
    value = data.draw(records(record))
    octets = value.encode()
    assert len(octets) == 4
    assert record.decode(octets) == value
    with pytest.raises(TruncatedError, match=record.__name__):
        record.decode(octets[: data.draw(st.integers(0, 3))])


@given(st.binary(max_size=20))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        header, body = decode_message(noise)
    except CodecError:
        return
    assert header.encode() + body == noise


def test_vectors() -> None:
    request, refusal = load_message("soe_read_req"), load_message("soe_read_err")
    assert encode_message(SoeOpcode.READ_REQUEST, 32) == request
    assert encode_message(SoeOpcode.READ_RESPONSE, 32, b"\1\x10", error=True) == refusal
    header, body = decode_message(refusal)
    assert (header.error, error_code_of(body)) == (1, 0x1001)


def test_every_code_has_a_text_of_its_own() -> None:
    texts = [name_of(code) for code in SoeErrorCode]
    assert len(set(texts)) == len(texts) == 48
    assert "error code of the vendor" not in texts


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x1001, "no such IDN"),
        (0x2004, "name is read only"),
        (0x3002, "attribute is too short"),
        (0x6005, "maximum is write protected now"),
        (0x7003, "value is too long"),
        (0x700A, "value is write protected: it is configured cyclically"),
        (0x7011, "procedure command cannot be interrupted"),
        (0x800A, "invalid drive number"),
        (0x800B, "general error"),
        (0x800C, "no element addressed"),
        (0x9999, "error code of the vendor"),
    ],
)
def test_text(code: int, text: str) -> None:
    assert name_of(code) == text


UNSIGNED = SoeAttribute(length=2, display=Display.UNSIGNED)
IDNS = SoeAttribute(length=1, is_list=1, display=Display.IDN)
TEXT = SoeAttribute(length=0, is_list=1, display=Display.TEXT)


@pytest.mark.parametrize(
    ("display", "length", "value", "octets"),
    [
        (Display.UNSIGNED, 0, 200, "c8"),
        (Display.SIGNED, 0, -56, "c8"),
        (Display.HEXADECIMAL, 1, 0xBEEF, "efbe"),
        (Display.SIGNED, 2, -2, "feffffff"),
        (Display.BINARY, 3, 1 << 63, "0000000000000080"),
        (Display.FLOAT, 2, 1.5, "0000c03f"),
        (Display.FLOAT, 3, -2.0, "00000000000000c0"),
        (Display.FLOAT, 1, 3, "0300"),
        (Display.IDN, 1, 0x8064, "6480"),
    ],
)
def test_one_value(display: Display, length: int, value: float, octets: str) -> None:
    attribute = SoeAttribute(length=length, display=display)
    assert encode_value(attribute, value) == bytes.fromhex(octets)
    assert decode_value(attribute, bytes.fromhex(octets) + b"more") == value


def test_list_and_text() -> None:
    assert encode_value(IDNS, [32, 33], max_length=8) == bytes.fromhex("0400 0800 2000 2100")
    assert decode_value(IDNS, bytes.fromhex("0400 0800 2000 2100")) == [32, 33]
    assert encode_value(IDNS, 32) == bytes.fromhex("0200 0200 2000")
    assert decode_value(IDNS, bytes(4)) == []
    assert encode_value(TEXT, "drive") == bytes.fromhex("0500 0500") + b"drive"
    assert decode_value(TEXT, bytes.fromhex("0700 0700") + b"drive\0\0") == "drive"


@pytest.mark.parametrize("value", [-1, 1 << 32, "5", 1.5, None])
def test_invalid_value_is_refused(value: object) -> None:
    expected = "is no value of 4 bytes: expected a whole number from 0 to 4294967295"
    with pytest.raises(ValueError, match=expected):
        encode_scalar(UNSIGNED, value)


def test_invalid_value_error_names_the_expected_one() -> None:
    signed = SoeAttribute(length=0, display=Display.SIGNED)
    with pytest.raises(ValueError, match="expected a whole number from -128 to 127"):
        encode_scalar(signed, 128)
    single = SoeAttribute(length=2, display=Display.FLOAT)
    for value in ("5", 1e300):
        with pytest.raises(ValueError, match="expected a number"):
            encode_scalar(single, value)


def test_value_that_is_cut_is_truncated() -> None:
    with pytest.raises(TruncatedError, match="3 bytes for a value of 4"):
        decode_scalar(UNSIGNED, bytes(3))
    with pytest.raises(MalformedError, match="3 bytes for values of 2"):
        decode_value(IDNS, bytes.fromhex("0300 0400 200021"))


attributes = st.builds(
    SoeAttribute,
    length=st.integers(0, 3),
    is_list=st.integers(0, 1),
    display=st.integers(0, 7),
)


@given(attributes, st.binary(max_size=30))
def test_any_octets_are_a_value_or_codec_error(attribute: SoeAttribute, noise: bytes) -> None:
    try:
        value = decode_value(attribute, noise)
    except CodecError:
        return
    parts = value if isinstance(value, list) else [value]
    if attribute.display == Display.TEXT or any(x != x or math.isinf(x) for x in parts):  # noqa: PLR0124
        return
    again = encode_value(attribute, value)
    assert decode_value(attribute, again) == value
