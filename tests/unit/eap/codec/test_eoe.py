"""A captured Set IP of TwinCAT and frames of a drive; then properties."""

from __future__ import annotations

from ipaddress import IPv4Address

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.eoe import (
    EoeHeader,
    EoeResult,
    EoeType,
    FragmentWord,
    IpSettings,
    ResultWord,
    decode_message,
    encode_message,
    name_of,
)
from eap.errors import CodecError, TruncatedError
from eap.ids import MacAddr
from tests.support.vectors import load
from tests.support.wirerecords import records

REQUEST, RESPONSE, *FRAMES = [vector.octets[6:] for vector in load("eoe_mailbox")]
TWINCAT = IpSettings(
    MacAddr.parse("02:01:05:30:03:e9"),
    IPv4Address("192.168.0.0"),
    IPv4Address("255.255.255.0"),
    IPv4Address("192.168.0.139"),
    IPv4Address("0.0.0.0"),
    "Drive_1__AKD_",
)
settings = st.builds(
    IpSettings,
    st.none() | st.binary(min_size=6, max_size=6).map(MacAddr),
    *[st.none() | st.integers(0, 0xFFFFFFFF).map(IPv4Address)] * 4,
    st.none() | st.text("abcüß_-", max_size=16),
)


def test_captured_set_ip_request() -> None:
    header, word, body = decode_message(REQUEST)
    assert (header, word) == (EoeHeader(EoeType.SET_IP_REQUEST), 0)
    assert IpSettings.decode(body) == TWINCAT
    assert encode_message(EoeType.SET_IP_REQUEST, TWINCAT.encode()) == REQUEST


def test_captured_set_ip_response() -> None:
    header, word, body = decode_message(RESPONSE)
    assert (header.type, word, bytes(body)) == (EoeType.SET_IP_RESPONSE, EoeResult.OK, b"")
    assert encode_message(EoeType.SET_IP_RESPONSE) == RESPONSE


@pytest.mark.parametrize("number", range(4))
def test_captured_frames_are_single_fragments(number: int) -> None:
    data = FRAMES[number]
    header, _, body = decode_message(data)
    word = FragmentWord.decode(data, 2)
    assert (header, word) == (EoeHeader(EoeType.FRAGMENT, last=1), FragmentWord(0, 2, number))
    assert bytes(body[12:14]) == b"\x08\x06"
    assert header.encode() + word.encode() + body == data


@given(settings)
def test_settings_round_trip(value: IpSettings) -> None:
    octets = value.encode()
    assert IpSettings.decode(octets) == value
    assert octets[0].bit_count() == sum(part is not None for part in (
        value.mac, value.ip, value.mask, value.gateway, value.dns, value.name
    ))  # fmt: skip


@given(settings, st.data())
def test_settings_that_lack_what_they_flag_are_truncated(
    value: IpSettings, data: st.DataObject
) -> None:
    fixed = IpSettings(value.mac, value.ip, value.mask, value.gateway, value.dns).encode()
    with pytest.raises(TruncatedError):
        IpSettings.decode(fixed[: data.draw(st.integers(0, len(fixed) - 1))])


def test_name_may_be_cut_and_may_not_be_too_long() -> None:
    assert IpSettings.decode(bytes.fromhex("20000000") + b"drive").name == "drive"
    with pytest.raises(CodecError, match="33 bytes, expected at most 32"):
        IpSettings(name="x" * 33).encode()


@pytest.mark.parametrize("record", [EoeHeader, FragmentWord, ResultWord])
@given(data=st.data())
def test_record_round_trip(record: type, data: st.DataObject) -> None:
    value = data.draw(records(record))
    assert record.decode(value.encode()) == value
    with pytest.raises(TruncatedError, match=record.__name__):
        record.decode(value.encode()[: data.draw(st.integers(0, 1))])


@given(st.binary(max_size=50))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        header, word, body = decode_message(noise)
        IpSettings.decode(body)
    except CodecError:
        return
    assert header.encode() + word.to_bytes(2, "little") + body == noise


def test_every_result_has_a_text_of_its_own() -> None:
    assert len({name_of(result) for result in EoeResult}) == len(EoeResult)
    assert name_of(0x0201) == "IP is not supported"
    assert name_of(0x7777) == "result code of the vendor"
