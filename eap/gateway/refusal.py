"""Error answers of a gateway, in the protocol of the request.

A tool understands the errors of its own protocol best, so an SDO is aborted, an IDN refused, a file
transfer ended with a text, also by a master or slave that does not speak that protocol.  A mailbox
error is for protocols without an error of their own (VoE, EoE), and for what is no request.
"""

from __future__ import annotations

from typing import NamedTuple

from eap.ads.endpoint import AmsAnswer, response_to
from eap.codec.ams import AmsHeader
from eap.codec.coe import (
    CoeHeader,
    CoeService,
    InfoError,
    SdoInfoHeader,
    SdoInfoOpcode,
    encode_abort,
)
from eap.codec.coe import encode_message as encode_coe
from eap.codec.foe import Busy, FoeOpcode
from eap.codec.foe import encode_message as encode_foe
from eap.codec.mailbox import MailboxErrorReply, MailboxType
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.codec.soe import encode_message as encode_soe
from eap.errors import CodecError, EapError
from eap.gateway.error_table import Cause

_NOT_BEGUN = Busy(0, 100)
_SUBINDEX = 5
"""Where it stands in an SDO request, CoE header included."""

_ASK_AGAIN = frozenset((Cause.BUSY, Cause.TOO_FAST))


class GatewayError(EapError):
    """A request that the gateway itself refuses."""

    def __init__(self, cause: Cause) -> None:
        super().__init__(cause.text)
        self.cause = cause


class Answer(NamedTuple):
    """A message that goes back."""

    type: MailboxType
    body: bytes


def refuse(kind: MailboxType, request: bytes, cause: Cause, text: str = "") -> Answer:
    """Return the error that answers a request.

    Args:
        kind: Its protocol.
        request: What it holds behind the mailbox header.
        cause: Why it is refused.
        text: More than *cause* says, where the protocol has room for words.
    """
    error_replier = _REFUSERS.get(kind)
    if error_replier is None:
        return mailbox_error(cause.mailbox)
    body = error_replier(request, cause, text or cause.text)
    return mailbox_error(cause.mailbox) if body is None else Answer(kind, body)


def mailbox_error(detail: int) -> Answer:
    """Return an error of the mailbox itself."""
    return Answer(MailboxType.ERR, MailboxErrorReply(detail=detail).encode())


def _refuse_coe(request: bytes, cause: Cause, text: str) -> bytes | None:
    del text
    if len(request) < CoeHeader.SIZE:
        return None
    code, service = cause.sdo, request[1] >> 4
    if service == CoeService.SDO_INFORMATION:
        body = SdoInfoHeader(SdoInfoOpcode.ERROR).encode() + InfoError(code).encode()
        return encode_coe(CoeService.SDO_INFORMATION, body)
    if service != CoeService.SDO_REQUEST:
        return None
    subindex = request[_SUBINDEX] if len(request) > _SUBINDEX else 0
    return encode_abort(int.from_bytes(request[3:_SUBINDEX], "little"), subindex, code)


def _refuse_foe(request: bytes, cause: Cause, text: str) -> bytes | None:
    words = text.encode() + b"\0"
    if not request:
        return None
    if cause in _ASK_AGAIN:  # no end of the transfer, only of patience
        return encode_foe(FoeOpcode.BUSY, _NOT_BEGUN.number, words)
    return encode_foe(FoeOpcode.ERROR, cause.foe, words)


def _refuse_soe(request: bytes, cause: Cause, text: str) -> bytes | None:
    del text
    opcode = request[0] & 0x07 if len(request) >= SoeHeader.SIZE else 0
    if opcode not in {SoeOpcode.READ_REQUEST, SoeOpcode.WRITE_REQUEST}:
        return None
    return encode_soe(
        SoeOpcode(opcode + 1),
        int.from_bytes(request[2:4], "little"),
        cause.soe.to_bytes(2, "little"),
        drive=request[0] >> 5,
        elements=request[1],
        error=True,
    )


def _refuse_aoe(request: bytes, cause: Cause, text: str) -> bytes | None:
    del text
    try:
        asked = AmsHeader.decode(request)
    except CodecError:
        return None
    return response_to(asked, AmsAnswer(error_code=cause.ads))


_REFUSERS = {
    MailboxType.AOE: _refuse_aoe,
    MailboxType.COE: _refuse_coe,
    MailboxType.FOE: _refuse_foe,
    MailboxType.SOE: _refuse_soe,
}
