from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ams import (
    AmsAnswer,
    AmsCommand,
    AmsHeader,
    AmsTcpHeader,
    StateFlags,
    decode_packet,
    decode_prefix,
    encode_net_id,
    encode_opened_port,
    encode_packet,
    encode_with_prefix,
    response_to,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from eap.ids import NetId
from tests.support.wirerecords import records

headers = records(AmsHeader)


def test_header_matches_wire_layout() -> None:
    header = AmsHeader(
        NetId.parse("192.168.0.1.2.1"),
        1001,
        NetId.parse("192.168.0.50.1.1"),
        0x8000,
        AmsCommand.READ,
        StateFlags.ADS,
        length=12,
        error_code=6,
        invoke_id=1,
    )
    assert header.encode().hex() == (
        "c0a800010201e903c0a80032010100800200040" + "00c000000" + "06000000" + "01000000"
    )
    assert AmsHeader.SIZE == 32


@given(headers, st.binary(max_size=60), st.binary(max_size=3))
def test_packet_round_trip(header: AmsHeader, body: bytes, before: bytes) -> None:
    packet = encode_packet(header, body)
    read, data = decode_packet(before + packet + b"rest", len(before))
    assert (read.length, bytes(data)) == (len(body), body)
    assert encode_packet(read, data) == packet


@given(headers, st.binary(max_size=20), st.data())
def test_every_prefix_is_truncated(header: AmsHeader, body: bytes, data: st.DataObject) -> None:
    packet = encode_packet(header, body)
    cut = data.draw(st.integers(0, len(packet) - 1))
    with pytest.raises(TruncatedError, match="AmsHeader"):
        decode_packet(packet[:cut])


@given(st.binary(max_size=80))
def test_garbage_decodes_or_raises_codec_error(noise: bytes) -> None:
    try:
        header, data = decode_packet(noise)
    except CodecError:
        return
    assert noise.startswith(encode_packet(header, data))


def test_unknown_command_is_kept() -> None:
    header = AmsHeader(NetId(bytes(6)), 0, NetId(bytes(6)), 0, 0x1234)
    assert AmsHeader.decode(header.encode()).command == 0x1234
    assert AmsCommand.name_of(0x1234) == "0x1234"
    assert AmsCommand.name_of(9) == "READ_WRITE"


@given(st.binary(min_size=32, max_size=200), st.binary(max_size=5))
def test_prefix_round_trip(packet: bytes, before: bytes) -> None:
    octets = encode_with_prefix(packet)
    assert octets == b"\0\0" + len(packet).to_bytes(4, "little") + packet
    assert decode_prefix(before + octets, len(before)) == len(packet)


@given(st.integers(0, 5))
def test_every_prefix_of_it_is_truncated(size: int) -> None:
    with pytest.raises(TruncatedError, match="AmsTcpHeader"):
        decode_prefix(AmsTcpHeader(0, 32).encode()[:size])


@pytest.mark.parametrize(
    ("header", "text"),
    [
        (AmsTcpHeader(0x1000, 40), "reserved is 0x1000, expected 0"),
        (AmsTcpHeader(0, 31), "length 31, expected 32 or more"),
        (AmsTcpHeader(0, 0), "length 0, expected 32 or more"),
    ],
)
def test_prefix_without_packet_is_refused(header: AmsTcpHeader, text: str) -> None:
    with pytest.raises(MalformedError, match=text):
        decode_prefix(header.encode())


def test_address_of_a_local_client() -> None:
    """As the open client ads-client takes it: command, length, NetID, port."""
    net_id = NetId.parse("1.2.3.4.5.6")
    assert encode_opened_port(net_id, 0x8001) == bytes.fromhex("0010 08000000 010203040506 0180")
    assert encode_net_id(net_id) == bytes.fromhex("0210 06000000 010203040506")


REQUEST = AmsHeader(NetId(b"target"), 1001, NetId(b"source"), 33000, AmsCommand.READ, invoke_id=7)


def test_response_keeps_command_and_invoke_id() -> None:
    header, body = decode_packet(response_to(REQUEST, AmsAnswer(b"data", 6)))
    assert (header.target, header.target_port) == (REQUEST.source, REQUEST.source_port)
    assert (header.source, header.source_port) == (REQUEST.target, REQUEST.target_port)
    assert header.state_flags == StateFlags.ADS | StateFlags.RESPONSE
    assert (header.command, header.invoke_id, header.error_code) == (AmsCommand.READ, 7, 6)
    assert bytes(body) == b"data"


@pytest.mark.parametrize(
    ("flags", "command", "wanted"),
    [
        (StateFlags.ADS, AmsCommand.READ, True),
        (StateFlags.ADS | StateFlags.NO_RETURN, AmsCommand.READ, False),
        (StateFlags.ADS, AmsCommand.NOTIFICATION, False),
    ],
)
def test_some_packets_have_no_answer(flags: int, command: int, *, wanted: bool) -> None:
    header = AmsHeader(NetId(bytes(6)), 0, NetId(bytes(6)), 0, command, flags)
    assert header.wants_answer is wanted
