from __future__ import annotations

import pytest

from eap.aoe.ads_operation import (
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
    is_change,
)
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsnotification import AddNotification


@pytest.mark.parametrize(
    ("operation", "changes"),
    [
        (ReadDeviceInfo(), False),
        (ReadState(), False),
        (Read(IndexGroup.SDO, 0, 4), False),
        (Write(IndexGroup.SDO, 0, b""), True),
        (Write(IndexGroup.RELEASE_HANDLE, 0, bytes(4)), False),
        (ReadWrite(IndexGroup.SYMBOL_HANDLE, 0, 4, b"x"), False),
        (ReadWrite(IndexGroup.VALUE_BY_NAME, 0, 4, b"x"), False),
        (ReadWrite(IndexGroup.RAW_COMMAND, 0, 16, bytes(16)), True),
        (ReadWrite(IndexGroup.SUM_READ, 0, 16, bytes(16)), True),
        (ReadWrite(IndexGroup.FOE_OPEN_READ, 0, 4, b"x"), False),
        (ReadWrite(IndexGroup.FOE_OPEN_WRITE, 0, 4, b"x"), True),
        (ReadWrite(IndexGroup.FOE_CLOSE, 1, 0, b""), False),
        (Write(IndexGroup.FOE_CLOSE, 1, b""), False),
        (ReadWrite(IndexGroup.FOE_WRITE, 1, 0, b"x"), True),
        (WriteControl(5, 0, b""), True),
        (AddNotification(1, 2, 3, 4, 5, 6), False),
        (DeleteNotification(1), False),
    ],
)
def test_what_counts_as_a_change(operation: Operation, *, changes: bool) -> None:
    assert is_change(operation) is changes


def test_refusal_says_its_result() -> None:
    assert str(AdsRefusedError(AdsError.SIZE)) == "SIZE"
    assert str(AdsRefusedError(AdsError.SIZE, "too long")) == "SIZE: too long"
    assert OperationOutcome() == (AdsError.NONE, b"", "")
