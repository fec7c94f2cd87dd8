"""Which message of a slave answers which request, told by nothing but their bytes (ETG.1000.6).

Whatever is too short to say what it is answers any request of its protocol: the conversation then
says what is missing, instead of waiting for nothing.  Who listens for the fragments of an answer
gives a request that is cut: it names only what those repeat, and the more it is cut, the more
answers it.
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
"""Where the body of an SDO information message begins."""
_FRAGMENT = AmsCommand.FRAGMENT.to_bytes(2, "little")
_AMS_REST = 16
_SDO_END = CoeHeader.SIZE + SdoHeader.SIZE
_INFO_KEYS: dict[int, int] = {
    SdoInfoOpcode.LIST_REQUEST: 2,
    SdoInfoOpcode.OBJECT_REQUEST: 2,
    SdoInfoOpcode.ENTRY_REQUEST: 3,
}
"""Bytes of a request's body that its answer repeats: list, index, or index and subindex."""
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
    asked, found = _service(request), _service(reply)
    if asked in {CoeService.SDO_REQUEST, CoeService.SDO_INFORMATION}:
        if len(request) == CoeHeader.SIZE:
            return False
        if asked == CoeService.SDO_REQUEST:
            return _answers_sdo(request, reply)
        return found == asked and _answers_info(request, reply)
    number = int.from_bytes(request[:2], "little") & _PDO_NUMBER
    is_same = int.from_bytes(reply[:2], "little") & _PDO_NUMBER == number
    return found == _REMOTE.get(asked) and is_same


def _answers_sdo(request: bytes, reply: bytes) -> bool:
    specifier = request[2] >> 5
    if specifier not in _SDO_ANSWER:
        return False
    is_segment = specifier in _SEGMENTS
    service = _service(reply)
    found = reply[2] >> 5 if len(reply) > CoeHeader.SIZE else None
    if found == SdoResponse.ABORT and len(reply) >= _SDO_END:
        # A segment has no index: whoever has to abort at one may not know it either.
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
    if found == SdoInfoOpcode.ERROR:
        return True
    key = request[INFO_START : INFO_START + _INFO_KEYS.get(opcode, 0)]
    return found == opcode + 1 and reply.startswith(key, INFO_START)


def _answers_foe(request: bytes, reply: bytes) -> bool:
    if len(reply) < FoeHeader.SIZE or reply[0] in {FoeOpcode.ERROR, FoeOpcode.BUSY}:
        return True
    asked, found = request[0], reply[0]
    number = int.from_bytes(reply[2:6], "little")
    sent = int.from_bytes(request[2:6], "little")
    if asked in {FoeOpcode.READ, FoeOpcode.ACK}:
        # What follows packet 1 belongs to a transfer before this one: late, and not wrong.
        # The number before comes twice when a reply is repeated; any other is wrong, not late.
        is_late = number > 1 if asked == FoeOpcode.READ else number == sent
        return found == FoeOpcode.DATA and not is_late
    if asked == FoeOpcode.BUSY:  # "send that packet once more, later"
        return found == FoeOpcode.DATA
    if asked == FoeOpcode.WRITE:
        return found == FoeOpcode.ACK and number == 0
    return asked == FoeOpcode.DATA and found == FoeOpcode.ACK and number != sent - 1


def _answers_soe(request: bytes, reply: bytes) -> bool:
    if len(reply) < SoeHeader.SIZE:
        return True
    if reply[0] & 0xE7 != (request[0] & 0xE7) + 1:  # opcode and drive
        return False
    is_incomplete, is_error = reply[0] & 0x08, reply[0] & 0x10
    # Fragments have no IDN, neither those of an answer nor those that a drive refuses.
    may_lack_idn = is_incomplete or (is_error and reply[0] & 0x07 == SoeOpcode.WRITE_RESPONSE)
    return bool(may_lack_idn) or reply.startswith(request[2:4], 2)


def _answers_aoe(request: bytes, reply: bytes) -> bool:
    try:
        asked, found = AmsHeader.decode(request), AmsHeader.decode(reply)
    except CodecError:
        return True
    if (found.source, found.source_port) != (asked.target, asked.target_port):
        return False
    if is_aoe_fragment(reply):
        return _continues_aoe(asked, found, reply[AmsHeader.SIZE :])
    is_response = bool(found.state_flags & StateFlags.RESPONSE)
    return is_response and (found.invoke_id, found.command) == (asked.invoke_id, asked.command)


def _continues_aoe(asked: AmsHeader, found: AmsHeader, body: bytes) -> bool:
    if asked.command == AmsCommand.FRAGMENT:  # the acknowledgement of the fragment before
        return found.invoke_id == asked.invoke_id + 1
    if found.invoke_id & 0xFFFF or len(body) < _AMS_REST:
        return True
    # The first fragment begins with the header that it had as a whole, from the command on.
    is_response = body[2] & StateFlags.RESPONSE
    keys = int.from_bytes(body[:2], "little"), int.from_bytes(body[12:16], "little")
    return bool(is_response) and keys == (asked.command, asked.invoke_id)


def _answers_eoe(request: bytes, reply: bytes) -> bool:
    # Every response is numbered one higher than its request, and names no more than that.
    return len(reply) < EoeHeader.SIZE or reply[0] & 0x0F == (request[0] & 0x0F) + 1


def _answers_voe(request: bytes, reply: bytes) -> bool:
    return reply.startswith(request[: VoeHeader.SIZE])


_ANSWERS: dict[MailboxType, Callable[[bytes, bytes], bool]] = {
    MailboxType.AOE: _answers_aoe,
    MailboxType.EOE: _answers_eoe,
    MailboxType.COE: _answers_coe,
    MailboxType.FOE: _answers_foe,
    MailboxType.SOE: _answers_soe,
    MailboxType.VOE: _answers_voe,
}
_SHORTEST = {
    MailboxType.EOE: 1,
    MailboxType.COE: CoeHeader.SIZE,
    MailboxType.FOE: FoeHeader.SIZE,
    MailboxType.SOE: 1,
}
"""Bytes of a request without which it asks nothing."""


def answers(kind: MailboxType, request: bytes, reply: bytes) -> bool:
    """Say whether *reply* answers *request*, both of one protocol and without mailbox header."""
    if len(request) < _SHORTEST.get(kind, 0):
        return False
    return kind in _ANSWERS and _ANSWERS[kind](request, reply)


def has_more(kind: MailboxType, reply: bytes) -> bool:
    """Say whether fragments may follow a message; only the last one of AoE does not tell."""
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
    """Say whether a packet is a part of another one, and not the acknowledgement of one."""
    flags = int.from_bytes(reply[18:20], "little")
    return reply[16:18] == _FRAGMENT and not flags & StateFlags.RESPONSE
