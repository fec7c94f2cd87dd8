from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    VoeHeader,
    aoe_packet_in,
    decode_frame,
    decode_message,
    encode_frame,
    encode_message,
    encode_plain_frame,
)
from eap.errors import CodecError, MalformedError, TruncatedError
from tests.support.vectors import load_message
from tests.support.wirerecords import records

headers = records(MailboxHeader)


def test_header_matches_wire_layout() -> None:
    header = MailboxHeader(10, 1001, channel=1, priority=3, type=MailboxType.COE, counter=2)
    assert header.encode() == bytes.fromhex("0a00 e903 c1 23")


@given(headers, st.binary(max_size=2041))
def test_frame_round_trip(header: MailboxHeader, body: bytes) -> None:
    frame = encode_frame(header, body)
    read, data = decode_frame(frame + b"padding")
    assert (read.length, bytes(data)) == (len(body), body)
    assert encode_frame(read, data) == frame


@given(headers, st.binary(max_size=40), st.binary(max_size=3))
def test_message_round_trip(header: MailboxHeader, body: bytes, before: bytes) -> None:
    message = encode_message(header, body)
    read, data = decode_message(before + message + b"rest of the mailbox", len(before))
    assert encode_message(read, data) == message


@given(headers, st.binary(max_size=40), st.data())
def test_every_prefix_is_truncated(header: MailboxHeader, body: bytes, data: st.DataObject) -> None:
    frame = encode_frame(header, body)
    cut = data.draw(st.integers(0, len(frame) - 1))
    with pytest.raises(TruncatedError):
        decode_frame(frame[:cut])
    with pytest.raises(TruncatedError):
        decode_message(frame[:cut], EtherCatHeader.SIZE)


@given(st.binary(max_size=60), st.booleans())
def test_garbage_decodes_or_raises_codec_error(noise: bytes, as_type_5: bool) -> None:
    if as_type_5:
        noise = EtherCatHeader(len(noise), type=FrameType.MAILBOX).encode() + noise
    try:
        header, data = decode_frame(noise)
    except CodecError:
        return
    assert noise.startswith(encode_frame(header, data)[2:], 2)


def test_message_longer_than_its_frame_is_truncated() -> None:
    frame = EtherCatHeader(8, type=FrameType.MAILBOX).encode() + MailboxHeader(3).encode() + b"abc"
    with pytest.raises(TruncatedError, match="length 3, but 2 bytes follow"):
        decode_frame(frame)


def test_other_frame_type_is_malformed() -> None:
    with pytest.raises(MalformedError, match="frame type 4, expected 5"):
        decode_frame(EtherCatHeader(6).encode() + bytes(6))


def test_unknown_protocol_is_malformed() -> None:
    with pytest.raises(MalformedError, match="6 is not a valid MailboxType"):
        decode_message(bytes.fromhex("0000 0000 00 16"))


def test_body_too_long_for_a_frame_is_refused() -> None:
    with pytest.raises(CodecError, match="EtherCatHeader"):
        encode_frame(MailboxHeader(0), bytes(2042))


def test_error_reply_names_its_reason() -> None:
    reply = MailboxErrorReply.decode(bytes.fromhex("0100 0200"))
    assert reply == MailboxErrorReply(detail=MailboxError.UNSUPPORTED_PROTOCOL)
    assert MailboxError.name_of(reply.detail) == "UNSUPPORTED_PROTOCOL"
    assert MailboxError.text_of(reply.detail).startswith("UNSUPPORTED_PROTOCOL, it does not speak")
    assert MailboxError.text_of(0x99) == MailboxError.name_of(0x99) == "0x0099"
    assert MailboxError.name_of(0x1234) == "0x1234"


@given(
    st.sampled_from(MailboxType), st.integers(0, 0xFFFF), st.integers(0, 7),
    st.binary(max_size=2100),
)  # fmt: skip
def test_plain_frame_is_made_in_one_step_as_in_two(
    kind: MailboxType, address: int, counter: int, body: bytes
) -> None:
    header = MailboxHeader(0, address, type=kind, counter=counter)
    try:
        frame = encode_frame(header, body)
    except CodecError:
        with pytest.raises(CodecError):
            encode_plain_frame(kind, address, counter, body)
        return
    assert encode_plain_frame(kind, address, counter, body) == frame


@given(st.integers(0, 7), st.binary(max_size=64))
def test_aoe_packet_is_found_behind_both_headers(counter: int, packet: bytes) -> None:
    frame = encode_plain_frame(MailboxType.AOE, 0, counter, packet)
    assert aoe_packet_in(frame + b"padding") == aoe_packet_in(memoryview(frame)) == packet


@given(headers, st.binary(max_size=64), st.integers(0, 80), st.binary(max_size=8))
def test_frame_is_read_in_one_step_as_in_two(
    header: MailboxHeader, body: bytes, cut: int, damage: bytes
) -> None:
    frame = encode_frame(header, body)[:cut] + damage
    try:
        ethercat = EtherCatHeader.decode(frame)
        end = EtherCatHeader.SIZE + ethercat.length
        expected = decode_message(frame[:end], EtherCatHeader.SIZE)
    except CodecError:
        expected = None
    if expected is None or ethercat.type != FrameType.MAILBOX or end > len(frame):
        with pytest.raises(CodecError):
            decode_frame(frame)
    else:
        assert decode_frame(frame) == expected


@given(headers, st.binary(max_size=64), st.integers(0, 80), st.binary(max_size=8))
def test_aoe_packet_is_found_where_a_frame_has_one(
    header: MailboxHeader, body: bytes, cut: int, damage: bytes
) -> None:
    frame = encode_frame(header, body)[:cut] + damage
    try:
        found, inside = decode_frame(frame)
        expected = inside if found.type is MailboxType.AOE and not found.address else None
    except CodecError:
        expected = None
    assert aoe_packet_in(frame) == expected


def test_voe_header_matches_wire_layout() -> None:
    assert VoeHeader(2, 0x1234).encode() == bytes.fromhex("02000000 3412")


@given(records(VoeHeader), st.integers(0, VoeHeader.SIZE - 1))
def test_round_trip_and_every_prefix_is_truncated(header: VoeHeader, cut: int) -> None:
    assert VoeHeader.decode(header.encode() + b"data") == header
    with pytest.raises(TruncatedError, match="VoeHeader"):
        VoeHeader.decode(header.encode()[:cut])


def test_vector() -> None:
    octets = load_message("voe")
    header = VoeHeader.decode(octets)
    assert header == VoeHeader(0x1164, 1)
    assert header.encode() + b"\1\2" == octets
