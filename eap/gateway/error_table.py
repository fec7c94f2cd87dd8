"""Error table: causes of failed requests to slaves, with their codes in every protocol.

Forward, a cause is reported to a client by the code of the client's own protocol.  Backward, a code
that a slave or another station sent, or an exception, is understood as a cause.  Several codes are
received as one cause: ``NO_SUBINDEX`` goes on to a client of ADS as a missing object.

Sources of the columns:
    mailbox: ETG.1000.4, mailbox error reply.
    sdo: ETG.1000.6, SDO abort codes.
    soe: IEC 61800-7-300, SoE error codes; those of ETG.1000.6 are the same.
    foe: ETG.1000.6, FoE error codes.
    ads: AdsDef.h, ADS and AMS results.
    text: shown to people, by the command line and in FoE errors.
    dialect: failures of the high-nibble dialect, whose numbers are in :mod:`eap.gateway.dialect`.
No standard relates the columns to each other, and ETG.8200 leaves open what a gateway answers that
gets no answer itself; the rows are a choice of this project (docs/gateway.md, "Errors").

A protocol has a column if it has codes for most of these causes.  The codes of one with few are
listed in ``received`` only, and the gateway reports its own causes by the mailbox error.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple

from devicebus import errors
from eap.codec.ads import AdsError
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxError
from eap.codec.soe import SoeErrorCode
from eap.errors import EapError, EngineGoneError
from eap.gateway.dialect import DialectFailure
from eap.od.abort import AbortCode, SdoAbortError

Box, Sdo, Soe, Foe, Ads = MailboxError, AbortCode, SoeErrorCode, FoeErrorCode, AdsError
Fail = DialectFailure


class ErrorCodes(NamedTuple):
    """One row of the table."""

    text: str
    mailbox: MailboxError
    sdo: AbortCode
    soe: SoeErrorCode
    foe: FoeErrorCode
    ads: AdsError
    dialect: DialectFailure
    received: tuple[IntEnum, ...] = ()
    """Codes that are understood as this cause, members of the enums of the other columns."""
    is_from_slave: bool = False


class Cause(Enum):
    """Cause of a failed request to a slave; its codes are attributes named as the columns."""

    # The request did not reach the slave, or its answer did not come back.
    NO_SLAVE = ErrorCodes(
        "there is no such slave",
        Box.INVALID_HEADER, Sdo.NO_OBJECT, Soe.INVALID_DRIVE, Foe.NOT_FOUND, Ads.TARGET_PORT,
        Fail.MISSING,
        (Ads.TARGET_PORT, Ads.TARGET_MACHINE),
    )  # fmt: skip
    NO_MAILBOX = ErrorCodes(
        "the slave has no mailbox in its state",
        Box.UNSUPPORTED_PROTOCOL, Sdo.LOCAL_CONTROL, Soe.COMMAND_NOT_NOW, Foe.ILLEGAL,
        Ads.NOT_READY, Fail.NOT_SUPPORTED,
        (Ads.NOT_READY,),
    )  # fmt: skip
    NO_PROTOCOL = ErrorCodes(
        "it does not speak this protocol",
        Box.UNSUPPORTED_PROTOCOL, Sdo.UNSUPPORTED_ACCESS, Soe.NO_IDN, Foe.NOT_DEFINED,
        Ads.SERVICE, Fail.NOT_SUPPORTED,
    )  # fmt: skip
    TIMEOUT = ErrorCodes(
        "it did not answer in time",
        Box.SERVICE_IN_WORK, Sdo.TIMEOUT, Soe.GENERAL, Foe.NOT_DEFINED, Ads.TIMEOUT,
        Fail.NO_RESPONSE,
        (Ads.TIMEOUT,),
    )  # fmt: skip
    BUS_DOWN = ErrorCodes(
        "the bus is down",
        Box.SERVICE_IN_WORK, Sdo.HARDWARE, Soe.GENERAL, Foe.NOT_DEFINED, Ads.HOST_UNREACHABLE,
        Fail.GENERAL,
    )  # fmt: skip
    UNREACHABLE = ErrorCodes(
        "its bus, or a station on the way to it, is down",
        Box.SERVICE_IN_WORK, Sdo.HARDWARE, Soe.GENERAL, Foe.NOT_DEFINED, Ads.HOST_UNREACHABLE,
        Fail.GENERAL,
        (Ads.HOST_UNREACHABLE,),
    )  # fmt: skip
    TOO_LONG = ErrorCodes(
        "the message is longer than its mailbox",
        Box.INVALID_SIZE, Sdo.LONGER_THAN_MAILBOX, Soe.VALUE_TOO_LONG, Foe.DISK_FULL, Ads.SIZE,
        Fail.SIZE,
    )  # fmt: skip
    TOO_SHORT = ErrorCodes(
        "the message is too short",
        Box.SIZE_TOO_SHORT, Sdo.COMMAND, Soe.VALUE_TOO_SHORT, Foe.ILLEGAL, Ads.SIZE, Fail.GENERAL,
    )  # fmt: skip
    SERVICE = ErrorCodes(
        "it does not offer this service",
        Box.SERVICE_NOT_SUPPORTED, Sdo.COMMAND, Soe.GENERAL, Foe.ILLEGAL, Ads.SERVICE,
        Fail.GENERAL,
    )  # fmt: skip
    PROTOCOL = ErrorCodes(
        "its answer breaks the protocol",
        Box.SERVICE_IN_WORK, Sdo.GENERAL, Soe.GENERAL, Foe.NOT_DEFINED, Ads.GENERAL, Fail.GENERAL,
    )  # fmt: skip
    BUSY = ErrorCodes(
        "it is busy with another client's transfer",
        Box.SERVICE_IN_WORK, Sdo.LOCAL_CONTROL, Soe.COMMAND_ACTIVE, Foe.NOT_DEFINED, Ads.BUSY,
        Fail.GENERAL,
        (Ads.BUSY, Box.SERVICE_IN_WORK),
    )  # fmt: skip
    CROWDED = ErrorCodes(
        "too many requests wait already",
        Box.NO_MORE_MEMORY, Sdo.OUT_OF_MEMORY, Soe.GENERAL, Foe.NO_USER, Ads.NO_MEMORY,
        Fail.GENERAL,
    )  # fmt: skip
    TOO_FAST = ErrorCodes(
        "more requests a second than the plant file allows",
        Box.SERVICE_IN_WORK, Sdo.LOCAL_CONTROL, Soe.GENERAL, Foe.NOT_DEFINED, Ads.BUSY,
        Fail.GENERAL,
    )  # fmt: skip
    DENIED = ErrorCodes(
        "access refused: the plant file has no rule that allows it",
        Box.SERVICE_NOT_SUPPORTED, Sdo.UNSUPPORTED_ACCESS, Soe.VALUE_PROTECTED, Foe.NO_RIGHTS,
        Ads.ACCESS_DENIED, Fail.READ_ONLY,
        (Ads.ACCESS_DENIED,),
    )  # fmt: skip
    NOT_RECORDED = ErrorCodes(
        "change refused: the audit is required and cannot record it",
        Box.SERVICE_IN_WORK, Sdo.LOCAL_CONTROL, Soe.VALUE_PROTECTED, Foe.NO_RIGHTS,
        Ads.ACCESS_DENIED, Fail.READ_ONLY,
    )  # fmt: skip

    # The slave refused the request.  VoE and EoE have no code of their own for that.
    NOT_FOUND = ErrorCodes(
        "there is no such object or entry",
        Box.SERVICE_NOT_SUPPORTED, Sdo.NO_OBJECT, Soe.NO_IDN, Foe.NOT_FOUND, Ads.NOT_FOUND,
        Fail.MISSING,
        (
            Ads.NOT_FOUND, Sdo.NO_OBJECT, Sdo.NO_SUBINDEX, Sdo.NOT_STORED, Soe.NO_IDN,
            Soe.NO_DEFAULT, Soe.NO_DATA_STATE, Soe.NO_ELEMENT, Soe.INVALID_DRIVE, Foe.NOT_FOUND,
        ),
        is_from_slave=True,
    )  # fmt: skip
    UNSUPPORTED = ErrorCodes(
        "the device cannot do that",
        Box.SERVICE_NOT_SUPPORTED, Sdo.UNSUPPORTED_ACCESS, Soe.GENERAL, Foe.ILLEGAL, Ads.SERVICE,
        Fail.NOT_SUPPORTED,
        (
            Ads.SERVICE, Sdo.UNSUPPORTED_ACCESS, Sdo.NO_COMPLETE_ACCESS, Foe.ILLEGAL,
            Box.UNSUPPORTED_PROTOCOL, Box.SERVICE_NOT_SUPPORTED,
        ),
        is_from_slave=True,
    )  # fmt: skip
    NO_GROUP = ErrorCodes(
        "the device has no object dictionary",
        Box.SERVICE_NOT_SUPPORTED, Sdo.GENERAL, Soe.GENERAL, Foe.NOT_DEFINED, Ads.INDEX_GROUP,
        Fail.NOT_SUPPORTED,
        (Ads.INDEX_GROUP,),
        is_from_slave=True,
    )  # fmt: skip
    ACCESS = ErrorCodes(
        "it may not be read or written so",
        Box.SERVICE_NOT_SUPPORTED, Sdo.READ_ONLY, Soe.VALUE_READ_ONLY, Foe.ACCESS_DENIED,
        Ads.ACCESS, Fail.READ_ONLY,
        (
            Ads.ACCESS, Sdo.READ_ONLY, Sdo.WRITE_ONLY, Soe.DEFAULT_READ_ONLY, Soe.PASSWORD,
            Soe.CYCLIC, Soe.OTHER_SETTINGS, Foe.ACCESS_DENIED, Foe.NO_USER, Foe.NO_RIGHTS,
        ),
        is_from_slave=True,
    )  # fmt: skip
    LENGTH = ErrorCodes(
        "the wrong number of bytes",
        Box.SERVICE_NOT_SUPPORTED, Sdo.LENGTH, Soe.VALUE_TOO_LONG, Foe.NOT_DEFINED, Ads.SIZE,
        Fail.SIZE,
        (
            Ads.SIZE, Sdo.LENGTH, Sdo.TOO_LONG, Sdo.TOO_SHORT, Soe.DEFAULT_TOO_LONG,
            Box.SIZE_TOO_SHORT, Box.INVALID_SIZE,
        ),
        is_from_slave=True,
    )  # fmt: skip
    VALUE = ErrorCodes(
        "not a value for it",
        Box.SERVICE_NOT_SUPPORTED, Sdo.VALUE, Soe.INVALID_VALUE, Foe.CHECKSUM, Ads.VALUE,
        Fail.GENERAL,
        (
            Ads.VALUE, Sdo.VALUE, Sdo.TOO_HIGH, Sdo.TOO_LOW, Soe.BELOW_MINIMUM, Soe.ABOVE_MAXIMUM,
            Soe.INVALID_VALUE, Foe.CHECKSUM,
        ),
        is_from_slave=True,
    )  # fmt: skip
    STATE = ErrorCodes(
        "not in the state that the device is in",
        Box.SERVICE_NOT_SUPPORTED, Sdo.DEVICE_STATE, Soe.COMMAND_NOT_NOW, Foe.ILLEGAL, Ads.STATE,
        Fail.GENERAL,
        (
            Ads.STATE, Sdo.DEVICE_STATE, Sdo.LOCAL_CONTROL, Soe.COMMAND_ACTIVE,
            Soe.COMMAND_NOT_INTERRUPTIBLE, Soe.COMMAND_NOT_NOW, Foe.BOOTSTRAP_ONLY,
            Foe.NOT_IN_BOOTSTRAP,
        ),
        is_from_slave=True,
    )  # fmt: skip
    NO_MEMORY = ErrorCodes(
        "no room for it",
        Box.SERVICE_NOT_SUPPORTED, Sdo.GENERAL, Soe.GENERAL, Foe.DISK_FULL, Ads.NO_MEMORY,
        Fail.GENERAL,
        (Ads.NO_MEMORY, Foe.DISK_FULL, Box.NO_MORE_MEMORY),
        is_from_slave=True,
    )  # fmt: skip
    EXISTS = ErrorCodes(
        "the file exists already",
        Box.SERVICE_NOT_SUPPORTED, Sdo.GENERAL, Soe.GENERAL, Foe.ALREADY_EXISTS, Ads.EXISTS,
        Fail.GENERAL,
        (Ads.EXISTS, Foe.ALREADY_EXISTS),
        is_from_slave=True,
    )  # fmt: skip
    NO_HANDLE = ErrorCodes(
        "too many files are open",
        Box.SERVICE_NOT_SUPPORTED, Sdo.GENERAL, Soe.GENERAL, Foe.NO_USER, Ads.NO_MORE_HANDLES,
        Fail.GENERAL,
        (Ads.NO_MORE_HANDLES,),
        is_from_slave=True,
    )  # fmt: skip
    GENERAL = ErrorCodes(
        "the device refuses",
        Box.SERVICE_NOT_SUPPORTED, Sdo.GENERAL, Soe.GENERAL, Foe.NOT_DEFINED, Ads.GENERAL,
        Fail.GENERAL,
        (),
        is_from_slave=True,
    )  # fmt: skip

    def __init__(self, *columns: object) -> None:
        row: ErrorCodes = self._value_
        self.text = row.text
        self.mailbox = row.mailbox
        self.sdo = row.sdo
        self.soe = row.soe
        self.foe = row.foe
        self.ads = row.ads
        self.dialect = row.dialect
        self.is_from_slave = row.is_from_slave
        """True if the slave refused; otherwise it was not reached, or did not answer."""


_ELEMENT_DIGITS = {
    1: Cause.NOT_FOUND,
    2: Cause.LENGTH,
    3: Cause.LENGTH,
    4: Cause.ACCESS,
    5: Cause.ACCESS,
}
"""IEC 61800-7-300: last digit of the codes 0x2001 to 0x7005, one thousand for each element."""
_CAUSES: dict[tuple[type[IntEnum], int], Cause] = {
    (type(code), int(code)): cause for cause in Cause for code in cause.value.received
} | {
    (SoeErrorCode, element << 12 | digit): cause
    for element in range(2, 8)
    for digit, cause in _ELEMENT_DIGITS.items()
}
_BY_EXCEPTION: dict[type[EapError], tuple[Cause, AdsError]] = {
    EngineGoneError: (Cause.BUS_DOWN, AdsError.HOST_UNREACHABLE),
    errors.NoMailboxError: (Cause.NO_MAILBOX, AdsError.STATE),
    errors.MailboxClosedError: (Cause.TIMEOUT, AdsError.NOT_READY),
    errors.MailboxSizeError: (Cause.TOO_LONG, AdsError.SIZE),
    errors.MailboxProtocolError: (Cause.PROTOCOL, AdsError.GENERAL),
    errors.MailboxBusyError: (Cause.BUSY, AdsError.BUSY),
    errors.MailboxTimeoutError: (Cause.TIMEOUT, AdsError.TIMEOUT),
    errors.FrameLostError: (Cause.BUS_DOWN, AdsError.HOST_UNREACHABLE),
    errors.StateTimeoutError: (Cause.TIMEOUT, AdsError.TIMEOUT),
    errors.AlStatusError: (Cause.TIMEOUT, AdsError.STATE),
    errors.WorkingCounterError: (Cause.TIMEOUT, AdsError.GENERAL),
    errors.IdentityError: (Cause.TIMEOUT, AdsError.GENERAL),
    errors.SiiError: (Cause.TIMEOUT, AdsError.GENERAL),
    errors.EoeError: (Cause.GENERAL, AdsError.GENERAL),
    errors.BusError: (Cause.TIMEOUT, AdsError.GENERAL),
}
"""Cause at a gateway, and result of the ADS service of slaves, which distinguishes more.

It has every error of the device bus but those of :func:`_refusal`.
"""


def cause_of_result(result: int) -> Cause:
    """Return the cause that a result of ADS, as another station answers, stands for."""
    return _CAUSES.get((AdsError, result), Cause.GENERAL)


def cause_of(error: EapError) -> Cause:
    """Return the cause that an exception stands for; one without an entry is a missing answer."""
    return _refusal(error) or _of_class(type(error))[0]


def ads_result(error: EapError) -> AdsError:
    """Return the result of ADS that comes nearest to an exception."""
    refusal = _refusal(error)
    return _of_class(type(error))[1] if refusal is None else refusal.ads


def _refusal(error: EapError) -> Cause | None:
    """Return the cause of a refusal by the slave, None for other exceptions."""
    match error:
        case SdoAbortError():
            code: tuple[type[IntEnum], int] = AbortCode, error.code
        case errors.SoeError():
            code = SoeErrorCode, error.code
        case errors.FoeError():
            code = FoeErrorCode, error.code
        case errors.MailboxRefusedError():
            code = MailboxError, error.detail
        case _:
            return None
    return _CAUSES.get(code, Cause.GENERAL)


def _of_class(kind: type[EapError]) -> tuple[Cause, AdsError]:
    found = (entry for each in kind.__mro__ if (entry := _BY_EXCEPTION.get(each)) is not None)
    return next(found, (Cause.TIMEOUT, AdsError.GENERAL))
