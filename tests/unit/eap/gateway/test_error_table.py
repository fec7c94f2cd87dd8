from __future__ import annotations

from enum import IntEnum

import pytest

from devicebus import errors
from eap.codec.ads import AdsError
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxError
from eap.codec.soe import SoeErrorCode
from eap.errors import EngineGoneError
from eap.gateway import error_table
from eap.gateway.error_table import Cause, ads_result, cause_of, cause_of_result
from eap.od.abort import AbortCode, SdoAbortError


@pytest.mark.parametrize(
    ("error", "result"),
    [
        (SdoAbortError(AbortCode.NO_OBJECT, 0x1018, 9), AdsError.NOT_FOUND),
        (SdoAbortError(AbortCode.HARDWARE, 0x1018, 9), AdsError.GENERAL),
        (errors.MailboxTimeoutError("m"), AdsError.TIMEOUT),
        (errors.FrameLostError("f"), AdsError.HOST_UNREACHABLE),
        (errors.MailboxSizeError("m"), AdsError.SIZE),
        (errors.MailboxProtocolError("m"), AdsError.GENERAL),
        (errors.MailboxRefusedError("m", detail=2), AdsError.SERVICE),
        (errors.MailboxRefusedError("m", detail=0x77), AdsError.GENERAL),
        (errors.FoeError("f", code=0x8001), AdsError.NOT_FOUND),
        (errors.FoeError("f", code=0x1234), AdsError.GENERAL),
        (errors.SoeError("s", code=0x7006), AdsError.VALUE),
        (errors.SoeError("s", code=0x3001), AdsError.NOT_FOUND),
        (errors.SoeError("s", code=0x2003), AdsError.SIZE),
        (errors.SoeError("s", code=0x7005), AdsError.ACCESS),
        (errors.SoeError("s", code=0x9004), AdsError.GENERAL),
        (errors.AlStatusError("a", code=1, state=2), AdsError.STATE),
        (errors.BusError("b"), AdsError.GENERAL),
        (EngineGoneError("e"), AdsError.HOST_UNREACHABLE),
    ],
)
def test_ads_result_of_each_exception(error, result):
    assert ads_result(error) == result


@pytest.mark.parametrize(
    ("code", "result"),
    [
        (AbortCode.NO_OBJECT, 0x70C),
        (AbortCode.NO_SUBINDEX, 0x70C),
        (AbortCode.NOT_STORED, 0x70C),
        (AbortCode.READ_ONLY, 0x704),
        (AbortCode.TOO_LONG, 0x705),
        (AbortCode.TOO_HIGH, 0x706),
        (AbortCode.DEVICE_STATE, 0x712),
        (AbortCode.NO_COMPLETE_ACCESS, 0x701),
        (AbortCode.MAPPED, 0x700),
        (0x12345678, 0x700),
    ],
)
def test_ads_result_of_abort_codes(code, result):
    assert ads_result(SdoAbortError(code, 0x1000, 0)) == result


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (errors.MailboxTimeoutError("x"), Cause.TIMEOUT),
        (errors.MailboxSizeError("x"), Cause.TOO_LONG),
        (errors.NoMailboxError("x"), Cause.NO_MAILBOX),
        (errors.MailboxClosedError("x"), Cause.TIMEOUT),
        (errors.FrameLostError("x"), Cause.BUS_DOWN),
        (errors.BusError("x"), Cause.TIMEOUT),
        (EngineGoneError("x"), Cause.BUS_DOWN),
        (SdoAbortError(AbortCode.NO_SUBINDEX, 0x1018, 9), Cause.NOT_FOUND),
        (errors.FoeError("x", code=FoeErrorCode.ILLEGAL), Cause.UNSUPPORTED),
        (errors.SoeError("x", code=SoeErrorCode.NAME_PROTECTED), Cause.ACCESS),
        (errors.SoeError("x", code=0x7006), Cause.VALUE),
        (errors.MailboxRefusedError("x", detail=9), Cause.BUSY),
    ],
)
def test_cause_of_each_exception(error, cause):
    assert cause_of(error) is cause


def test_cause_of_result_separates_the_way_from_the_slave():
    assert cause_of_result(AdsError.HOST_UNREACHABLE) is Cause.UNREACHABLE
    assert not Cause.UNREACHABLE.is_from_slave
    assert cause_of_result(AdsError.NOT_FOUND) is Cause.NOT_FOUND
    assert Cause.NOT_FOUND.is_from_slave
    assert cause_of_result(0x7FF) is Cause.GENERAL


@pytest.mark.parametrize("cause", [cause for cause in Cause if cause.is_from_slave])
def test_refusal_by_a_slave_keeps_its_cause_over_ads(cause):
    """A remote slave's refusal arrives as a result of ADS; the client sees the same cause."""
    assert cause_of_result(cause.ads) is cause


def test_error_table_receives_each_code_as_one_cause():
    received: list[tuple[type[IntEnum], int]] = [
        (type(code), int(code)) for cause in Cause for code in cause.value.received
    ]
    assert len(received) == len(set(received))
    kinds = {kind for kind, _ in received}
    assert kinds == {AdsError, AbortCode, SoeErrorCode, FoeErrorCode, MailboxError}, (
        "codes of a new protocol: add them here and to _refusal of error_table"
    )


@pytest.mark.parametrize(
    "kind",
    [each for each in vars(errors).values() if isinstance(each, type)],
    ids=lambda kind: kind.__name__,
)
def test_error_table_has_each_error_of_the_bus(kind):
    if issubclass(kind, errors.BusError):
        error = kind.__new__(kind)
        vars(error).update(code=0, detail=0)
        assert error_table._refusal(error) or kind in error_table._BY_EXCEPTION, (
            f"{kind.__name__}: a refusal with a code of its own belongs into _refusal of"
            " eap/gateway/error_table.py, any other error into _BY_EXCEPTION"
        )
