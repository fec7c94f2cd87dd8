from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.mailbox.eoe_fragment import MAX_FRAME, Assembler, iter_fragments
from eap.codec.eoe import EoeHeader, FragmentWord
from eap.errors import CodecError
from tests.support.vectors import load

CAPTURED = [vector.octets[6:] for vector in load("eoe_mailbox")][2:]
FRAME = bytes(range(100))


def fragments(frame: bytes = FRAME, number: int = 0, room: int = 40) -> list[bytes]:
    return list(iter_fragments(frame, number, room))


def receive(assembler: Assembler, *messages: bytes) -> list[bytes]:
    found = [assembler.receive(message) for message in messages]
    return [frame for frame in found if frame is not None]


@pytest.mark.parametrize("number", range(4))
def test_captured_frame_is_read_and_written_again(number: int) -> None:
    (frame,) = receive(Assembler(), CAPTURED[number])
    assert frame == CAPTURED[number][4:]
    assert fragments(frame, number, 1014) == [CAPTURED[number]]


def test_fragments_lie_as_on_the_wire() -> None:
    words = [message[:4].hex(" ") for message in fragments(number=5, room=40)]
    assert words == ["00 00 00 51", "00 00 41 50", "00 00 82 50", "00 01 c3 50"]
    assert [len(message) - 4 for message in fragments(room=70)] == [64, 36]


@given(st.binary(min_size=1, max_size=MAX_FRAME), st.integers(32, 1600), st.integers(0, 15))
def test_round_trip(frame: bytes, room: int, number: int) -> None:
    messages = fragments(frame, number, room)
    assert all(len(message) <= room + 4 for message in messages)
    assert receive(Assembler(), *messages) == [frame]


def test_short_frame_fits_a_small_mailbox() -> None:
    assert receive(Assembler(), *fragments(b"short", room=6)) == [b"short"]


@pytest.mark.parametrize(
    ("frame", "room", "reason"),
    [
        (b"", 100, "a frame of 0 octets"),
        (bytes(MAX_FRAME + 1), 100, "a frame of 1523 octets"),
        (bytes(40), 31, "room for 31 octets"),
    ],
)
def test_frame_that_cannot_be_sent(frame: bytes, room: int, reason: str) -> None:
    with pytest.raises(CodecError, match=reason):
        fragments(frame, room=room)


def test_time_behind_a_frame_is_no_part_of_it() -> None:
    header = EoeHeader(0, last=1, time_appended=1).encode() + FragmentWord(0, 1, 0).encode()
    assert receive(Assembler(), header + b"frame" + b"time") == [b"frame"]
    with pytest.raises(CodecError, match="no room for the time"):
        Assembler().receive(header + b"tim")


@pytest.mark.parametrize("missing", range(4))
def test_frame_with_a_missing_fragment_is_dropped(missing: int) -> None:
    assembler = Assembler()
    messages = fragments()
    del messages[missing]
    assert receive(assembler, *messages, *fragments(number=1)) == [FRAME]
    assert assembler.dropped == 1


def test_fragments_of_two_frames_do_not_mix() -> None:
    assembler = Assembler()
    assert receive(assembler, *fragments()[:2], *fragments(number=1)[2:]) == []
    assert assembler.dropped == 2


def test_offset_that_does_not_fit_drops_the_frame() -> None:
    assembler = Assembler()
    first, second = fragments(bytes(64), room=32)
    wrong = second[:2] + FragmentWord(1, 2, 0).encode() + second[4:]
    assert receive(assembler, first, wrong) == []
    assert assembler.dropped == 1


def test_reset_forgets_the_frame_under_way() -> None:
    assembler = Assembler()
    first, last = fragments(bytes(64), room=32)
    assembler.receive(first)
    assembler.reset()
    assert receive(assembler, last) == []


@given(st.lists(st.binary(min_size=4, max_size=700), max_size=20))
def test_any_fragments_give_frames_or_codec_error(noise: list[bytes]) -> None:
    assembler = Assembler()
    for octets in noise:
        message = bytes((0, octets[1])) + octets[2:]
        try:
            frame = assembler.receive(message)
        except CodecError:
            continue
        assert frame is None or len(frame) <= MAX_FRAME
