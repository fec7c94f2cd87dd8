"""Modbus PDUs: the examples of the specification (V1.1b3, section 6), and anything at all."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.modbus import (
    ModbusException,
    ModbusFrame,
    ModbusMask,
    ModbusRead,
    ModbusReadWrite,
    ModbusRefusalError,
    ModbusReply,
    ModbusTable,
    ModbusWrite,
    decode_reply,
    decode_request,
    encode_exception,
    encode_values,
    frame_length,
    write_request,
)
from eap.errors import CodecError, MalformedError

HOLDING, COILS = ModbusTable.HOLDING, ModbusTable.COILS


@pytest.mark.parametrize(
    ("octets", "request_"),
    [
        ("01 0013 0013", ModbusRead(COILS, 0x13, 0x13)),
        ("02 00c4 0016", ModbusRead(ModbusTable.DISCRETE, 0xC4, 0x16)),
        ("03 006b 0003", ModbusRead(HOLDING, 0x6B, 3)),
        ("04 0008 0001", ModbusRead(ModbusTable.INPUT, 8, 1)),
        ("05 00ac ff00", ModbusWrite(COILS, 0xAC, 1, b"\1", 5)),
        ("06 0001 0003", ModbusWrite(HOLDING, 1, 1, b"\0\3", 6)),
        ("0f 0013 000a 02 cd01", ModbusWrite(COILS, 0x13, 10, b"\xcd\1", 15)),
        ("10 0001 0002 04 000a0102", ModbusWrite(HOLDING, 1, 2, b"\0\n\1\2", 16)),
        ("16 0004 00f2 0025", ModbusMask(4, 0xF2, 0x25)),
    ],
)
def test_examples_of_the_specification(octets: str, request_: ModbusRead) -> None:
    pdu = bytes.fromhex(octets)
    assert decode_request(pdu) == request_
    assert request_.encode() == pdu


def test_read_and_write_in_one_request() -> None:
    found = decode_request(bytes.fromhex("17 0003 0006 000e 0003 06 00ff00ff00ff"))
    assert found == ModbusReadWrite(
        ModbusRead(HOLDING, 3, 6), ModbusWrite(HOLDING, 14, 3, b"\0\xff" * 3, 23)
    )


def test_reply_of_the_specification() -> None:
    request = ModbusRead(HOLDING, 0x6B, 3).encode()
    data = bytes.fromhex("022b00000064")
    assert decode_reply(bytes.fromhex("0306022b00000064"), request) == ModbusReply(data)
    assert encode_values(3, data).hex() == "0306022b00000064"
    assert decode_reply(bytes.fromhex("8302"), request) == ModbusReply(exception=2)
    assert encode_exception(3, ModbusException.ADDRESS).hex() == "8302"


@pytest.mark.parametrize(
    ("octets", "exception"),
    [
        ("2b0e0100", ModbusException.FUNCTION),
        ("03 0000 0000", ModbusException.VALUE),
        ("03 0000 007e", ModbusException.VALUE),
        ("03 0000", ModbusException.VALUE),
        ("05 0000 1234", ModbusException.VALUE),
        ("10 0001 0002 04 000a01", ModbusException.VALUE),
        ("0f 0013 000a 01 cd", ModbusException.VALUE),
    ],
)
def test_wrong_request_is_refused_with_its_exception(
    octets: str, exception: ModbusException
) -> None:
    with pytest.raises(ModbusRefusalError) as caught:
        decode_request(bytes.fromhex(octets))
    assert caught.value.exception is exception


def test_single_values_have_requests_of_their_own() -> None:
    assert write_request(COILS, 3, 1, b"\1").encode().hex() == "050003ff00"
    assert write_request(HOLDING, 3, 1, b"\1\2").encode().hex() == "0600030102"
    several = write_request(HOLDING, 3, 2, b"\1\2\3\4")
    assert several.encode().hex() == "1000030002040102" + "0304"
    assert several.reply().hex() == "1000030002"


def test_frame_and_its_length() -> None:
    octets = bytes.fromhex("1501 0000 0006 ff 01 0013 0013")
    assert frame_length(octets[:5]) is None
    assert frame_length(octets) == len(octets)
    frame = ModbusFrame.decode(octets)
    assert frame == ModbusFrame(0x1501, 0xFF, octets[7:])
    assert frame.encode() == octets
    with pytest.raises(MalformedError):
        frame_length(bytes.fromhex("150100010006"))
    with pytest.raises(MalformedError):
        frame_length(bytes.fromhex("1501000000ff"))


@given(st.binary(min_size=1, max_size=260), st.binary(min_size=1, max_size=8))
def test_decoders_raise_nothing_but_codec_errors(pdu: bytes, other: bytes) -> None:
    for decode in (decode_request, lambda octets: decode_reply(octets, other), frame_length):
        with contextlib.suppress(CodecError):
            decode(pdu)
