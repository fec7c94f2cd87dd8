"""Matching of a slave's replies to requests, by their content alone (ETG.1000.6).

The mailbox counter cannot match them: a reply carries the slave's own sequence.  A reply that is
too short to identify matches any request of its protocol, so that the conversation reports the
defect instead of a time-out.  A conversation that listens for fragments passes a shortened request:
it holds only the fields that fragments repeat.
"""

from __future__ import annotations

from collections.abc import Callable

from eap.codec.ams import AmsCommand, AmsHeader, StateFlags
from eap.codec.coe import (
    CoeHeader,
    CoeService,
    SdoHeader,
    SdoInfoHeader,
    SdoInfoOpcode,
    SdoRequest,
    SdoResponse,
)
from eap.codec.eoe import EoeHeader
from eap.codec.foe import FoeHeader, FoeOpcode
from eap.codec.mailbox import MailboxType, VoeHeader
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.errors import CodecError

INFO_START = CoeHeader.SIZE + SdoInfoHeader.SIZE
"""Offset of the body in an SDO information message."""
_FRAGMENT = AmsCommand.FRAGMENT.to_bytes(2, "little")
_AMS_REST = 16
_SDO_END = CoeHeader.SIZE + SdoHeader.SIZE
# Length of the request's body that the answer repeats: list type, index, index and subindex.
_INFO_KEYS: dict[int, int] = {
    SdoInfoOpcode.LIST_REQUEST: 2,
    SdoInfoOpcode.OBJECT_REQUEST: 2,
    SdoInfoOpcode.ENTRY_REQUEST: 3,
}
_PDO_NUMBER = 0x01FF
_REMOTE: dict[int, int] = {
    CoeService.TX_PDO_REMOTE_REQUEST: CoeService.TX_PDO,
    CoeService.RX_PDO_REMOTE_REQUEST: CoeService.RX_PDO,
}
_SDO_ANSWER: dict[int, int] = {
    SdoRequest.DOWNLOAD: SdoResponse.DOWNLOAD,
    SdoRequest.UPLOAD: SdoResponse.UPLOAD,
    SdoRequest.DOWNLOAD_SEGMENT: SdoResponse.DOWNLOAD_SEGMENT,
    SdoRequest.UPLOAD_SEGMENT: SdoResponse.UPLOAD_SEGMENT,
}
_SEGMENTS = frozenset((SdoRequest.DOWNLOAD_SEGMENT, SdoRequest.UPLOAD_SEGMENT))


def _service(data: bytes) -> int:
    return data[1] >> 4 if len(data) >= CoeHeader.SIZE else 0


def _answers_coe(request: bytes, reply: bytes) -> bool:
    requested, found = _service(request), _service(reply)
    if requested in {CoeService.SDO_REQUEST, CoeService.SDO_INFORMATION}:
        if len(request) == CoeHeader.SIZE:
            return False
        if requested == CoeService.SDO_REQUEST:
            return _answers_sdo(request, reply)
        return found == requested and _answers_info(request, reply)
    number = int.from_bytes(request[:2], "little") & _PDO_NUMBER
    is_same = int.from_bytes(reply[:2], "little") & _PDO_NUMBER == number
    return found == _REMOTE.get(requested) and is_same


def _answers_sdo(request: bytes, reply: bytes) -> bool:
    specifier = request[2] >> 5
    if specifier not in _SDO_ANSWER:
        return False
    is_segment = specifier in _SEGMENTS
    service = _service(reply)
    found = reply[2] >> 5 if len(reply) > CoeHeader.SIZE else None
    if found == SdoResponse.ABORT and len(reply) >= _SDO_END:
        # A segment has no index, so an abort during a segment may carry another index.
        is_sdo = service in {CoeService.SDO_REQUEST, CoeService.SDO_RESPONSE}
        return is_sdo and (is_segment or reply[3:6] == request[3:6])
    if service != CoeService.SDO_RESPONSE:
        return False
    fits = found == _SDO_ANSWER[specifier]
    if is_segment:
        return found is None or (fits and (reply[2] ^ request[2]) & 0x10 == 0)
    return len(reply) < _SDO_END or (fits and reply[3:6] == request[3:6])


def _answers_info(request: bytes, reply: bytes) -> bool:
    if len(reply) < INFO_START:
        return True
    opcode, found = request[2] & 0x7F, reply[2] & 0x7F
    # An error repeats neither opcode nor index of its request.
    if found == SdoInfoOpcode.ERROR:
        return True
    key = request[INFO_START : INFO_START + _INFO_KEYS.get(opcode, 0)]
    return found == opcode + 1 and reply.startswith(key, INFO_START)


def _answers_foe(request: bytes, reply: bytes) -> bool:
    # ERROR and BUSY carry no packet number that would tell a late one.
    if len(reply) < FoeHeader.SIZE or reply[0] in {FoeOpcode.ERROR, FoeOpcode.BUSY}:
        return True
    requested, found = request[0], reply[0]
    number = int.from_bytes(reply[2:6], "little")
    sent = int.from_bytes(request[2:6], "little")
    if requested in {FoeOpcode.READ, FoeOpcode.ACK}:
        # Packets above 1 in answer to a read request belong to the transfer before: late, not
        # wrong. A repeated reply has the number of the packet before; any other number is an error.
        is_late = number > 1 if requested == FoeOpcode.READ else number == sent
        return found == FoeOpcode.DATA and not is_late
    if requested == FoeOpcode.BUSY:  # BUSY requests the same packet again
        return found == FoeOpcode.DATA
    if requested == FoeOpcode.WRITE:
        return found == FoeOpcode.ACK and number == 0
    # An ACK of the packet before is a repetition; other wrong numbers go to the conversation, which
    # reports them.
    return requested == FoeOpcode.DATA and found == FoeOpcode.ACK and number != sent - 1


def _answers_soe(request: bytes, reply: bytes) -> bool:
    if len(reply) < SoeHeader.SIZE:
        return True
    if reply[0] & 0xE7 != (request[0] & 0xE7) + 1:  # opcode and drive
        return False
    is_incomplete, is_error = reply[0] & 0x08, reply[0] & 0x10
    # Fragments carry the number of fragments left in place of the IDN.
    may_lack_idn = is_incomplete or (is_error and reply[0] & 0x07 == SoeOpcode.WRITE_RESPONSE)
    return bool(may_lack_idn) or reply.startswith(request[2:4], 2)


def _answers_aoe(request: bytes, reply: bytes) -> bool:
    try:
        requested, found = AmsHeader.decode(request), AmsHeader.decode(reply)
    except CodecError:
        return True
    if (found.source, found.source_port) != (requested.target, requested.target_port):
        return False
    if is_aoe_fragment(reply):
        return _continues_aoe(requested, found, reply[AmsHeader.SIZE :])
    is_response = bool(found.state_flags & StateFlags.RESPONSE)
    return is_response and (found.invoke_id, found.command) == (
        requested.invoke_id,
        requested.command,
    )


def _continues_aoe(requested: AmsHeader, found: AmsHeader, body: bytes) -> bool:
    if requested.command == AmsCommand.FRAGMENT:  # the acknowledgement of the fragment before
        return found.invoke_id == requested.invoke_id + 1
    if found.invoke_id & 0xFFFF or len(body) < _AMS_REST:
        return True
    # The first fragment begins with the original AMS header from offset 16 (the command) on.
    is_response = body[2] & StateFlags.RESPONSE
    keys = int.from_bytes(body[:2], "little"), int.from_bytes(body[12:16], "little")
    return bool(is_response) and keys == (requested.command, requested.invoke_id)


def _answers_eoe(request: bytes, reply: bytes) -> bool:
    # The type of a response is that of its request plus 1; it repeats no other field.
    return len(reply) < EoeHeader.SIZE or reply[0] & 0x0F == (request[0] & 0x0F) + 1


def _answers_voe(request: bytes, reply: bytes) -> bool:
    # VoE defines vendor id and vendor type only; the rest has no known request number.
    return reply.startswith(request[: VoeHeader.SIZE])


_ANSWERS: dict[MailboxType, Callable[[bytes, bytes], bool]] = {
    MailboxType.AOE: _answers_aoe,
    MailboxType.EOE: _answers_eoe,
    MailboxType.COE: _answers_coe,
    MailboxType.FOE: _answers_foe,
    MailboxType.SOE: _answers_soe,
    MailboxType.VOE: _answers_voe,
}
# Minimum length of a request that can be answered.
_SHORTEST = {
    MailboxType.EOE: 1,
    MailboxType.COE: CoeHeader.SIZE,
    MailboxType.FOE: FoeHeader.SIZE,
    MailboxType.SOE: 1,
}


def answers(kind: MailboxType, request: bytes, reply: bytes) -> bool:
    """Return true if *reply* answers *request*, both of one protocol, without mailbox header."""
    if len(request) < _SHORTEST.get(kind, 0):
        return False
    return kind in _ANSWERS and _ANSWERS[kind](request, reply)


def has_more(kind: MailboxType, reply: bytes) -> bool:
    """Return true if fragments may follow *reply*; AoE does not mark its last fragment."""
    match kind:
        case MailboxType.COE:
            is_info = len(reply) >= INFO_START and _service(reply) == CoeService.SDO_INFORMATION
            return is_info and reply[4:6] != b"\0\0"
        case MailboxType.SOE:
            return len(reply) >= SoeHeader.SIZE and bool(reply[0] & 0x08)
        case MailboxType.AOE:
            return is_aoe_fragment(reply)
    return False


def is_aoe_fragment(reply: bytes) -> bool:
    """Return true if *reply* is an AoE fragment, and not the acknowledgement of one."""
    flags = int.from_bytes(reply[18:20], "little")
    return reply[16:18] == _FRAGMENT and not flags & StateFlags.RESPONSE
