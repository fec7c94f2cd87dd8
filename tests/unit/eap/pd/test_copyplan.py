from __future__ import annotations

import struct
from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.compiled import cyclic
from eap.pd import copyplan
from eap.pd.copyplan import CopyPlan, Move

SOURCE_SIZE = 24
SOURCES = st.binary(min_size=SOURCE_SIZE, max_size=SOURCE_SIZE)


def bits_of(octets: Iterable[int]) -> list[int]:
    return [octet >> bit & 1 for octet in octets for bit in range(8)]


def octets_of(bits: list[int]) -> bytes:
    return bytes(
        sum(bit << n for n, bit in enumerate(bits[at : at + 8])) for at in range(0, len(bits), 8)
    )


def copied_bit_by_bit(moves: Iterable[Move], source: bytes, target: bytes) -> bytes:
    before, after = bits_of(source), bits_of(target)
    for move in moves:
        for bit in range(move.bits):
            after[move.target_bit + bit] = before[move.source_bit + bit]
    return octets_of(after)


def copied(plan: CopyPlan, source: bytes, target: bytes) -> bytes:
    memory = bytearray(target)
    plan.run(memoryview(source), memoryview(memory))
    return bytes(memory)


@st.composite
def plans(draw: st.DrawFn) -> tuple[list[Move], int]:
    """Moves that write each bit at most once, often side by side; and the size of the target."""
    moves, end = [], draw(st.integers(0, 20))
    source = draw(st.integers(0, 20))
    for _ in range(draw(st.integers(0, 8))):
        bits = draw(st.integers(1, 70))
        if draw(st.booleans()):
            gap = draw(st.integers(0, 18))
            end += gap
            source += gap
        if draw(st.integers(0, 3)) == 0:
            source = draw(st.integers(0, 8 * SOURCE_SIZE - bits))
        if source + bits > 8 * SOURCE_SIZE:
            source = 0
        moves.append(Move(source, end, bits))
        source, end = source + bits, end + bits
    draw(st.randoms()).shuffle(moves)
    return moves, end // 8 + 2


@given(plans(), SOURCES, st.integers(0, 255))
def test_copy_plan_equals_copying_bit_by_bit(planned, source, filling):
    moves, size = planned
    target = bytes([filling]) * size
    assert copied(CopyPlan(moves), source, target) == copied_bit_by_bit(moves, source, target)


@given(plans(), SOURCES, st.integers(0, 255), st.data())
def test_bits_in_use_stay_though_others_are_copied_along(planned, source, filling, data):
    moves, size = planned
    target = bytes([filling]) * size
    written = {bit for move in moves for bit in range(move.target_bit, move.target_bit + move.bits)}
    others = sorted(set(range(8 * size)) - written)
    used = data.draw(st.sets(st.sampled_from(others))) if others else set()
    plan = CopyPlan(moves, used=[(bit, 1) for bit in sorted(used)])
    expected = bits_of(copied_bit_by_bit(moves, source, target))
    got = bits_of(copied(plan, source, target))
    assert [got[bit] for bit in sorted(used | written)] == [
        expected[bit] for bit in sorted(used | written)
    ]
    assert plan.operations <= CopyPlan(moves).operations


def test_moves_side_by_side_are_one_copy_in_whatever_order_they_come():
    moves = [Move(8 * n, 64 + 8 * n, 8) for n in (3, 0, 2, 1)] + [(32, 96, 5), (37, 101, 3)]
    assert CopyPlan(moves).operations == 1


def test_bits_of_one_octet_are_taken_in_one_step():
    plan = CopyPlan([(bit, 15 - bit, 1) for bit in range(8)])
    assert plan.operations == 1
    assert copied(plan, b"\x0b", b"\0\xff") == b"\0\xd0"


def test_copy_plan_copies_unused_padding_along():
    """Two slaves of 4 bits and one of 16, each from an octet on, then another variable's bit."""
    moves = [*(Move(bit, 80 + bit, 1) for bit in range(4)), Move(8, 88, 1), Move(16, 96, 16)]
    assert CopyPlan(moves).operations == 3
    plan = CopyPlan(moves, used=[(0, 80), (112, 1)])
    assert plan.operations == 1
    assert copied(plan, b"\x03\x01\x34\x12", bytes(15)) == bytes(10) + b"\x03\x01\x34\x12\0"
    # With a bit in use between two of them they stay apart.
    assert CopyPlan(moves, used=[(90, 1)]).operations == 3
    assert CopyPlan(moves, used=[(80, 16)]).operations == 3


def test_a_plan_may_copy_within_one_memory():
    memory = bytearray(b"\x01\x02\x03\0\0\0\0")
    CopyPlan([(0, 32, 16), (17, 24, 1)]).run(memory, memoryview(memory))
    assert memory == b"\x01\x02\x03\x01\x01\x02\0"


def test_copy_plan_without_moves_copies_nothing():
    assert copied(CopyPlan([]), b"", b"\x55") == b"\x55"
    assert CopyPlan([], used=[(0, 3)]).operations == 0


@pytest.mark.parametrize("move", [(0, 0, 0), (-1, 0, 1), (0, -1, 1)])
def test_copy_plan_rejects_invalid_moves(move):
    with pytest.raises(ValueError, match="expected at least 1 bit, from bit 0 on"):
        CopyPlan([move])


def test_a_bit_that_two_moves_write_is_refused():
    with pytest.raises(ValueError, match="write the same bit"):
        CopyPlan([(0, 0, 4), (0, 3, 4)])


@pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")
@given(plans(), SOURCES, st.integers(0, 255), st.booleans())
def test_compiled_copies_are_those_of_python(plan, source, fill, is_same):
    moves, size = plan
    compiled = CopyPlan(moves)
    assert compiled._compiled is not None or not moves
    python = CopyPlan(moves)
    python._compiled = None
    outcomes = []
    for each in (compiled, python):
        memory = bytearray(source + bytes([fill]) * max(size, SOURCE_SIZE))
        view = memoryview(memory)
        each.run(view if is_same else source, view[SOURCE_SIZE:])
        outcomes.append(bytes(memory))
    assert outcomes[0] == outcomes[1]


@pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")
@pytest.mark.parametrize(("begin", "end"), [(3, 8), (11, 8), (8, 3), (16, 8), (8, 16), (5, 8)])
def test_compiled_copy_onto_itself_reads_before_it_writes(begin, end, monkeypatch):
    outcomes = []
    for part in (cyclic, None):
        monkeypatch.setattr(copyplan, "cyclic", part)
        memory = bytearray(range(1, 40))
        CopyPlan([Move(begin, end, 200)]).run(memory, memoryview(memory))
        outcomes.append(bytes(memory))
    assert outcomes[0] == outcomes[1]


@pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")
def test_compiled_copies_stay_within_their_memory():
    plan = CopyPlan([Move(0, 0, 16), Move(17, 16, 16), Move(40, 33, 3)])
    memory = memoryview(bytearray(5))
    plan.run(bytes(6), memory)
    for source, target in ((bytes(5), memory), (bytes(6), memory[:4])):
        with pytest.raises(ValueError, match="outside"):
            plan.run(source, target)
    with pytest.raises(TypeError):
        plan.run(bytes(6), bytes(5))


@pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")
@pytest.mark.parametrize(
    ("slices", "bits", "shifted"),
    [
        (bytes(23), b"", b""),
        (b"", bytes(279), b""),
        (b"", b"", bytes(32)),
        (b"\xff" * 24, b"", b""),
    ],
)
def test_compiled_copies_that_are_none_are_refused(slices, bits, shifted):
    with pytest.raises(ValueError, match=r"cut off|outside|within a byte"):
        cyclic.Copies(slices, bits, shifted)


@pytest.mark.skipif(cyclic is None, reason="needs the compiled part: make setup")
def test_compiled_shifted_copy_reads_one_byte_more_than_it_writes():
    copies = cyclic.Copies(b"", b"", struct.pack("=4q", 0, 0, 2, 3))
    with pytest.raises(ValueError, match="outside"):
        copies.run(bytes(2), bytearray(2))
    target = bytearray(2)
    copies.run(b"\x08\x10\x07", target)
    assert target == b"\x01\xe2"
