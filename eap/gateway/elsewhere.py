"""Slaves of other stations: mailbox requests as operations of ADS, and refusals the other way.

On the way to another station a whole SDO, IDN or block of a file is one request by AoE (ETG.1020);
what comes back of a refusal is an error of ADS, which is told in the code of the protocol that
comes nearest.
"""

from __future__ import annotations

from eap.aoe.ads_operation import Read, ReadWrite, Write
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.coe import CoeService
from eap.codec.foe import FoeOpcode, encode_message, name_of
from eap.codec.mailbox import MailboxType
from eap.codec.sdo import encode_abort
from eap.codec.sdoinfo import EntryRequest, ListRequest, ObjectRequest, SdoInfoHeader, SdoInfoOpcode
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.errors import EapError
from eap.gateway.error_table import Cause, cause_of_result
from eap.od.abort import AbortCode

ROOM = 0x20002
"""Octets of the longest answer: a list of all indexes there can be."""
_COMPLETE = 0x100
_RESPONSES = {
    SoeOpcode.READ_REQUEST: SoeOpcode.READ_RESPONSE,
    SoeOpcode.WRITE_REQUEST: SoeOpcode.WRITE_RESPONSE,
}


class ElsewhereError(EapError):
    """Who was asked elsewhere refused, or could not be asked; *result* is an error of ADS."""

    def __init__(self, result: int) -> None:
        super().__init__(AdsError.words_of(result))
        self.result = result


def reason_for(result: int) -> Cause | None:
    """Return why nobody answered, None if it was the slave that refused."""
    cause = cause_of_result(result)
    return None if cause.is_from_slave else cause


def abort_for(result: int) -> AbortCode:
    """Return the SDO abort code that comes nearest to a refusal by ADS."""
    cause = cause_of_result(result)
    return cause.sdo if cause.is_from_slave else AbortCode.GENERAL


def refusal_for(kind: MailboxType, request: bytes, result: int) -> bytes | None:
    """Return the message by which a slave itself would refuse, as *result* says.

    Args:
        kind: The protocol.
        request: What is refused.
        result: Of ADS, one without a reason.

    Returns:
        None if there is no such message.
    """
    match kind:
        case MailboxType.COE if len(request) > 5 and request[1] >> 4 == CoeService.SDO_REQUEST:
            index, subindex = int.from_bytes(request[3:5], "little"), request[5]
            return encode_abort(index, subindex, abort_for(result))
        case MailboxType.SOE:
            head = SoeHeader.decode(request)
            if head.opcode in _RESPONSES:
                opcode, code = _RESPONSES[head.opcode], cause_of_result(result).soe
                told = SoeHeader(opcode, 0, 1, head.drive, head.elements, head.idn)
                return told.encode() + code.to_bytes(2, "little")
        case MailboxType.FOE:
            error = cause_of_result(result).foe
            text = f"{name_of(error)}: ADS error 0x{result:x} ({AdsError.name_of(result)})"
            return encode_message(FoeOpcode.ERROR, error, text.encode())
    return None


def sdo_offset(index: int, subindex: int, *, complete: bool) -> int:
    """Return the offset that names an entry, or with *complete* an object from subindex 0 on."""
    return index << 16 | (_COMPLETE if complete else subindex)


def info_query(body: bytes) -> tuple[SdoInfoOpcode, Read] | None:
    """Return what asks for SDO information, and the opcode of the answer; None for no request.

    Args:
        body: Of the message, behind its CoE header.

    Raises:
        CodecError: it is cut, or of no known kind.
    """
    asked = body[SdoInfoHeader.SIZE :]
    match SdoInfoHeader.decode(body).opcode:
        case SdoInfoOpcode.LIST_REQUEST:
            offset = ListRequest.decode(asked).list_type << 16
            return SdoInfoOpcode.LIST_RESPONSE, Read(IndexGroup.OBJECT_LIST, offset, ROOM)
        case SdoInfoOpcode.OBJECT_REQUEST:
            offset = ObjectRequest.decode(asked).index << 16
            return SdoInfoOpcode.OBJECT_RESPONSE, Read(IndexGroup.OBJECT_DESCRIPTION, offset, ROOM)
        case SdoInfoOpcode.ENTRY_REQUEST:
            entry = EntryRequest.decode(asked)
            offset = entry.index << 16 | entry.value_info << 8 | entry.subindex
            return SdoInfoOpcode.ENTRY_RESPONSE, Read(IndexGroup.ENTRY_DESCRIPTION, offset, ROOM)
    return None


def idn_query(head: SoeHeader, data: bytes | None = None) -> Read | Write:
    """Return what reads the elements that *head* names, or with *data* writes them."""
    offset = head.drive << 24 | head.elements << 16 | head.idn
    if data is None:
        return Read(IndexGroup.SOE, offset, ROOM)
    return Write(IndexGroup.SOE, offset, data)


def vendor_query(body: bytes) -> ReadWrite:
    """Return what brings a message of VoE, and its answer."""
    return ReadWrite(IndexGroup.VOE, 0, ROOM, body)
