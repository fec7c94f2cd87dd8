"""Operations as requests, and answers as outcomes."""

from __future__ import annotations

import pytest

from eap.ads.operation import (
    DeleteNotification,
    OperationOutcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.ads.request import decode_outcome, encode_outcome, encode_query, parse_request
from eap.codec.ads import AdsError
from eap.codec.adsnotification import AddNotification
from eap.codec.ams import AmsCommand


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


def test_what_is_no_answer() -> None:
    assert decode_outcome(AmsCommand.READ, 6, b"").result == AdsError.TARGET_PORT
    assert decode_outcome(AmsCommand.READ, 0, b"\0\0\0").result == AdsError.SIZE
    cut = encode_outcome(AmsCommand.READ, OperationOutcome(data=b"data"))[:-1]
    assert decode_outcome(AmsCommand.READ, 0, cut) == (AdsError.SIZE, b"", "3 octets of 4")
