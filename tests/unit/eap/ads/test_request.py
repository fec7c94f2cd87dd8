"""ADS requests and answers on both sides, and parts of sum commands."""

from __future__ import annotations

import struct

import pytest

from eap.ads.request import (
    AdsRefusedError,
    AdsRequest,
    DeleteNotification,
    Operation,
    OperationOutcome,
    Outcomes,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
    accept_request,
    decode_outcome,
    encode_outcome,
    encode_query,
    encode_sum,
    has_results,
    parse_request,
    part_of,
    split_answer,
)
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode
from eap.codec.ams import AmsAnswer, AmsCommand, decode_packet
from tests.support.vectors import load

G = IndexGroup
OF_ADSLIB: dict[str, list[Operation]] = {
    "read_device_info": [ReadDeviceInfo()],
    "read_state": [ReadState()],
    "write_control": [WriteControl(6, 0, b"\7\0")],
    "read": [Read(G.DATA, 16, 4)],
    "write": [Write(G.DATA, 0, bytes.fromhex("00002040"))],
    "read_by_name": [ReadWrite(G.SYMBOL_HANDLE, 0, 4, b"count\0")],
    "read_by_name_1": [Read(G.VALUE_BY_HANDLE, 0x0100_0003, 4)],
    "read_by_name_2": [Write(G.RELEASE_HANDLE, 0, bytes.fromhex("03000001"))],
    "symbol_info": [ReadWrite(G.SYMBOL_ENTRY_BY_NAME, 0, 798, b"curve\0")],
    "write_by_name": [ReadWrite(G.SYMBOL_HANDLE, 0, 4, b"name\0")],
    "write_by_name_1": [Write(G.VALUE_BY_HANDLE, 0x0100_0006, b"fan\0")],
    "write_by_name_2": [Write(G.RELEASE_HANDLE, 0, bytes.fromhex("06000001"))],
    "sum_read": [Read(G.DATA, 0, 4), Read(G.DATA, 40, 16)],
    "sum_write": [Write(G.DATA, 0, bytes.fromhex("0000a03f")), Write(G.DATA, 16, b"\5\0\0\0")],
    "add_notification": [AddNotification(G.DATA, 16, 4, TransMode.SERVER_CYCLE, 500_000, 200_000)],
    "delete_notification": [DeleteNotification(1)],
}


@pytest.mark.parametrize("vector", load("ads_requests"), ids=lambda vector: vector.name)
def test_requests_of_adslib(vector) -> None:
    header, body = decode_packet(vector.octets)
    assert (header.command, header.length) == (vector.fields["command"], vector.fields["length"])
    request = parse_request(header.command, bytes(body))
    assert list(request.operations) == OF_ADSLIB[vector.name.partition("/")[2]]


def test_every_vector_is_expected_to_be_something() -> None:
    assert {vector.name.partition("/")[2] for vector in load("ads_requests")} == set(OF_ADSLIB)


@pytest.mark.parametrize(
    ("command", "outcome", "body"),
    [
        (AmsCommand.READ_DEVICE_INFO, OperationOutcome(data=bytes(20)), bytes(24)),
        (
            AmsCommand.READ,
            OperationOutcome(data=b"abc"),
            bytes.fromhex("00000000 03000000") + b"abc",
        ),
        (AmsCommand.WRITE, OperationOutcome(), bytes(4)),
        (
            AmsCommand.READ_STATE,
            OperationOutcome(data=b"\5\0\1\0"),
            bytes.fromhex("00000000 05000100"),
        ),
        (AmsCommand.WRITE_CONTROL, OperationOutcome(AdsError.STATE), bytes.fromhex("12070000")),
        (
            AmsCommand.ADD_NOTIFICATION,
            OperationOutcome(data=b"\7\0\0\0"),
            bytes.fromhex("00000000 07000000"),
        ),
        (AmsCommand.DELETE_NOTIFICATION, OperationOutcome(), bytes(4)),
        (AmsCommand.READ_WRITE, OperationOutcome(data=b""), bytes(8)),
        (AmsCommand.READ, OperationOutcome(AdsError.BUSY), bytes.fromhex("08070000 00000000")),
        (
            AmsCommand.ADD_NOTIFICATION,
            OperationOutcome(AdsError.SIZE),
            bytes.fromhex("05070000 00000000"),
        ),
        (
            AmsCommand.READ_STATE,
            OperationOutcome(AdsError.BUSY),
            bytes.fromhex("08070000 00000000"),
        ),
    ],
)
def test_answers_of_single_operations(command: int, outcome: OperationOutcome, body: bytes) -> None:
    assert parse_request(command, bytes(40)).encode_answer([outcome]) == body


@pytest.mark.parametrize(
    ("command", "body"),
    [
        (AmsCommand.READ, bytes(11)),
        (AmsCommand.WRITE, struct.pack("<3I", 1, 2, 3) + b"ab"),
        (AmsCommand.WRITE_CONTROL, struct.pack("<2HI", 1, 2, 1)),
        (AmsCommand.ADD_NOTIFICATION, bytes(39)),
        (AmsCommand.DELETE_NOTIFICATION, bytes(3)),
        (AmsCommand.READ_WRITE, struct.pack("<4I", 1, 2, 3, 1)),
    ],
)
def test_requests_that_are_too_short(command: int, body: bytes) -> None:
    with pytest.raises(AdsRefusedError, match="SIZE"):
        parse_request(command, body)


@pytest.mark.parametrize("command", [0, AmsCommand.NOTIFICATION, AmsCommand.FRAGMENT, 0xFFFF])
def test_commands_without_body_are_parsed(command: int) -> None:
    with pytest.raises(AdsRefusedError, match="COMMAND"):
        parse_request(command, bytes(64))


def test_malformed_request_is_answered_at_once() -> None:
    assert accept_request(AmsCommand.READ, bytes(11)) == AmsAnswer(b"\5\7\0\0" + bytes(4))
    assert accept_request(0, b"") == AmsAnswer(error_code=AdsError.COMMAND)
    assert accept_request(AmsCommand.READ_STATE, b"") == parse_request(AmsCommand.READ_STATE, b"")


def test_answer_names_the_first_reasons() -> None:
    items = struct.pack("<4I", G.SUM_READ, 5, 100, 60) + bytes(60)
    outcomes = Outcomes(parse_request(AmsCommand.READ_WRITE, items))
    outcomes.add(OperationOutcome())
    for number in range(4):
        outcomes.add(OperationOutcome(AdsError.ACCESS, why=f"reason {number}"))
    assert outcomes.answer().why == "reason 0; reason 1; reason 2; and 1 more"


@pytest.mark.parametrize(
    "operation",
    [
        Read(0xF302, 0x1018_0001, 4),
        Write(0xF302, 0x6040_0000, b"\6\0"),
        ReadWrite(0xF401, 7, 4, b"firmware.bin"),
        ReadState(),
        ReadDeviceInfo(),
        WriteControl(5, 0, b"more"),
        DeleteNotification(9),
        AddNotification(3, 0x100, 2, 4, 10, 20),
    ],
)
def test_a_query_is_the_request_that_is_parsed(operation: object) -> None:
    command, body = encode_query(operation)
    assert parse_request(command, body).operations == (operation,)


@pytest.mark.parametrize("command", [AmsCommand.READ, AmsCommand.READ_STATE, AmsCommand.WRITE])
def test_an_outcome_is_the_answer_that_is_encoded(command: AmsCommand) -> None:
    for outcome in (OperationOutcome(data=b"data"), OperationOutcome(AdsError.NOT_FOUND)):
        assert decode_outcome(command, 0, encode_outcome(command, outcome)) == outcome


def test_short_answer_is_decoded_as_size_error() -> None:
    assert decode_outcome(AmsCommand.READ, 6, b"").result == AdsError.TARGET_PORT
    assert decode_outcome(AmsCommand.READ, 0, b"\0\0\0").result == AdsError.SIZE
    cut = encode_outcome(AmsCommand.READ, OperationOutcome(data=b"data"))[:-1]
    assert decode_outcome(AmsCommand.READ, 0, cut) == (AdsError.SIZE, b"", "3 bytes of 4")


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
def test_part_of_sum_requests_the_chosen_items(
    group: int, operations: tuple[Operation, ...]
) -> None:
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
def test_short_answer_to_sum_is_not_split(body: bytes) -> None:
    assert split_answer(sum_of(G.SUM_READ_EX_2, READS), body) is None


def test_a_sum_read_without_a_count_has_no_results() -> None:
    assert has_results(sum_of(G.SUM_READ, READS))
    assert not has_results(sum_of(G.SUM_READ, READS)._replace(index_offset=0))
    assert not has_results(AdsRequest(AmsCommand.READ, (READS[0],)))


def test_refusal_says_its_result() -> None:
    assert str(AdsRefusedError(AdsError.SIZE)) == "SIZE"
    assert str(AdsRefusedError(AdsError.SIZE, "too long")) == "SIZE: too long"
    assert OperationOutcome() == (AdsError.NONE, b"", "")
