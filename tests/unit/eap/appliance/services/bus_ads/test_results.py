"""Errors of buses and slaves as results of ADS."""

from __future__ import annotations

import pytest

from devicebus import errors
from eap.appliance.services.bus_ads.results import refusal
from eap.codec.ads import AdsError
from eap.errors import EngineGoneError
from eap.od.abort import AbortCode, SdoAbortError


@pytest.mark.parametrize(
    ("error", "result"),
    [
        (SdoAbortError(AbortCode.NO_OBJECT, 0x1018, 9), AdsError.NOT_FOUND),
        (SdoAbortError(AbortCode.HARDWARE, 0x1018, 9), AdsError.GENERAL),
        (errors.MailboxTimeoutError("m"), AdsError.TIMEOUT),
        (errors.FrameLostError("f"), AdsError.TIMEOUT),
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
def test_results(error, result):
    refused = refusal(error)
    assert (refused.result, refused.why) == (result, str(error))
