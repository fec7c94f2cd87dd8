"""The results by which ADS tells of refused SDOs: TwinCAT's words for our abort codes."""

from __future__ import annotations

from eap.codec.ads import AdsError
from eap.od.abort import AbortCode, SdoAbortError

_RESULTS: dict[int, AdsError] = {
    AbortCode.UNSUPPORTED_ACCESS: AdsError.SERVICE,
    AbortCode.NO_COMPLETE_ACCESS: AdsError.SERVICE,
    AbortCode.WRITE_ONLY: AdsError.ACCESS,
    AbortCode.READ_ONLY: AdsError.ACCESS,
    AbortCode.NO_OBJECT: AdsError.NOT_FOUND,
    AbortCode.NO_SUBINDEX: AdsError.NOT_FOUND,
    AbortCode.NOT_STORED: AdsError.NOT_FOUND,
    AbortCode.LENGTH: AdsError.SIZE,
    AbortCode.TOO_LONG: AdsError.SIZE,
    AbortCode.TOO_SHORT: AdsError.SIZE,
    AbortCode.VALUE: AdsError.VALUE,
    AbortCode.TOO_HIGH: AdsError.VALUE,
    AbortCode.TOO_LOW: AdsError.VALUE,
    AbortCode.DEVICE_STATE: AdsError.STATE,
    AbortCode.LOCAL_CONTROL: AdsError.STATE,
}


def ads_result(abort: SdoAbortError) -> AdsError:
    """Return the result that comes nearest to what *abort* says."""
    return _RESULTS.get(abort.code, AdsError.GENERAL)
