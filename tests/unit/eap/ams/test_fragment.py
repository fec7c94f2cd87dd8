"""AMS packets cut in pieces and put together again, or not."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.reassembly import (
    FRAGMENT_TIMEOUT_NS,
    MAX_LENGTH,
    MAX_PACKETS,
    FragmentAssembler,
    iter_fragments,
)
from eap.codec.ams import AmsCommand, AmsHeader, decode_packet, encode_packet
from eap.errors import MalformedError
from eap.ids import NetId

HEADER = AmsHeader(NetId(b"target"), 1001, NetId(b"source"), 33000, 2, invoke_id=77)


def give(assembler, fragment, now_ns=0):
    header, body = decode_packet(fragment)
    return assembler.receive(header, bytes(body), now_ns)


@given(st.binary(max_size=500), st.integers(1, 200), st.integers(0, 0xFFFF))
def test_packet_comes_out_as_it_went_in(body, room, number):
    packet = encode_packet(HEADER, body)
    assembler = FragmentAssembler()
    fragments = list(iter_fragments(packet, number, room))
    taken = [give(assembler, each) for each in fragments]
    assert [each.packet for each in taken] == [None] * (len(taken) - 1) + [packet]
    assert assembler.dropped == 0
    for count, each in enumerate(fragments):
        header, _ = decode_packet(each)
        assert (header.command, header.invoke_id) == (AmsCommand.FRAGMENT, number << 16 | count)
        assert (header.target, header.source_port) == (HEADER.target, HEADER.source_port)


def test_packets_of_several_senders_mix():
    assembler = FragmentAssembler()
    packets = [
        encode_packet(msgspec.structs.replace(HEADER, source_port=port), bytes(100))
        for port in (1, 2)
    ]
    cut = [list(iter_fragments(packet, 9, 60)) for packet in packets]
    ends = [give(assembler, each).packet for pair in zip(*cut, strict=True) for each in pair]
    assert ends == [None, None, *packets]


def test_missing_fragment_drops_the_packet():
    assembler = FragmentAssembler()
    first, _, third = iter_fragments(encode_packet(HEADER, bytes(50)), 1, 25)
    give(assembler, first)
    with pytest.raises(MalformedError, match="out of order"):
        give(assembler, third)
    assert assembler.dropped == 1
    with pytest.raises(MalformedError):
        give(assembler, third)


def test_late_fragment_drops_the_packet():
    assembler = FragmentAssembler()
    first, second = iter_fragments(encode_packet(HEADER, bytes(20)), 1, 20)
    give(assembler, first, 0)
    with pytest.raises(MalformedError):
        give(assembler, second, FRAGMENT_TIMEOUT_NS + 1)


def test_new_start_takes_the_place_of_the_old():
    assembler = FragmentAssembler()
    packet = encode_packet(HEADER, bytes(20))
    first, second = iter_fragments(packet, 1, 20)
    give(assembler, first)
    give(assembler, first)
    assert give(assembler, second).packet == packet
    assert assembler.dropped == 1


def test_only_so_many_packets_are_kept():
    assembler = FragmentAssembler()
    cut = [list(iter_fragments(encode_packet(HEADER, bytes(20)), n, 20)) for n in range(9)]
    for first, _ in cut:
        give(assembler, first)
    with pytest.raises(MalformedError):
        give(assembler, cut[0][1])
    assert give(assembler, cut[MAX_PACKETS][1]).packet is not None


@pytest.mark.parametrize("length", [3, MAX_LENGTH + 1])
def test_length_that_cannot_be_drops_the_packet(length):
    assembler = FragmentAssembler()
    fragment = bytearray(next(iter_fragments(encode_packet(HEADER, bytes(20)), 1, 36)))
    fragment[36:40] = length.to_bytes(4, "little")
    with pytest.raises(MalformedError, match="too long"):
        give(assembler, bytes(fragment))


def test_forgotten_packets_do_not_go_on():
    assembler = FragmentAssembler()
    first, second = iter_fragments(encode_packet(HEADER, bytes(20)), 1, 20)
    give(assembler, first)
    assembler.reset()
    with pytest.raises(MalformedError):
        give(assembler, second)
