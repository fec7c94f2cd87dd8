"""Errors in the requester's own protocol: each reason has a code in every protocol.

ETG.8200 leaves open what a gateway answers that gets no answer itself.  A tool understands the
errors of its own protocol best, so an SDO is aborted, an IDN refused, a file transfer ended with a
text, also by a master or slave that does not speak that protocol.  A mailbox error is for protocols
without an error of their own (VoE, EoE), and for what is no request.
"""

from __future__ import annotations

from enum import Enum
from typing import NamedTuple

from eap.aoe.answer import AmsAnswer, response_to
from eap.codec.ads import AdsError
from eap.codec.ams import AmsHeader
from eap.codec.coe import CoeHeader, CoeService
from eap.codec.coe import encode_message as encode_coe
from eap.codec.foe import Busy, FoeErrorCode, FoeOpcode
from eap.codec.foe import encode_message as encode_foe
from eap.codec.mailbox import MailboxError, MailboxErrorReply, MailboxType
from eap.codec.sdo import encode_abort
from eap.codec.sdoinfo import InfoError, SdoInfoHeader, SdoInfoOpcode
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.codec.soe import encode_message as encode_soe
from eap.codec.soeerror import SoeErrorCode
from eap.errors import CodecError
from eap.od.abort import AbortCode

_NOT_BEGUN = Busy(0, 100)
_SUBINDEX = 5
"""Where it stands in an SDO request, CoE header included."""


class _Codes(NamedTuple):
    text: str
    mailbox: MailboxError
    sdo: AbortCode
    soe: SoeErrorCode
    foe: FoeErrorCode
    ads: AdsError


class Reason(Enum):
    """Why a request is not answered by whom it was for; its codes in each protocol."""

    NO_SLAVE = _Codes(
        "there is no such slave",
        MailboxError.INVALID_HEADER,
        AbortCode.NO_OBJECT,
        SoeErrorCode.INVALID_DRIVE,
        FoeErrorCode.NOT_FOUND,
        AdsError.TARGET_PORT,
    )
    NO_MAILBOX = _Codes(
        "the slave has no mailbox in its state",
        MailboxError.UNSUPPORTED_PROTOCOL,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.COMMAND_NOT_NOW,
        FoeErrorCode.ILLEGAL,
        AdsError.NOT_READY,
    )
    NO_PROTOCOL = _Codes(
        "it does not speak this protocol",
        MailboxError.UNSUPPORTED_PROTOCOL,
        AbortCode.UNSUPPORTED_ACCESS,
        SoeErrorCode.NO_IDN,
        FoeErrorCode.NOT_DEFINED,
        AdsError.SERVICE,
    )
    TIMEOUT = _Codes(
        "it did not answer in time",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.TIMEOUT,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.TIMEOUT,
    )
    BUS_DOWN = _Codes(
        "the bus is down",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.HARDWARE,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.HOST_UNREACHABLE,
    )
    UNREACHABLE = _Codes(
        "its bus, or a station on the way to it, is down",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.HARDWARE,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.HOST_UNREACHABLE,
    )
    TOO_LONG = _Codes(
        "the message is longer than its mailbox",
        MailboxError.INVALID_SIZE,
        AbortCode.LONGER_THAN_MAILBOX,
        SoeErrorCode.VALUE_TOO_LONG,
        FoeErrorCode.DISK_FULL,
        AdsError.SIZE,
    )
    TOO_SHORT = _Codes(
        "the message is too short",
        MailboxError.SIZE_TOO_SHORT,
        AbortCode.COMMAND,
        SoeErrorCode.VALUE_TOO_SHORT,
        FoeErrorCode.ILLEGAL,
        AdsError.SIZE,
    )
    SERVICE = _Codes(
        "it does not offer this service",
        MailboxError.SERVICE_NOT_SUPPORTED,
        AbortCode.COMMAND,
        SoeErrorCode.GENERAL,
        FoeErrorCode.ILLEGAL,
        AdsError.SERVICE,
    )
    BUSY = _Codes(
        "it is busy with another client's transfer",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.COMMAND_ACTIVE,
        FoeErrorCode.NOT_DEFINED,
        AdsError.BUSY,
    )
    CROWDED = _Codes(
        "too many requests wait already",
        MailboxError.NO_MORE_MEMORY,
        AbortCode.OUT_OF_MEMORY,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NO_USER,
        AdsError.NO_MEMORY,
    )
    TOO_FAST = _Codes(
        "more requests a second than the plant file allows",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.GENERAL,
        FoeErrorCode.NOT_DEFINED,
        AdsError.BUSY,
    )
    DENIED = _Codes(
        "access refused: the plant file has no rule that allows it",
        MailboxError.SERVICE_NOT_SUPPORTED,
        AbortCode.UNSUPPORTED_ACCESS,
        SoeErrorCode.VALUE_PROTECTED,
        FoeErrorCode.NO_RIGHTS,
        AdsError.ACCESS_DENIED,
    )
    NOT_RECORDED = _Codes(
        "change refused: the audit is required and cannot record it",
        MailboxError.SERVICE_IN_WORK,
        AbortCode.LOCAL_CONTROL,
        SoeErrorCode.VALUE_PROTECTED,
        FoeErrorCode.NO_RIGHTS,
        AdsError.ACCESS_DENIED,
    )

    @property
    def text(self) -> str:
        """For people."""
        return self.value.text


_ASK_AGAIN = frozenset((Reason.BUSY, Reason.TOO_FAST))


class Answer(NamedTuple):
    """A message that goes back."""

    type: MailboxType
    body: bytes


def refuse(kind: MailboxType, request: bytes, reason: Reason, text: str = "") -> Answer:
    """Return the error that answers a request.

    Args:
        kind: Its protocol.
        request: What it holds behind the mailbox header.
        reason: Why it is refused.
        text: More than *reason* says, where the protocol has room for words.
    """
    refuser = _REFUSERS.get(kind)
    if refuser is None:
        return mailbox_error(reason.value.mailbox)
    body = refuser(request, reason, text or reason.text)
    return mailbox_error(reason.value.mailbox) if body is None else Answer(kind, body)


def mailbox_error(detail: int) -> Answer:
    """Return an error of the mailbox itself."""
    return Answer(MailboxType.ERR, MailboxErrorReply(detail=detail).encode())


def _refuse_coe(request: bytes, reason: Reason, text: str) -> bytes | None:
    del text
    if len(request) < CoeHeader.SIZE:
        return None
    code, service = reason.value.sdo, request[1] >> 4
    if service == CoeService.SDO_INFORMATION:
        body = SdoInfoHeader(SdoInfoOpcode.ERROR).encode() + InfoError(code).encode()
        return encode_coe(CoeService.SDO_INFORMATION, body)
    if service != CoeService.SDO_REQUEST:
        return None
    subindex = request[_SUBINDEX] if len(request) > _SUBINDEX else 0
    return encode_abort(int.from_bytes(request[3:_SUBINDEX], "little"), subindex, code)


def _refuse_foe(request: bytes, reason: Reason, text: str) -> bytes | None:
    words = text.encode() + b"\0"
    if not request:
        return None
    if reason in _ASK_AGAIN:  # no end of the transfer, only of patience
        return encode_foe(FoeOpcode.BUSY, _NOT_BEGUN.number, words)
    return encode_foe(FoeOpcode.ERROR, reason.value.foe, words)


def _refuse_soe(request: bytes, reason: Reason, text: str) -> bytes | None:
    del text
    opcode = request[0] & 0x07 if len(request) >= SoeHeader.SIZE else 0
    if opcode not in {SoeOpcode.READ_REQUEST, SoeOpcode.WRITE_REQUEST}:
        return None
    return encode_soe(
        SoeOpcode(opcode + 1),
        int.from_bytes(request[2:4], "little"),
        reason.value.soe.to_bytes(2, "little"),
        drive=request[0] >> 5,
        elements=request[1],
        error=True,
    )


def _refuse_aoe(request: bytes, reason: Reason, text: str) -> bytes | None:
    del text
    try:
        asked = AmsHeader.decode(request)
    except CodecError:
        return None
    return response_to(asked, AmsAnswer(error_code=reason.value.ads))


_REFUSERS = {
    MailboxType.AOE: _refuse_aoe,
    MailboxType.COE: _refuse_coe,
    MailboxType.FOE: _refuse_foe,
    MailboxType.SOE: _refuse_soe,
}
