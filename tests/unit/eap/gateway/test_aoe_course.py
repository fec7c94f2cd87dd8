"""Packets in fragments, as our own side of a slave and of a master make them."""

from __future__ import annotations

import msgspec
import pytest

from eap.aoe.answer import AmsAnswer, response_to
from eap.aoe.fragment import iter_fragments
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags, decode_packet, encode_packet
from eap.gateway.aoe_course import AoeCourse
from eap.ids import NetId

HEADER = AmsHeader(
    NetId.parse("1.2.3.4.5.6"), 1001, NetId.parse("6.5.4.3.2.1"), 1, AmsCommand.READ,
    StateFlags.ADS, invoke_id=7,
)  # fmt: skip
REQUEST = encode_packet(HEADER, bytes(12))
ANSWER = response_to(HEADER, AmsAnswer(bytes(range(20))))


def acknowledged(packet: bytes, room: int) -> list[bytes]:
    """Return fragments whose sender waits for acknowledgements."""
    fragments = []
    for each in iter_fragments(packet, 5, room):
        flags = int.from_bytes(each[18:20], "little") & ~StateFlags.NO_RETURN
        fragments.append(each[:18] + flags.to_bytes(2, "little") + each[20:])
    return fragments


def acknowledgement(fragment: bytes) -> bytes:
    header, _ = decode_packet(fragment)
    return response_to(header, AmsAnswer())


def test_a_packet_in_one_piece() -> None:
    course = AoeCourse()
    assert course.ask(REQUEST)
    course.answer(ANSWER)
    assert (course.is_running, course.has_more, course.whole) == (False, False, b"")
    assert not course.ask(encode_packet(msgspec.structs.replace(HEADER, state_flags=6), bytes(12)))
    assert course.ask(b"short")


@pytest.mark.parametrize("wants", [False, True])
def test_the_last_fragment_of_a_request_is_what_is_answered(wants) -> None:
    course = AoeCourse()
    *first, last = acknowledged(REQUEST, 10) if wants else iter_fragments(REQUEST, 5, 10)
    assert len(first) == 2
    for fragment in first:
        assert course.ask(fragment) is wants
        if wants:
            course.answer(acknowledgement(fragment))
        assert course.is_running
        assert not course.whole
    assert course.ask(last)
    assert course.whole == REQUEST[: AmsHeader.SIZE]
    course.answer(ANSWER)
    assert not course.is_running


def test_fragments_of_an_answer_come_by_themselves() -> None:
    course = AoeCourse()
    course.ask(REQUEST)
    more = []
    for fragment in iter_fragments(ANSWER, 9, 15):
        course.answer(fragment)
        more.append(course.has_more)
    assert more == [True, True, False]
    assert not course.is_running


def test_fragments_of_an_answer_that_are_to_be_acknowledged() -> None:
    course = AoeCourse()
    course.ask(REQUEST)
    first, second, last = acknowledged(ANSWER, 15)
    for fragment in (first, second):
        course.answer(fragment)
        assert (course.is_running, course.has_more) == (True, False)
        assert course.ask(acknowledgement(fragment)), "the next one comes then"
    course.answer(last)
    assert not course.is_running
    assert not course.ask(acknowledgement(second)), "nothing comes any more"
    assert not course.is_step(REQUEST)
