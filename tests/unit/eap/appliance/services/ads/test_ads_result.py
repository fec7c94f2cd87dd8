"""Abort codes in the words of ADS."""

from __future__ import annotations

import pytest

from eap.appliance.services.ads.ads_result import ads_result
from eap.od.abort import AbortCode, SdoAbortError


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
def test_results(code, result):
    assert ads_result(SdoAbortError(code, 0x1000, 0)) == result
