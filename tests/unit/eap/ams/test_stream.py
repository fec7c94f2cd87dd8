from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.reassembly import AmsStreamDecoder, OversizedPacket, RouterRequest
from eap.codec.ams import AmsHeader, AmsTcpHeader, RouterCommand, encode_packet, encode_with_prefix
from eap.errors import MalformedError
from eap.ids import NetId

LIMIT = 100
HEADER = AmsHeader(NetId.parse("1.2.3.4.5.6"), 1, NetId.parse("6.5.4.3.2.1"), 2, 3)


def packet(size: int) -> bytes:
    return encode_packet(HEADER, b"x" * size)


def take(cutter: AmsStreamDecoder) -> list:
    pieces = []
    while (piece := cutter.next_item()) is not None:
        pieces.append(piece)
    return pieces


@given(st.lists(st.integers(0, 200), max_size=8), st.lists(st.integers(1, 90), min_size=1))
def test_packets_come_out_whole_however_the_stream_is_cut(sizes: list, cuts: list) -> None:
    octets = b"".join(encode_with_prefix(packet(size)) for size in sizes)
    cutter, found, at, number = AmsStreamDecoder(LIMIT), [], 0, 0
    while at < len(octets):
        step = cuts[number % len(cuts)]
        cutter.receive(octets[at : at + step])
        at, number = at + step, number + 1
        found += take(cutter)
    assert found == [
        packet(size)
        if size + 32 <= LIMIT
        else OversizedPacket(AmsHeader.decode(packet(size)), size + 32)
        for size in sizes
    ]
    assert not cutter.has_begun


def test_nothing_of_a_packet_over_the_limit_is_kept() -> None:
    cutter = AmsStreamDecoder(LIMIT)
    cutter.receive(AmsTcpHeader(0, 0xFFFF_FFFF).encode() + HEADER.encode())
    assert take(cutter) == [OversizedPacket(HEADER, 0xFFFF_FFFF)]
    for _ in range(1000):
        cutter.receive(bytes(1000))
        assert cutter.next_item() is None
    assert cutter.has_begun
    assert len(cutter._buffer) == 0


def test_one_whole_packet_is_taken_at_once() -> None:
    cutter = AmsStreamDecoder(LIMIT)
    one, other = encode_with_prefix(packet(5)), encode_with_prefix(packet(LIMIT - 32))
    assert cutter.receive_one(one) == packet(5)
    assert cutter.receive_one(other) == packet(LIMIT - 32)
    assert not cutter.has_begun
    for octets in (one[:-1], one + b"x", one + one, encode_with_prefix(packet(LIMIT - 31))):
        cutter = AmsStreamDecoder(LIMIT)
        assert cutter.receive_one(octets) is None
        assert cutter.has_begun
    cutter = AmsStreamDecoder(LIMIT)
    assert cutter.receive_one(one[:7]) is None
    assert cutter.receive_one(one) is None
    cutter = AmsStreamDecoder(LIMIT)
    assert cutter.receive_one(encode_with_prefix(packet(900))[:-3]) is None
    assert isinstance(cutter.next_item(), OversizedPacket)
    assert cutter.receive_one(one) is None


@pytest.mark.parametrize("length", [0, 31])
def test_prefix_of_less_than_a_header_is_not_taken_at_once(length: int) -> None:
    cutter = AmsStreamDecoder(LIMIT)
    assert cutter.receive_one(AmsTcpHeader(0, length).encode() + bytes(length)) is None
    with pytest.raises(MalformedError, match=f"length {length}, expected 32 or more"):
        cutter.next_item()


def test_packet_of_the_limit_is_taken() -> None:
    cutter = AmsStreamDecoder(LIMIT)
    cutter.receive(encode_with_prefix(packet(LIMIT - 32))[:-1])
    assert cutter.has_begun
    assert cutter.next_item() is None
    cutter.receive(b"x")
    assert take(cutter) == [packet(LIMIT - 32)]


def test_what_is_no_such_stream_cannot_be_cut() -> None:
    cutter = AmsStreamDecoder(LIMIT)
    cutter.receive(encode_with_prefix(packet(1)) + b"GET / HTTP/1.1")
    assert cutter.next_item() == packet(1)
    with pytest.raises(MalformedError, match="reserved is 0x4547"):
        cutter.next_item()


def test_questions_to_the_router_stand_among_packets() -> None:
    cutter, found = AmsStreamDecoder(LIMIT), []
    asked = AmsTcpHeader(RouterCommand.OPEN_PORT, 2).encode() + b"\1\2"
    for octet in asked + encode_with_prefix(packet(3)) + asked:
        cutter.receive(bytes((octet,)))
        found += take(cutter)
    question = RouterRequest(RouterCommand.OPEN_PORT, b"\1\2")
    assert found == [question, packet(3), question]
    assert not cutter.has_begun


def test_question_that_is_too_long_is_none() -> None:
    cutter = AmsStreamDecoder(LIMIT)
    cutter.receive(AmsTcpHeader(RouterCommand.NET_ID, 17).encode())
    with pytest.raises(MalformedError, match="length 17 behind a command, expected 16 or less"):
        cutter.next_item()
