"""Sum commands, by way of the requests that they are."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ads.request import (
    MAX_ANSWER,
    MAX_ITEMS,
    AdsRefusedError,
    DeleteNotification,
    OperationOutcome,
    Outcomes,
    Read,
    ReadWrite,
    Write,
    encode_refusal,
    parse_request,
)
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode
from eap.codec.ams import AmsCommand

G = IndexGroup
NOTE = AddNotification(G.DATA, 0, 4, TransMode.SERVER_ON_CHANGE, 0, 10_000)


def read_write(group: int, offset: int, length: int, data: bytes) -> bytes:
    return struct.pack("<4I", group, offset, length, len(data)) + data


def parse_sum(group: int, items: list[bytes], behind: bytes = b"", *, room: int = 1000):
    return parse_request(
        AmsCommand.READ_WRITE, read_write(group, len(items), room, b"".join(items) + behind)
    )


def reads(*lengths: int) -> list[bytes]:
    return [struct.pack("<3I", G.DATA, n, length) for n, length in enumerate(lengths)]


def body_of(answer: bytes) -> bytes:
    """Of the answer to a ReadWrite that was not refused."""
    assert answer[:4] == bytes(4)
    assert int.from_bytes(answer[4:8], "little") == len(answer) - 8
    return answer[8:]


def test_sum_read_pads_what_could_not_be_read() -> None:
    request = parse_sum(G.SUM_READ, reads(2, 3, 1))
    assert request.operations == (Read(G.DATA, 0, 2), Read(G.DATA, 1, 3), Read(G.DATA, 2, 1))
    outcomes = [
        OperationOutcome(data=b"ab"),
        OperationOutcome(AdsError.INDEX_OFFSET),
        OperationOutcome(data=b"c"),
    ]
    assert body_of(request.encode_answer(outcomes)) == (
        bytes.fromhex("00000000 03070000 00000000") + b"ab\0\0\0c"
    )


def test_sum_read_without_a_count_has_no_results_of_its_own() -> None:
    data = b"".join(reads(2, 3))
    request = parse_request(AmsCommand.READ_WRITE, read_write(G.SUM_READ, 0, 5, data))
    assert len(request.operations) == 2
    good = [OperationOutcome(data=b"ab"), OperationOutcome(data=b"cde")]
    assert body_of(request.encode_answer(good)) == b"abcde"
    bad = [OperationOutcome(data=b"ab"), OperationOutcome(AdsError.BUSY)]
    assert request.encode_answer(bad) == struct.pack("<II", AdsError.BUSY, 5) + b"ab\0\0\0"


def test_sum_write_takes_the_data_from_behind_the_list() -> None:
    items = [struct.pack("<3I", G.DATA, 0, 2), struct.pack("<3I", G.DATA, 8, 1)]
    request = parse_sum(G.SUM_WRITE, items, b"abc")
    assert request.operations == (Write(G.DATA, 0, b"ab"), Write(G.DATA, 8, b"c"))
    answer = request.encode_answer([OperationOutcome(AdsError.ACCESS), OperationOutcome()])
    assert body_of(answer) == bytes.fromhex("04070000 00000000")


def test_sum_read_write_returns_lengths() -> None:
    items = [struct.pack("<4I", G.SYMBOL_HANDLE, 0, 4, 2), struct.pack("<4I", G.DATA, 8, 9, 1)]
    request = parse_sum(G.SUM_READ_WRITE, items, b"abc")
    assert request.operations == (
        ReadWrite(G.SYMBOL_HANDLE, 0, 4, b"ab"),
        ReadWrite(G.DATA, 8, 9, b"c"),
    )
    answer = request.encode_answer(
        [OperationOutcome(data=b"1234"), OperationOutcome(AdsError.ACCESS)]
    )
    assert body_of(answer) == bytes.fromhex("00000000 04000000 04070000 00000000") + b"1234"


def test_the_two_extended_reads_differ_in_their_padding() -> None:
    outcomes = [OperationOutcome(data=b"a"), OperationOutcome(AdsError.BUSY)]
    asked = parse_sum(G.SUM_READ_EX, reads(2, 1)).encode_answer(outcomes)
    assert body_of(asked) == bytes.fromhex("00000000 02000000 08070000 01000000") + b"a\0\0"
    returned = parse_sum(G.SUM_READ_EX_2, reads(2, 1)).encode_answer(outcomes)
    assert body_of(returned) == bytes.fromhex("00000000 01000000 08070000 00000000") + b"a"


def test_sums_of_notifications() -> None:
    request = parse_sum(G.SUM_ADD_NOTIFICATION, [NOTE.encode(), NOTE.encode()])
    assert request.operations == (NOTE, NOTE)
    answer = request.encode_answer(
        [OperationOutcome(data=b"\7\0\0\0"), OperationOutcome(AdsError.SIZE)]
    )
    assert body_of(answer) == bytes.fromhex("00000000 07000000 05070000 00000000")
    request = parse_sum(G.SUM_DELETE_NOTIFICATION, [b"\1\0\0\0", b"\2\0\0\0"])
    assert request.operations == (DeleteNotification(1), DeleteNotification(2))
    answer = request.encode_answer(
        [OperationOutcome(), OperationOutcome(AdsError.NOTIFICATION_HANDLE)]
    )
    assert body_of(answer) == bytes.fromhex("00000000 14070000")


def test_sum_commands_do_not_nest() -> None:
    items = [struct.pack("<4I", G.SUM_READ, 1, 100, 12)]
    request = parse_sum(G.SUM_READ_WRITE, items, reads(4)[0])
    assert request.operations == (ReadWrite(G.SUM_READ, 1, 100, reads(4)[0]),)


def test_sum_answer_longer_than_read_length_is_refused() -> None:
    request = parse_sum(G.SUM_READ, reads(4), room=7)
    answer = request.encode_answer([OperationOutcome(data=b"abcd")])
    assert answer == struct.pack("<II", AdsError.SIZE, 0)


@pytest.mark.parametrize("group", [G.SUM_READ, G.SUM_WRITE, G.SUM_READ_EX_2])
def test_sum_with_too_many_items_is_refused(group: int) -> None:
    with pytest.raises(AdsRefusedError, match="NO_MEMORY"):
        parse_sum(group, reads(*[0] * (MAX_ITEMS + 1)))
    assert len(parse_sum(group, reads(*[0] * MAX_ITEMS)).operations) == MAX_ITEMS


@pytest.mark.parametrize("group", [G.SUM_READ, G.SUM_READ_EX])
def test_sum_that_exceeds_the_answer_is_refused(group: int) -> None:
    with pytest.raises(AdsRefusedError, match="NO_MEMORY"):
        parse_sum(group, reads(MAX_ANSWER - 8, 1))
    assert parse_sum(group, reads(MAX_ANSWER - 8)).operations


@pytest.mark.parametrize(
    ("group", "items", "behind"),
    [
        (G.SUM_WRITE, [struct.pack("<3I", 1, 2, 5)], b"four"),
        (G.SUM_WRITE, [struct.pack("<3I", 1, 2, 0xFFFF_FFFF)], b"four"),
        (G.SUM_READ_WRITE, [struct.pack("<4I", 1, 2, 3, 5)], b"four"),
        (G.SUM_READ, [b"short"], b""),
        (G.SUM_ADD_NOTIFICATION, [NOTE.encode()[:-1]], b""),
        (G.SUM_DELETE_NOTIFICATION, [b"abc"], b""),
    ],
)
def test_sums_that_are_too_short(group: int, items: list[bytes], behind: bytes) -> None:
    with pytest.raises(AdsRefusedError, match="SIZE"):
        parse_sum(group, items, behind)


@given(
    st.sampled_from(list(AmsCommand)),
    st.binary(max_size=80),
    st.sampled_from([0, *range(0xF080, 0xF087)]),
    st.integers(0, 5),
)
def test_anything_is_taken_apart_or_refused(command, noise: bytes, group: int, count: int) -> None:
    body = read_write(group, count, 1 << 20, noise) if group else noise
    try:
        request = parse_request(command, body)
    except AdsRefusedError as exc:
        answer = encode_refusal(command, exc.result)
    else:
        outcomes = [OperationOutcome(AdsError.BUSY)] * len(request.operations)
        answer = request.encode_answer(outcomes)
    assert 4 <= len(answer) <= MAX_ANSWER + 8


@pytest.mark.parametrize("group", [G.SUM_READ_WRITE, G.SUM_READ_EX_2])
def test_where_lengths_come_back_only_what_was_read_counts(group: int) -> None:
    form = "<4I" if group == G.SUM_READ_WRITE else "<3I"
    items = [struct.pack("<4I", G.DATA, 0, 0xFFFF_FFFF, 0)[: struct.calcsize(form)]] * 3
    request = parse_sum(group, items, room=0xFFFF_FFFF)
    outcomes = Outcomes(request)
    outcomes.add(OperationOutcome(data=b"ab"))
    outcomes.add(OperationOutcome(data=bytes(MAX_ANSWER - 25)))
    outcomes.add(OperationOutcome(data=bytes(MAX_ANSWER - 26)))
    body = body_of(outcomes.answer().data)
    assert len(body) == MAX_ANSWER
    heads = struct.unpack_from("<6I", body)
    assert heads == (0, 2, AdsError.NO_MEMORY, 0, 0, MAX_ANSWER - 26)


def test_there_is_an_end_to_the_number_of_items() -> None:
    items = [bytes(4)] * (MAX_ANSWER // 8 + 1)
    with pytest.raises(AdsRefusedError, match="NO_MEMORY"):
        parse_sum(G.SUM_DELETE_NOTIFICATION, items)
