from __future__ import annotations

import struct

import pytest

from eap.ads.operation import (
    DeleteNotification,
    Operation,
    OperationOutcome,
    Read,
    ReadWrite,
    Write,
)
from eap.ads.request import (
    AdsRequest,
    encode_sum,
    has_results,
    parse_request,
    part_of,
    split_answer,
)
from eap.codec.ads import IndexGroup
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import AmsCommand

G = IndexGroup
READS = (Read(1, 2, 2), Read(3, 4, 1), Read(5, 6, 4))
WRITES = (Write(1, 2, b"ab"), Write(3, 4, b""), Write(5, 6, b"cde"))
BOTH = (ReadWrite(1, 2, 3, b"ab"), ReadWrite(3, 4, 0, b""), ReadWrite(5, 6, 1, b"c"))
ADDS = tuple(AddNotification(1, number, 2, 4, 0, 0) for number in range(3))
DELETES = tuple(map(DeleteNotification, (7, 8, 9)))
SUMS: dict[int, tuple[Operation, ...]] = {
    G.SUM_READ: READS,
    G.SUM_WRITE: WRITES,
    G.SUM_READ_WRITE: BOTH,
    G.SUM_READ_EX: READS,
    G.SUM_READ_EX_2: READS,
    G.SUM_ADD_NOTIFICATION: ADDS,
    G.SUM_DELETE_NOTIFICATION: DELETES,
}


def sum_of(group: int, operations: tuple[Operation, ...]) -> AdsRequest:
    return AdsRequest(AmsCommand.READ_WRITE, operations, group, 1000, len(operations))


@pytest.mark.parametrize(("group", "operations"), SUMS.items())
def test_a_part_asks_for_the_chosen_items(group: int, operations: tuple[Operation, ...]) -> None:
    whole = sum_of(group, operations)
    assert parse_request(AmsCommand.READ_WRITE, encode_sum(whole)) == whole
    part = part_of(whole, operations[::2])
    assert parse_request(AmsCommand.READ_WRITE, encode_sum(part)) == sum_of(group, operations[::2])


@pytest.mark.parametrize(
    ("group", "datas"),
    [
        (G.SUM_READ, (b"xy", b"\0", b"abcd")),
        (G.SUM_READ_EX, (b"xy", b"\0", b"abcd")),
        (G.SUM_READ_EX_2, (b"x", b"", b"abcd")),
        (G.SUM_READ_WRITE, (b"xyz", b"", b"a")),
        (G.SUM_WRITE, (b"", b"", b"")),
        (G.SUM_DELETE_NOTIFICATION, (b"", b"", b"")),
        (G.SUM_ADD_NOTIFICATION, (b"\1\0\0\0", bytes(4), b"\2\0\0\0")),
    ],
)
def test_an_answer_is_split_as_it_is_made(group: int, datas: tuple[bytes, ...]) -> None:
    request = sum_of(group, SUMS[group])
    outcomes = [
        OperationOutcome(0x702 if number == 1 else 0, data) for number, data in enumerate(datas)
    ]
    assert split_answer(request, request.encode_answer(outcomes)) == outcomes


@pytest.mark.parametrize(
    "body",
    [
        b"",
        struct.pack("<II", 0x705, 12) + bytes(12),
        struct.pack("<II", 0, 8) + bytes(8),
        struct.pack("<II6I", 0, 24, 0, 1, 0, 0, 0, 0),
    ],
)
def test_what_is_no_answer_to_all_items_is_not_split(body: bytes) -> None:
    assert split_answer(sum_of(G.SUM_READ_EX_2, READS), body) is None


def test_a_sum_read_without_a_count_has_no_results() -> None:
    assert has_results(sum_of(G.SUM_READ, READS))
    assert not has_results(sum_of(G.SUM_READ, READS)._replace(index_offset=0))
    assert not has_results(AdsRequest(AmsCommand.READ, (READS[0],)))
