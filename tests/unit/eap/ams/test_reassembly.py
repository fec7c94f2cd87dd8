"""Packets put together from TCP streams and AoE fragments."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams import reassembly
from eap.ams.reassembly import (
    FRAGMENT_TIMEOUT_NS,
    MAX_LENGTH,
    MAX_PACKETS,
    MAX_SENDERS,
    AmsStreamDecoder,
    FragmentAssembler,
    OversizedPacket,
    Reassembly,
    RouterRequest,
    iter_fragments,
)
from eap.codec.ams import (
    AmsCommand,
    AmsHeader,
    AmsTcpHeader,
    RouterCommand,
    decode_packet,
    encode_packet,
    encode_with_prefix,
)
from eap.errors import MalformedError
from eap.ids import Endpoint, NetId
from tests.support.ams import Ams

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


def test_decoder_refuses_stream_without_ams_packets() -> None:
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


HEADER_FRAGMENT = AmsHeader(NetId(b"target"), 1001, NetId(b"source"), 33000, 2, invoke_id=77)


def give(assembler, fragment, now_ns=0):
    header, body = decode_packet(fragment)
    return assembler.receive(header, bytes(body), now_ns)


@given(st.binary(max_size=500), st.integers(1, 200), st.integers(0, 0xFFFF))
def test_fragments_are_reassembled_to_the_packet(body, room, number):
    packet = encode_packet(HEADER_FRAGMENT, body)
    assembler = FragmentAssembler()
    fragments = list(iter_fragments(packet, number, room))
    taken = [give(assembler, each) for each in fragments]
    assert [each.packet for each in taken] == [None] * (len(taken) - 1) + [packet]
    assert assembler.dropped == 0
    for count, each in enumerate(fragments):
        header, _ = decode_packet(each)
        assert (header.command, header.invoke_id) == (AmsCommand.FRAGMENT, number << 16 | count)
        assert (header.target, header.source_port) == (
            HEADER_FRAGMENT.target,
            HEADER_FRAGMENT.source_port,
        )


def test_packets_of_several_senders_mix():
    assembler = FragmentAssembler()
    packets = [
        encode_packet(msgspec.structs.replace(HEADER_FRAGMENT, source_port=port), bytes(100))
        for port in (1, 2)
    ]
    cut = [list(iter_fragments(packet, 9, 60)) for packet in packets]
    ends = [give(assembler, each).packet for pair in zip(*cut, strict=True) for each in pair]
    assert ends == [None, None, *packets]


def test_missing_fragment_drops_the_packet():
    assembler = FragmentAssembler()
    first, _, third = iter_fragments(encode_packet(HEADER_FRAGMENT, bytes(50)), 1, 25)
    give(assembler, first)
    with pytest.raises(MalformedError, match="out of order"):
        give(assembler, third)
    assert assembler.dropped == 1
    with pytest.raises(MalformedError):
        give(assembler, third)


def test_late_fragment_drops_the_packet():
    assembler = FragmentAssembler()
    first, second = iter_fragments(encode_packet(HEADER_FRAGMENT, bytes(20)), 1, 20)
    give(assembler, first, 0)
    with pytest.raises(MalformedError):
        give(assembler, second, FRAGMENT_TIMEOUT_NS + 1)


def test_new_start_takes_the_place_of_the_old():
    assembler = FragmentAssembler()
    packet = encode_packet(HEADER_FRAGMENT, bytes(20))
    first, second = iter_fragments(packet, 1, 20)
    give(assembler, first)
    give(assembler, first)
    assert give(assembler, second).packet == packet
    assert assembler.dropped == 1


def test_only_so_many_packets_are_kept():
    assembler = FragmentAssembler()
    cut = [list(iter_fragments(encode_packet(HEADER_FRAGMENT, bytes(20)), n, 20)) for n in range(9)]
    for first, _ in cut:
        give(assembler, first)
    with pytest.raises(MalformedError):
        give(assembler, cut[0][1])
    assert give(assembler, cut[MAX_PACKETS][1]).packet is not None


@pytest.mark.parametrize("length", [3, MAX_LENGTH + 1])
def test_length_that_cannot_be_drops_the_packet(length):
    assembler = FragmentAssembler()
    fragment = bytearray(next(iter_fragments(encode_packet(HEADER_FRAGMENT, bytes(20)), 1, 36)))
    fragment[36:40] = length.to_bytes(4, "little")
    with pytest.raises(MalformedError, match="too long"):
        give(assembler, bytes(fragment))


def test_forgotten_packets_do_not_go_on():
    assembler = FragmentAssembler()
    first, second = iter_fragments(encode_packet(HEADER_FRAGMENT, bytes(20)), 1, 20)
    give(assembler, first)
    assembler.reset()
    with pytest.raises(MalformedError):
        give(assembler, second)


PACKET = Ams("5.1.1.1.1.1:851", "6.1.1.1.1.1:3000", body=bytes(100)).octets()
PIECES = [decode_packet(each) for each in iter_fragments(PACKET, 3, 60)]


def endpoint(number: int) -> Endpoint:
    return Endpoint("udp", str(number))


def give_reassembly(parts: Reassembly, by: Endpoint, piece: int, now_ns: int = 0) -> bytes | None:
    header, body = PIECES[piece]
    return parts.receive(by, header, bytes(body), now_ns).packet


def test_fragments_of_two_senders_do_not_fit_together() -> None:
    parts = Reassembly()
    assert give_reassembly(parts, endpoint(1), 0) is None
    with pytest.raises(MalformedError, match="out of order"):
        give_reassembly(parts, endpoint(2), 1)
    assert parts.octets == 60
    assert give_reassembly(parts, endpoint(1), 1) == PACKET
    assert (parts.octets, parts.dropped) == (0, 1)


def test_closed_endpoints_leave_no_fragments() -> None:
    parts = Reassembly()
    give_reassembly(parts, endpoint(1), 0)
    parts.forget(endpoint(1))
    assert parts.octets == 0
    parts.forget(endpoint(1))


def test_senders_are_limited_and_the_late_ones_go_first() -> None:
    parts = Reassembly()
    late = FRAGMENT_TIMEOUT_NS + 1
    give_reassembly(parts, endpoint(0), 0)
    give_reassembly(parts, endpoint(1), 0, late)
    for number in range(2, MAX_SENDERS + 1):
        give_reassembly(parts, endpoint(number), 0, late)
    assert give_reassembly(parts, endpoint(1), 1, late) == PACKET
    give_reassembly(parts, endpoint(1), 0, late)
    give_reassembly(parts, endpoint(MAX_SENDERS + 1), 0, late)
    with pytest.raises(MalformedError):
        give_reassembly(parts, endpoint(2), 1, late)
    assert parts.octets == 60 * MAX_SENDERS - 60


def test_octets_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reassembly, "MAX_OCTETS", 100)
    parts = Reassembly()
    give_reassembly(parts, endpoint(1), 0)
    with pytest.raises(MalformedError, match="kept already"):
        give_reassembly(parts, endpoint(2), 0)
    assert (parts.octets, parts.dropped) == (60, 1)
    assert give_reassembly(parts, endpoint(1), 1) == PACKET
