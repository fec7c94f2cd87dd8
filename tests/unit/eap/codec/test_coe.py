from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.coe import CoeHeader, CoeService, Emergency, decode_message, encode_message
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.wirerecords import records


def test_header_lies_as_on_the_wire() -> None:
    assert CoeHeader(service=CoeService.SDO_RESPONSE).encode() == bytes.fromhex("0030")
    assert CoeHeader(0x1FF, service=CoeService.TX_PDO).encode() == bytes.fromhex("ff41")


def test_emergency_lies_as_on_the_wire() -> None:
    emergency = Emergency(0x2310, 0x03, b"\1\2\3\4\5")
    octets = encode_message(CoeService.EMERGENCY, emergency.encode())
    assert octets == bytes.fromhex("0010 1023 03 0102030405")
    header, body = decode_message(octets)
    assert (header.service, Emergency.decode(body)) == (CoeService.EMERGENCY, emergency)


@pytest.mark.parametrize("record", [CoeHeader, Emergency])
@given(data=st.data())
def test_round_trip_and_every_prefix_is_truncated(record: type, data: st.DataObject) -> None:
    value = data.draw(records(record))
    octets = value.encode()
    assert record.decode(octets) == value
    with pytest.raises(TruncatedError, match=record.__name__):
        record.decode(octets[: data.draw(st.integers(0, len(octets) - 1))])


@given(st.sampled_from(CoeService), st.integers(0, 0x1FF), st.binary(max_size=20))
def test_message_round_trip(service: CoeService, number: int, body: bytes) -> None:
    header, read = decode_message(encode_message(service, body, number=number))
    assert (header.service, header.number, bytes(read)) == (service, number, body)


@given(st.binary(max_size=12))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        header, body = decode_message(noise)
    except CodecError:
        return
    assert header.encode() + body == noise


def test_unknown_service_is_malformed() -> None:
    with pytest.raises(MalformedError, match="9 is not a valid CoeService"):
        decode_message(bytes.fromhex("0090"))


def test_pdo_number_that_does_not_fit_is_refused() -> None:
    with pytest.raises(CodecError, match="CoeHeader"):
        CoeHeader(0x200, service=CoeService.RX_PDO).encode()
