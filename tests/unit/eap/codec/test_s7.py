"""S7 PDUs: bytes of nodes7 (npm, its source), round trips, and anything at all."""

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.s7 import (
    CotpConnect,
    CotpKind,
    ItemCode,
    ItemData,
    PduKind,
    S7Area,
    S7Function,
    S7Item,
    S7Pdu,
    data_item,
    decode_cotp,
    decode_item_data,
    decode_items,
    decode_setup,
    encode_data,
    encode_item_data,
    encode_items,
    encode_setup,
    packet_length,
)
from eap.errors import CodecError, MalformedError

CONNECT = bytes.fromhex("03000016 11e00000 000200c0 010ac102 0100c202 0102")
SETUP = bytes.fromhex("03000019 02f08032 01000000 00000800 00f00000 08000803 c0")
# Written by hand from the layout: read DB1.DBX0.0 BYTE 8, and its reply.
READ = bytes.fromhex("0300001f 02f08032 01000000 05000e00 00040112 0a100200 08000184 000000")
REPLY = bytes.fromhex("03000021 02f08032 03000000 05000200 0c000004 01ff0400 400102030405060708")


def test_connection_request_of_nodes7_is_read_and_written() -> None:
    found = decode_cotp(CONNECT)
    assert found == CotpConnect(CotpKind.REQUEST, 2, 0, b"\1\0", b"\1\2", 1024)
    assert found.encode() == CONNECT


def test_setup_of_nodes7_is_read_and_written() -> None:
    pdu = decode_cotp(SETUP)
    assert isinstance(pdu, S7Pdu)
    assert decode_setup(pdu.parameters) == 960
    assert encode_data(S7Pdu(PduKind.JOB, 0, encode_setup(960, 8))) == SETUP


def test_read_request_and_its_reply() -> None:
    request, reply = decode_cotp(READ), decode_cotp(REPLY)
    assert isinstance(request, S7Pdu)
    assert isinstance(reply, S7Pdu)
    item = data_item(S7Area.BLOCK, 1, 0, 64)
    assert decode_items(request.parameters) == [item]
    assert encode_items(S7Function.READ, [item]) == request.parameters
    assert decode_item_data(reply.data, 1) == [ItemData(ItemCode.DONE, bytes(range(1, 9)))]
    assert encode_data(reply) == REPLY


def test_odd_items_are_padded_but_the_last() -> None:
    one = data_item(S7Area.BLOCK, 1, 0, 8)
    data = encode_item_data([(one, ItemData(ItemCode.DONE, b"\7"))] * 2)
    assert data.hex() == "ff04000807" + "00" + "ff04000807"
    assert [each.data for each in decode_item_data(data, 2)] == [b"\7", b"\7"]


def test_bit_and_error_items() -> None:
    bit = data_item(S7Area.FLAGS, 0, 83, 1)
    data = encode_item_data(
        [(bit, ItemData(ItemCode.DONE, b"\1")), (bit, ItemData(ItemCode.ADDRESS))]
    )
    assert data.hex() == "ff03000101" + "00" + "05000000"
    assert decode_item_data(data, 2) == [
        ItemData(ItemCode.DONE, b"\1"),
        ItemData(ItemCode.ADDRESS),
    ]
    assert (bit.start, bit.bits, bit.size, bit.is_bit) == (83, 1, 1, True)


def test_lengths_of_reals_and_texts_are_in_bytes() -> None:
    # As controllers reply to an item of type REAL: transport 7, length in bytes.
    assert decode_item_data(bytes.fromhex("ff070004 3f800000"), 1)[0].data.hex() == "3f800000"


def test_symbolic_address_is_an_item_without_type() -> None:
    parameters = bytes.fromhex("0401 1204b2ff0000")
    assert decode_items(parameters) == [S7Item(0, 0, 0, 0, 0)]


@pytest.mark.parametrize(
    "header", ["04000016", "03000004", "0300ffff"], ids=["version", "empty", "too long"]
)
def test_packet_that_is_none_is_refused(header: str) -> None:
    with pytest.raises(MalformedError):
        packet_length(bytes.fromhex(header))


@given(st.binary(max_size=64))
def test_decoders_raise_nothing_but_codec_errors(data: bytes) -> None:
    for decode in (
        decode_cotp,
        S7Pdu.decode,
        decode_items,
        decode_setup,
        lambda octets: decode_item_data(octets, 3),
        packet_length,
    ):
        with suppress(CodecError):
            decode(data)  # type: ignore[operator]


@given(st.lists(st.binary(min_size=1, max_size=9), min_size=1, max_size=8))
def test_item_data_round_trip(pieces: list[bytes]) -> None:
    items = [
        (data_item(S7Area.BLOCK, 1, 0, 8 * len(each)), ItemData(ItemCode.DONE, each))
        for each in pieces
    ]
    found = decode_item_data(encode_item_data(items), len(items))
    assert [each.data for each in found] == pieces
