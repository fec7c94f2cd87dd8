"""Mailbox requests as operations, in the terms of access rules (ETG.8200, ETG.1020).

A plant file has one list of rules for clients of every transport: here requests of the mailbox
protocols become the operations by which an ADS client would do the same.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from eap.ads.operation import AdsRefusedError, Operation, Read, ReadWrite, Write
from eap.ads.request import parse_request
from eap.codec.ads import IndexGroup
from eap.codec.ams import StateFlags, decode_packet
from eap.codec.coe import CoeHeader, CoeService, SdoHeader, SdoInfoOpcode, SdoRequest
from eap.codec.eoe import EoeType
from eap.codec.foe import FoeOpcode
from eap.codec.mailbox import MailboxType
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.errors import CodecError

_COMPLETE = 0x100
_RAW = ReadWrite(IndexGroup.VOE, 0, 0, b"")
"""What cannot be looked into."""
# Members of enums are slow to reach.
_SDO = IndexGroup.SDO
_INFORMATION, _REQUEST = CoeService.SDO_INFORMATION, CoeService.SDO_REQUEST
_UPLOAD, _DOWNLOAD = SdoRequest.UPLOAD, SdoRequest.DOWNLOAD
_EOE_READS = frozenset((EoeType.GET_IP_REQUEST, EoeType.GET_FILTER_REQUEST))


@lru_cache(1024)  # clients ask for the same again and again
def operation_of(kind: MailboxType, body: bytes) -> Operation | None:
    """Return what a request does; None for a step of a transfer that was judged at its start."""
    find = _BY_KIND.get(kind)
    return find(body) if find is not None else _RAW


def sdo(index: int, subindex: int, *, complete: bool, data: bytes | None = None) -> Operation:
    """Return the upload of an entry or object, or with *data* its download."""
    offset = index << 16 | (_COMPLETE if complete else subindex)
    if data is None:
        return Read(_SDO, offset, 0)
    return Write(_SDO, offset, data)


def idn(number: int, drive: int, data: bytes | None = None) -> Operation:
    """Return reading an element of an IDN, or with *data* writing it."""
    offset = drive << 24 | number
    if data is None:
        return Read(IndexGroup.SOE, offset, 0)
    return Write(IndexGroup.SOE, offset, data)


def _of_coe(body: bytes) -> Operation | None:
    service = body[1] >> 4 if len(body) >= CoeHeader.SIZE else 0
    if service == _INFORMATION and len(body) > CoeHeader.SIZE:
        return _of_info(body)
    if service != _REQUEST:
        return _RAW
    if len(body) < CoeHeader.SIZE + 4:
        return None
    command, index, subindex = body[2], body[3] | body[4] << 8, body[5]
    specifier, complete = command >> 5, bool(command & 0x10)
    if specifier == _UPLOAD:
        return sdo(index, subindex, complete=complete)
    if specifier == _DOWNLOAD:
        return sdo(index, subindex, complete=complete, data=_written(body))
    return None


def _written(body: bytes) -> bytes:
    """Return what a download writes, as far as its first message has it."""
    start = CoeHeader.SIZE + SdoHeader.SIZE
    if len(body) < start:
        return b""
    head = SdoHeader.decode(body, CoeHeader.SIZE)
    return head.data if head.expedited else body[start:]


def _of_info(body: bytes) -> Operation:
    opcode = body[2] & 0x7F
    index = int.from_bytes(body[6:8], "little") << 16
    if opcode == SdoInfoOpcode.OBJECT_REQUEST:
        return Read(IndexGroup.OBJECT_DESCRIPTION, index, 0)
    if opcode == SdoInfoOpcode.ENTRY_REQUEST:
        return Read(IndexGroup.ENTRY_DESCRIPTION, index | int.from_bytes(body[8:9], "little"), 0)
    return Read(IndexGroup.OBJECT_LIST, index, 0)


def _of_soe(body: bytes) -> Operation:
    if len(body) < SoeHeader.SIZE:
        return _RAW
    opcode, drive, number = body[0] & 0x07, body[0] >> 5, int.from_bytes(body[2:4], "little")
    if opcode == SoeOpcode.READ_REQUEST:
        return idn(number, drive)
    if opcode == SoeOpcode.WRITE_REQUEST:
        return idn(number, drive, body[SoeHeader.SIZE :])
    return _RAW


def _of_foe(body: bytes) -> Operation | None:
    opcode = body[0] if body else 0
    if opcode == FoeOpcode.READ:
        return ReadWrite(IndexGroup.FOE_OPEN_READ, 0, 0, body[6:])
    if opcode == FoeOpcode.WRITE:
        return ReadWrite(IndexGroup.FOE_OPEN_WRITE, 0, 0, body[6:])
    return None


def _of_eoe(body: bytes) -> Operation:
    is_read = bool(body) and body[0] & 0x0F in _EOE_READS
    return Read(IndexGroup.OBJECT_LIST, 0, 0) if is_read else _RAW


def _of_aoe(body: bytes) -> Operation:
    """Return the only operation of a packet in one piece; others cannot be looked into."""
    try:
        header, data = decode_packet(body)
        operations = parse_request(header.command, bytes(data)).operations
    except (CodecError, AdsRefusedError):
        return _RAW
    is_answer = header.state_flags & StateFlags.RESPONSE
    return operations[0] if len(operations) == 1 and not is_answer else _RAW


_BY_KIND: dict[MailboxType, Callable[[bytes], Operation | None]] = {
    MailboxType.COE: _of_coe,
    MailboxType.SOE: _of_soe,
    MailboxType.FOE: _of_foe,
    MailboxType.EOE: _of_eoe,
    MailboxType.AOE: _of_aoe,
}
