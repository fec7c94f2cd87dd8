from __future__ import annotations

import struct

import pytest

from eap.ads.endpoint import AmsAnswer
from eap.ads.operation import (
    AdsRefusedError,
    DeleteNotification,
    Operation,
    OperationOutcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.ads.request import Outcomes, accept_request, parse_request
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsnotification import AddNotification, TransMode
from eap.codec.ams import AmsCommand, decode_packet
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
def test_commands_that_ask_for_nothing(command: int) -> None:
    with pytest.raises(AdsRefusedError, match="COMMAND"):
        parse_request(command, bytes(64))


def test_what_is_no_request_is_answered_at_once() -> None:
    assert accept_request(AmsCommand.READ, bytes(11)) == AmsAnswer(b"\5\7\0\0" + bytes(4))
    assert accept_request(0, b"") == AmsAnswer(error_code=AdsError.COMMAND)
    assert accept_request(AmsCommand.READ_STATE, b"") == parse_request(AmsCommand.READ_STATE, b"")


def test_the_first_reasons_are_told() -> None:
    items = struct.pack("<4I", G.SUM_READ, 5, 100, 60) + bytes(60)
    outcomes = Outcomes(parse_request(AmsCommand.READ_WRITE, items))
    outcomes.add(OperationOutcome())
    for number in range(4):
        outcomes.add(OperationOutcome(AdsError.ACCESS, why=f"reason {number}"))
    assert outcomes.answer().why == "reason 0; reason 1; reason 2; and 1 more"
