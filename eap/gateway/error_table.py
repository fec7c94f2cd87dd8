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
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple

from devicebus import errors
from eap.codec.ads import AdsError
from eap.codec.foe import FoeErrorCode
from eap.codec.mailbox import MailboxError
from eap.codec.soeerror import SoeErrorCode
from eap.errors import EapError, EngineGoneError
from eap.gateway.dialect import DialectFailure
from eap.od.abort import AbortCode, SdoAbortError


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


def _by_slave(
    text: str,
    sdo: AbortCode,
    soe: SoeErrorCode,
    foe: FoeErrorCode,
    ads: AdsError,
    dialect: DialectFailure,
    *received: IntEnum,
) -> ErrorCodes:
    """Return the row of a refusal by the slave itself; VoE and EoE have no code for it."""
    mailbox = MailboxError.SERVICE_NOT_SUPPORTED
    return ErrorCodes(text, mailbox, sdo, soe, foe, ads, dialect, received, is_from_slave=True)


class Cause(Enum):
    """Cause of a failed request to a slave; its codes are attributes named as the columns."""

    # The request did not reach the slave, or its answer did not come back.
    NO_SLAVE = ErrorCodes(
        "there is no such slave",
        MailboxError.INVALID_HEADER,
        AbortCode.NO_OBJECT,
        SoeErrorCode.INVALID_DRIVE,
        FoeErrorCode.NOT_FOUND,
        AdsError.TARGET_PORT,
        DialectFailure.MISSING,
        (AdsError.TARGET_PORT, AdsError.TARGET_MACHINE),
    )
    NO_MAILBOX = ErrorCodes(
        "the slave has no mailbox in its state",
        MailboxError.UNSUPPORTED_PROTOCOL,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.COMMAND_NOT_NOW,
        FoeErrorCode.ILLEGAL,
        AdsError.NOT_READY,
        DialectFailure.NOT_SUPPORTED,
        (AdsError.NOT_READY,),
    )
    NO_PROTOCOL = ErrorCodes(
        "it does not speak this protocol",
        MailboxError.UNSUPPORTED_PROTOCOL,
        AbortCode.UNSUPPORTED_ACCESS,
        SoeErrorCode.NO_IDN,
        FoeErrorCode.NOT_DEFINED,
        AdsError.SERVICE,
        DialectFailure.NOT_SUPPORTED,
    )
    TIMEOUT = ErrorCodes(
        "it did not answer in time",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.TIMEOUT,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.TIMEOUT,
        DialectFailure.NO_RESPONSE,
        (AdsError.TIMEOUT,),
    )
    BUS_DOWN = ErrorCodes(
        "the bus is down",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.HARDWARE,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.HOST_UNREACHABLE,
        DialectFailure.GENERAL,
    )
    UNREACHABLE = ErrorCodes(
        "its bus, or a station on the way to it, is down",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.HARDWARE,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.HOST_UNREACHABLE,
        DialectFailure.GENERAL,
        (AdsError.HOST_UNREACHABLE,),
    )
    TOO_LONG = ErrorCodes(
        "the message is longer than its mailbox",
        MailboxError.INVALID_SIZE,
        AbortCode.LONGER_THAN_MAILBOX,
        SoeErrorCode.VALUE_TOO_LONG,
        FoeErrorCode.DISK_FULL,
        AdsError.SIZE,
        DialectFailure.SIZE,
    )
    TOO_SHORT = ErrorCodes(
        "the message is too short",
        MailboxError.SIZE_TOO_SHORT,
        AbortCode.COMMAND,
        SoeErrorCode.VALUE_TOO_SHORT,
        FoeErrorCode.ILLEGAL,
        AdsError.SIZE,
        DialectFailure.GENERAL,
    )
    SERVICE = ErrorCodes(
        "it does not offer this service",
        MailboxError.SERVICE_NOT_SUPPORTED,
        AbortCode.COMMAND,
        SoeErrorCode.GENERAL,
        FoeErrorCode.ILLEGAL,
        AdsError.SERVICE,
        DialectFailure.GENERAL,
    )
    PROTOCOL = ErrorCodes(
        "its answer breaks the protocol",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.GENERAL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.GENERAL,
        DialectFailure.GENERAL,
    )
    BUSY = ErrorCodes(
        "it is busy with another client's transfer",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.COMMAND_ACTIVE,
        FoeErrorCode.NOT_DEFINED,
        AdsError.BUSY,
        DialectFailure.GENERAL,
        (AdsError.BUSY, MailboxError.SERVICE_IN_WORK),
    )
    CROWDED = ErrorCodes(
        "too many requests wait already",
        MailboxError.NO_MORE_MEMORY,
        AbortCode.OUT_OF_MEMORY,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NO_USER,
        AdsError.NO_MEMORY,
        DialectFailure.GENERAL,
    )
    TOO_FAST = ErrorCodes(
        "more requests a second than the plant file allows",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.BUSY,
        DialectFailure.GENERAL,
    )
    DENIED = ErrorCodes(
        "access refused: the plant file has no rule that allows it",
        MailboxError.SERVICE_NOT_SUPPORTED,
        AbortCode.UNSUPPORTED_ACCESS,
        SoeErrorCode.VALUE_PROTECTED,
        FoeErrorCode.NO_RIGHTS,
        AdsError.ACCESS_DENIED,
        DialectFailure.READ_ONLY,
        (AdsError.ACCESS_DENIED,),
    )
    NOT_RECORDED = ErrorCodes(
        "change refused: the audit is required and cannot record it",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.VALUE_PROTECTED,
        FoeErrorCode.NO_RIGHTS,
        AdsError.ACCESS_DENIED,
        DialectFailure.READ_ONLY,
    )

    # The slave refused the request.
    NOT_FOUND = _by_slave(
        "there is no such object or entry",
        AbortCode.NO_OBJECT,
        SoeErrorCode.NO_IDN,
        FoeErrorCode.NOT_FOUND,
        AdsError.NOT_FOUND,
        DialectFailure.MISSING,
        AdsError.NOT_FOUND,
        AbortCode.NO_OBJECT,
        AbortCode.NO_SUBINDEX,
        AbortCode.NOT_STORED,
        SoeErrorCode.NO_IDN,
        SoeErrorCode.NO_DEFAULT,
        SoeErrorCode.NO_DATA_STATE,
        SoeErrorCode.NO_ELEMENT,
        SoeErrorCode.INVALID_DRIVE,
        FoeErrorCode.NOT_FOUND,
    )
    UNSUPPORTED = _by_slave(
        "the device cannot do that",
        AbortCode.UNSUPPORTED_ACCESS,
        SoeErrorCode.GENERAL,
        FoeErrorCode.ILLEGAL,
        AdsError.SERVICE,
        DialectFailure.NOT_SUPPORTED,
        AdsError.SERVICE,
        AbortCode.UNSUPPORTED_ACCESS,
        AbortCode.NO_COMPLETE_ACCESS,
        FoeErrorCode.ILLEGAL,
        MailboxError.UNSUPPORTED_PROTOCOL,
        MailboxError.SERVICE_NOT_SUPPORTED,
    )
    NO_GROUP = _by_slave(
        "the device has no object dictionary",
        AbortCode.GENERAL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.INDEX_GROUP,
        DialectFailure.NOT_SUPPORTED,
        AdsError.INDEX_GROUP,
    )
    ACCESS = _by_slave(
        "it may not be read or written so",
        AbortCode.READ_ONLY,
        SoeErrorCode.VALUE_READ_ONLY,
        FoeErrorCode.ACCESS_DENIED,
        AdsError.ACCESS,
        DialectFailure.READ_ONLY,
        AdsError.ACCESS,
        AbortCode.READ_ONLY,
        AbortCode.WRITE_ONLY,
        SoeErrorCode.DEFAULT_READ_ONLY,
        SoeErrorCode.PASSWORD,
        SoeErrorCode.CYCLIC,
        SoeErrorCode.OTHER_SETTINGS,
        FoeErrorCode.ACCESS_DENIED,
        FoeErrorCode.NO_USER,
        FoeErrorCode.NO_RIGHTS,
    )
    LENGTH = _by_slave(
        "the wrong number of octets",
        AbortCode.LENGTH,
        SoeErrorCode.VALUE_TOO_LONG,
        FoeErrorCode.NOT_DEFINED,
        AdsError.SIZE,
        DialectFailure.SIZE,
        AdsError.SIZE,
        AbortCode.LENGTH,
        AbortCode.TOO_LONG,
        AbortCode.TOO_SHORT,
        SoeErrorCode.DEFAULT_TOO_LONG,
        MailboxError.SIZE_TOO_SHORT,
        MailboxError.INVALID_SIZE,
    )
    VALUE = _by_slave(
        "not a value for it",
        AbortCode.VALUE,
        SoeErrorCode.INVALID_VALUE,
        FoeErrorCode.CHECKSUM,
        AdsError.VALUE,
        DialectFailure.GENERAL,
        AdsError.VALUE,
        AbortCode.VALUE,
        AbortCode.TOO_HIGH,
        AbortCode.TOO_LOW,
        SoeErrorCode.BELOW_MINIMUM,
        SoeErrorCode.ABOVE_MAXIMUM,
        SoeErrorCode.INVALID_VALUE,
        FoeErrorCode.CHECKSUM,
    )
    STATE = _by_slave(
        "not in the state that the device is in",
        AbortCode.DEVICE_STATE,
        SoeErrorCode.COMMAND_NOT_NOW,
        FoeErrorCode.ILLEGAL,
        AdsError.STATE,
        DialectFailure.GENERAL,
        AdsError.STATE,
        AbortCode.DEVICE_STATE,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.COMMAND_ACTIVE,
        SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE,
        SoeErrorCode.COMMAND_NOT_NOW,
        FoeErrorCode.BOOTSTRAP_ONLY,
        FoeErrorCode.NOT_IN_BOOTSTRAP,
    )
    NO_MEMORY = _by_slave(
        "no room for it",
        AbortCode.GENERAL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.DISK_FULL,
        AdsError.NO_MEMORY,
        DialectFailure.GENERAL,
        AdsError.NO_MEMORY,
        FoeErrorCode.DISK_FULL,
        MailboxError.NO_MORE_MEMORY,
    )
    EXISTS = _by_slave(
        "the file exists already",
        AbortCode.GENERAL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.ALREADY_EXISTS,
        AdsError.EXISTS,
        DialectFailure.GENERAL,
        AdsError.EXISTS,
        FoeErrorCode.ALREADY_EXISTS,
    )
    NO_HANDLE = _by_slave(
        "too many files are open",
        AbortCode.GENERAL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NO_USER,
        AdsError.NO_MORE_HANDLES,
        DialectFailure.GENERAL,
        AdsError.NO_MORE_HANDLES,
    )
    GENERAL = _by_slave(
        "the device refuses",
        AbortCode.GENERAL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.GENERAL,
        DialectFailure.GENERAL,
    )

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
        """Whether the slave refused; otherwise it was not reached, or did not answer."""


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
    errors.FrameLostError: (Cause.TIMEOUT, AdsError.TIMEOUT),
    errors.StateTimeoutError: (Cause.TIMEOUT, AdsError.TIMEOUT),
    errors.AlStatusError: (Cause.TIMEOUT, AdsError.STATE),
}
"""Cause at a gateway, and result of the ADS service of slaves, which distinguishes more."""


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
