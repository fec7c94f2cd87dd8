"""Pending requests and subscriptions of a connection."""

from __future__ import annotations

import struct

from hypothesis import given
from hypothesis import strategies as st

from eap.services.transports.ams_connection import (
    MAX_OCTETS,
    MAX_REQUESTS,
    AmsWindow,
    SubscriptionCounter,
)
from tests.support import aoe

TARGET = "1.1.1.1.2.1"


def request(body: bytes = b"", command: int = aoe.READ_STATE, flags: int = 4) -> bytes:
    return aoe.packet(TARGET, command, body, flags=flags)


def answer(body: bytes = b"", command: int = aoe.READ_STATE) -> bytes:
    return request(body, command, 5)


def test_too_many_requests_fill_it_and_an_answer_makes_room() -> None:
    window = AmsWindow()
    for _ in range(MAX_REQUESTS):
        assert not window.is_full
        assert not window.note_incoming(request())
    assert window.is_full
    assert window.note_outgoing(answer())
    assert not window.is_full


def test_long_requests_fill_it_and_so_do_those_for_long_answers() -> None:
    for packet in (request(bytes(MAX_OCTETS)), request(aoe.read_body(0, 1 << 31), aoe.READ)):
        window = AmsWindow()
        window.note_incoming(packet)
        assert window.is_full
        window.note_outgoing(answer())
        assert not window.is_full


def test_window_ignores_packets_without_answer() -> None:
    window = AmsWindow()
    window.note_incoming(request(flags=4 | 2))
    window.note_incoming(request(command=8))
    window.note_incoming(request(command=0x0902))
    assert window.note_incoming(answer())
    assert window.requests == 0
    assert not window.note_outgoing(answer(command=0x0902))
    assert not window.note_outgoing(request())
    assert not window.note_outgoing(answer())
    assert window.requests == 0


def test_read_without_a_length_is_a_short_one() -> None:
    window = AmsWindow()
    window.note_incoming(request(struct.pack("<I", 1), aoe.READ))
    assert not window.is_full


@given(st.lists(st.integers(0, 70_000), max_size=30))
def test_nothing_is_left_when_all_have_been_answered(sizes: list[int]) -> None:
    window = AmsWindow()
    for size in sizes:
        window.note_incoming(request(bytes(size)))
    for _ in sizes:
        window.note_outgoing(answer())
    assert (window.requests, window._octets) == (0, 0)


def granted(command: int, result: int = 0) -> bytes:
    return answer(struct.pack("<II", result, 7), command)


def test_window_counts_subscriptions_until_they_are_ended() -> None:
    window = AmsWindow()
    seen = []
    for packet in (granted(6), granted(6), granted(6, 0x701), granted(7), granted(7), granted(7)):
        window.note_incoming(request(command=packet[16]))
        window.note_outgoing(packet)
        seen.append(window.subscriptions.count)
    assert seen == [1, 2, 2, 1, 0, 0]


def sum_request(group: int, count: int, invoke_id: int = 1) -> bytes:
    body = struct.pack("<IIII", group, count, 8, 40)
    return aoe.packet(TARGET, 9, body, invoke_id=invoke_id)


def sum_answer(request: bytes, items: bytes, result: int = 0) -> bytes:
    head = request[8:16] + request[:8] + struct.pack("<HHI", 9, 5, 8 + len(items))
    return head + bytes(4) + request[28:32] + struct.pack("<II", result, len(items)) + items


def test_window_counts_subscriptions_of_a_sum_command_until_they_are_ended() -> None:
    window = AmsWindow()
    seen = []
    for invoke_id, (group, items, result) in enumerate(
        (
            (0xF085, struct.pack("<6I", 0, 7, 0x701, 0, 0, 8), 0),
            (0xF085, struct.pack("<2I", 0, 9), 0x705),
            (0xF086, struct.pack("<2I", 0, 0x714), 0),
            (0xF080, bytes(8), 0),
            (0xF086, bytes(4), 0),
            (0xF086, bytes(4), 0),
        )
    ):
        request = sum_request(group, 3, invoke_id)
        window.note_incoming(request)
        window.note_outgoing(sum_answer(request, items, result))
        seen.append(window.subscriptions.count)
    assert seen == [2, 2, 1, 1, 0, 0]


def test_counter_ignores_answers_to_other_requests() -> None:
    counter = SubscriptionCounter()
    request = sum_request(0xF085, 1)
    counter.note_request(request)
    counter.note_request(request[:40])
    counter.note_answer(sum_answer(sum_request(0xF085, 1, invoke_id=2), bytes(8)))
    assert counter.count == 0
    counter.note_answer(sum_answer(request, bytes(8)))
    counter.note_answer(sum_answer(request, bytes(8)))
    assert counter.count == 1


def test_counter_ignores_notifications_that_are_refused() -> None:
    counter = SubscriptionCounter()
    for packet in (granted(6, 0x701), granted(7), answer(command=9)):
        counter.note_answer(packet)
    assert counter.count == 0
