"""Frames of a cycle: packing, patching, and which replies are theirs."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.master.cyclicframe import (
    MAX_BODY,
    MAX_DATAGRAMS,
    PreparedFrame,
    encode_datagrams,
    prepare_frames,
)
from devicebus.wire.datagram import OVERHEAD, Command, brd, fprd, frmw, iter_datagrams, logical
from tests.support.busline import accesses_of, answer

LRW = logical(Command.LRW, 0x10000, b"\1\2\3")
TIME = frmw(1001, 0x910, 8)


def test_frame_has_the_index_in_each_datagram():
    frame = PreparedFrame([LRW, TIME])
    found = list(iter_datagrams(frame.encode(200)))
    assert [each.header.index for each in found] == [200, 200]
    assert [each.header.more for each in found] == [1, 0]
    assert [bytes(each.data) for each in found] == [b"\1\2\3", bytes(8)]
    assert frame.size == len(frame.encode(0)) == 2 + 2 * OVERHEAD + 3 + 8


def test_frame_takes_other_datagrams_along():
    frame = PreparedFrame([LRW])
    octets = frame.encode(7, encode_datagrams([fprd(1, 0x130, 2), fprd(2, 0x130, 2)], 7))
    assert [each.command for each in accesses_of(octets)] == [Command.LRW] + 2 * [Command.FPRD]
    assert accesses_of(frame.encode(8))[0].command is Command.LRW
    assert len(frame.encode(8)) == frame.size


def test_frame_carries_what_its_owner_writes():
    frame = PreparedFrame([LRW, TIME])
    (start, end), _ = frame.places
    frame.octets[start:end] = b"abc"
    assert accesses_of(frame.encode(1))[0].data == b"abc"


@pytest.mark.parametrize("changes", [
    {2: 11}, {3: 8}, {4: 1}, {5: 1}, {6: 2}, {7: 2}, {8: 4}, {9: 1}, {1: 0x40}, {17: 13}, {19: 0},
])  # fmt: skip
def test_frame_with_another_header_is_not_ours(changes):
    frame = PreparedFrame([LRW, TIME])
    octets = bytearray(answer(frame.encode(7), wkc=5))
    assert frame.matches(octets, 7)
    for at, value in changes.items():
        octets[at] = value
    assert not frame.matches(octets, 7)


def test_frame_matches_whatever_slaves_change():
    frame = PreparedFrame([brd(0x130, 2), LRW])
    octets = bytearray(answer(frame.encode(7), wkc=0xFFFF))
    octets[4:6] = b"\x10\0"  # ADP of a broadcast
    octets[9] |= 0x40  # circulating
    octets[10:12] = b"\xff\xff"  # event bits
    assert frame.matches(octets + b"padding", 7)
    assert not frame.matches(octets, 8)
    assert not frame.matches(octets[:-1], 7)


@given(st.binary(max_size=60))
def test_any_bytes_are_compared_without_an_error(data):
    assert PreparedFrame([LRW]).matches(data, 0) in {True, False}


@given(st.lists(st.integers(1, MAX_BODY - OVERHEAD), max_size=40))
def test_frames_hold_all_datagrams_in_their_order(sizes):
    requests = [logical(Command.LRD, n, bytes(size)) for n, size in enumerate(sizes)]
    frames = prepare_frames(requests)
    found = [each for frame in frames for each in accesses_of(frame.encode(0))]
    assert [each.adp for each in found] == list(range(len(sizes)))
    assert all(frame.size <= 2 + MAX_BODY for frame in frames)
    assert all(len(frame.places) <= MAX_DATAGRAMS for frame in frames)
