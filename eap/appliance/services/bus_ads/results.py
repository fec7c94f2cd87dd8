"""Errors of buses and slaves as results of ADS.

Own mapping where no public source has one; SDO abort codes are told as everywhere in this house.
The text of an error is kept beside its result, for traces and logs.
"""

from __future__ import annotations

from devicebus import errors
from eap.aoe.ads_operation import AdsRefusedError
from eap.appliance.services.ads.ads_result import ads_result
from eap.codec.ads import AdsError
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxError
from eap.codec.soeerror import SoeErrorCode
from eap.errors import EapError, EngineGoneError
from eap.od.abort import SdoAbortError

_FOE: dict[int, AdsError] = {
    FoeErrorCode.NOT_FOUND: AdsError.NOT_FOUND,
    FoeErrorCode.ACCESS_DENIED: AdsError.ACCESS,
    FoeErrorCode.DISK_FULL: AdsError.NO_MEMORY,
    FoeErrorCode.ILLEGAL: AdsError.SERVICE,
    FoeErrorCode.ALREADY_EXISTS: AdsError.EXISTS,
    FoeErrorCode.NO_USER: AdsError.ACCESS,
    FoeErrorCode.BOOTSTRAP_ONLY: AdsError.STATE,
    FoeErrorCode.NOT_IN_BOOTSTRAP: AdsError.STATE,
    FoeErrorCode.NO_RIGHTS: AdsError.ACCESS,
    FoeErrorCode.CHECKSUM: AdsError.VALUE,
}
_SOE: dict[int, AdsError] = {
    SoeErrorCode.NO_IDN: AdsError.NOT_FOUND,
    SoeErrorCode.NO_DEFAULT: AdsError.NOT_FOUND,
    SoeErrorCode.NO_DATA_STATE: AdsError.NOT_FOUND,
    SoeErrorCode.NO_ELEMENT: AdsError.NOT_FOUND,
    SoeErrorCode.INVALID_DRIVE: AdsError.NOT_FOUND,
    SoeErrorCode.DEFAULT_TOO_LONG: AdsError.SIZE,
    SoeErrorCode.DEFAULT_READ_ONLY: AdsError.ACCESS,
    SoeErrorCode.BELOW_MINIMUM: AdsError.VALUE,
    SoeErrorCode.ABOVE_MAXIMUM: AdsError.VALUE,
    SoeErrorCode.INVALID_VALUE: AdsError.VALUE,
    SoeErrorCode.PASSWORD: AdsError.ACCESS,
    SoeErrorCode.CYCLIC: AdsError.ACCESS,
    SoeErrorCode.OTHER_SETTINGS: AdsError.ACCESS,
    SoeErrorCode.COMMAND_ACTIVE: AdsError.STATE,
    SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE: AdsError.STATE,
    SoeErrorCode.COMMAND_NOT_NOW: AdsError.STATE,
}
_SOE_OF_ELEMENTS: dict[int, AdsError] = {
    1: AdsError.NOT_FOUND,
    2: AdsError.SIZE,
    3: AdsError.SIZE,
    4: AdsError.ACCESS,
    5: AdsError.ACCESS,
}
"""By the last digit of the codes 0x2001 to 0x7005, which all elements have in common."""
_MAILBOX: dict[int, AdsError] = {
    MailboxError.UNSUPPORTED_PROTOCOL: AdsError.SERVICE,
    MailboxError.SERVICE_NOT_SUPPORTED: AdsError.SERVICE,
    MailboxError.NO_MORE_MEMORY: AdsError.NO_MEMORY,
    MailboxError.SIZE_TOO_SHORT: AdsError.SIZE,
    MailboxError.INVALID_SIZE: AdsError.SIZE,
    MailboxError.SERVICE_IN_WORK: AdsError.BUSY,
}
_KINDS: tuple[tuple[type[EapError], AdsError], ...] = (
    (EngineGoneError, AdsError.HOST_UNREACHABLE),
    (errors.MailboxTimeoutError, AdsError.TIMEOUT),
    (errors.FrameLostError, AdsError.TIMEOUT),
    (errors.StateTimeoutError, AdsError.TIMEOUT),
    (errors.MailboxSizeError, AdsError.SIZE),
    (errors.AlStatusError, AdsError.STATE),
    (errors.NoMailboxError, AdsError.STATE),
    (errors.MailboxClosedError, AdsError.NOT_READY),
)


def refusal(error: EapError) -> AdsRefusedError:
    """Return the result that comes nearest to what *error* says, with its text."""
    return AdsRefusedError(_result(error), str(error))


def _result(error: EapError) -> AdsError:
    match error:
        case SdoAbortError():
            return ads_result(error)
        case errors.FoeError():
            return _FOE.get(error.code, AdsError.GENERAL)
        case errors.SoeError():
            return _SOE.get(error.code) or _of_element(error.code)
        case errors.MailboxRefusedError():
            return _MAILBOX.get(error.detail, AdsError.GENERAL)
    found = (result for kind, result in _KINDS if isinstance(error, kind))
    return next(found, AdsError.GENERAL)


def _of_element(code: int) -> AdsError:
    if 2 <= code >> 12 <= 7 and code & 0xFF0 == 0:
        return _SOE_OF_ELEMENTS.get(code & 0xF, AdsError.GENERAL)
    return AdsError.GENERAL
