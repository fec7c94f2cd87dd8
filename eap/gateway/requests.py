"""Mailbox requests of gateway clients: destination, operation for access rules, errors.

ETG.8200 has station addresses and 0 for the master.  Its implementations add: bit 15 marks an
address as that of a slave, 0xFFFF addresses all of them, and virtual addresses of the plant file
lead to slaves of any station.

Access rules are one list for clients of every transport: a request becomes the operation by which
an ADS client would do the same (ETG.1020).

An error is answered in the protocol of the request, since a tool understands those best: an SDO is
aborted, an IDN refused, a file transfer ended with a text, also for a master or slave that does not
support the protocol.  A mailbox error answers protocols without an error for the
causes of a gateway (VoE, EoE), and messages that are no request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import NamedTuple, TypeAlias

from eap.ads.request import AdsRefusedError, Operation, Read, ReadWrite, Write, parse_request
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.ams import AmsAnswer, AmsHeader, StateFlags, decode_packet, response_to
from eap.codec.coe import (
    CoeHeader,
    CoeService,
    InfoError,
    SdoHeader,
    SdoInfoHeader,
    SdoInfoOpcode,
    SdoRequest,
    encode_abort,
)
from eap.codec.coe import encode_message as encode_coe
from eap.codec.eoe import READS as EOE_READS
from eap.codec.foe import Busy, FoeOpcode
from eap.codec.foe import encode_message as encode_foe
from eap.codec.mailbox import MailboxErrorReply, MailboxType
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.codec.soe import encode_message as encode_soe
from eap.errors import CodecError, EapError
from eap.gateway.error_table import Cause, ads_result
from eap.ids import NetId
from eap.od.abort import SdoAbortError

MASTER_ADDRESS = 0
ALL_SLAVES = 0xFFFF
VIRTUAL_BIT = 0x8000


def address_text(address: int) -> str:
    """Return a mailbox address as plant files write it: 1001, or 0x9001 with bit 15 set."""
    return f"0x{address:04X}" if address & VIRTUAL_BIT else f"{address}"


class MasterAddress(NamedTuple):
    """The dictionary of the master itself."""


class SlaveAddress(NamedTuple):
    """A slave on the gateway's own bus."""

    station: int
    """Its station address."""


class RemoteAddress(NamedTuple):
    """A slave, or with port 0xFFFF the master, of another bus; reached by AoE."""

    net_id: NetId
    port: int


class GroupAddress(NamedTuple):
    """Several slaves that each answer for themselves."""

    members: tuple[int, ...]
    """Station addresses, or virtual ones."""


Destination: TypeAlias = MasterAddress | SlaveAddress | RemoteAddress | GroupAddress


class AddressMap:
    """Destinations of the addresses of a gateway.

    Args:
        virtual: Addresses of the plant file.  They go before station addresses, so that a slave
            that was exchanged can be found where tools look for it; 0 and 0xFFFF stay what they
            are.
    """

    def __init__(
        self, virtual: Mapping[int, SlaveAddress | RemoteAddress | GroupAddress] | None = None
    ) -> None:
        self._virtual = dict(virtual or {})

    def changed(self, other: AddressMap) -> set[int]:
        """Return the virtual addresses that mean something else in *other*."""
        both = self._virtual.keys() | other._virtual.keys()
        return {each for each in both if self._virtual.get(each) != other._virtual.get(each)}

    def resolve(self, address: int, stations: tuple[int, ...]) -> Destination:
        """Return the meaning of *address*; *stations* are the slaves of the bus.

        A station address without a slave is returned as such; the access to it is what fails.
        """
        if address == MASTER_ADDRESS:
            return MasterAddress()
        if address == ALL_SLAVES:
            return GroupAddress(stations)
        # Virtual addresses go first: a slave that was exchanged is found where tools look for it.
        found = self._virtual.get(address)
        if found is not None:
            return found
        # A slave may have a station address with bit 15 set; then the bit is no mark.
        if address & VIRTUAL_BIT and address not in stations:
            return SlaveAddress(address & ~VIRTUAL_BIT)
        return SlaveAddress(address)


_COMPLETE = 0x100
_RAW = ReadWrite(IndexGroup.VOE, 0, 0, b"")
"""Operation whose content is unknown to the gateway."""
# Members of enums are slow to reach.
_SDO_GROUP = IndexGroup.SDO
_INFORMATION, _REQUEST = CoeService.SDO_INFORMATION, CoeService.SDO_REQUEST
_PDOS_READ: dict[int, int] = {
    CoeService.TX_PDO_REMOTE_REQUEST: 0x1A00,
    CoeService.RX_PDO_REMOTE_REQUEST: 0x1600,
}
"""Services that read a PDO, with the first object of its kind (ETG.1000.6)."""
_PDO_NUMBER = 0x01FF
_UPLOAD, _DOWNLOAD = SdoRequest.UPLOAD, SdoRequest.DOWNLOAD
_SDO = frozenset((CoeService.SDO_REQUEST, CoeService.SDO_RESPONSE))
"""Services of CoE whose messages may be aborts."""
_SOE_ERROR = 0x10
_FOE_ERRORS: dict[int, AdsError] = {
    FoeOpcode.BUSY: AdsError.BUSY,
    FoeOpcode.ERROR: AdsError.GENERAL,
}


@lru_cache(1024)  # clients ask for the same again and again
def operation_of(kind: MailboxType, body: bytes) -> Operation | None:
    """Return the operation of a request; None for a step of a transfer, decided at its start."""
    return _PROTOCOLS[kind].operation(body)


def sdo(index: int, subindex: int, *, complete: bool, data: bytes | None = None) -> Operation:
    """Return the upload of an entry or object, or with *data* its download."""
    offset = index << 16 | (_COMPLETE if complete else subindex)
    if data is None:
        return Read(_SDO_GROUP, offset, 0)
    return Write(_SDO_GROUP, offset, data)


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
        return _of_pdo(service, body)
    # Too short for an index: nothing to decide on, and the codec answers with an error.
    if len(body) < CoeHeader.SIZE + 4:
        return None
    command, index, subindex = body[2], body[3] | body[4] << 8, body[5]
    specifier, complete = command >> 5, bool(command & 0x10)
    if specifier == _UPLOAD:
        return sdo(index, subindex, complete=complete)
    if specifier == _DOWNLOAD:
        return sdo(index, subindex, complete=complete, data=_written(body))
    return None


def _of_pdo(service: int, body: bytes) -> Operation:
    """Return the operation of a message that is neither an SDO nor SDO information."""
    if service not in _PDOS_READ:
        return _RAW
    # Rules name a PDO by the object that maps it.
    number = int.from_bytes(body[:2], "little") & _PDO_NUMBER
    return sdo(_PDOS_READ[service] + number, 0, complete=True)


def _written(body: bytes) -> bytes:
    """Return the data of a download, as far as its first message has it."""
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
    is_read = bool(body) and body[0] & 0x0F in EOE_READS
    return Read(IndexGroup.OBJECT_LIST, 0, 0) if is_read else _RAW


def _of_aoe(body: bytes) -> Operation:
    """Return the only operation of an unfragmented packet; other packets are opaque."""
    try:
        header, data = decode_packet(body)
        operations = parse_request(header.command, bytes(data)).operations
    except (CodecError, AdsRefusedError):
        return _RAW
    # A client may acknowledge fragments of an answer; rules cannot see into those.
    is_answer = header.state_flags & StateFlags.RESPONSE
    return operations[0] if len(operations) == 1 and not is_answer else _RAW


def _of_other(_: bytes) -> Operation:
    return _RAW


_NOT_BEGUN = Busy(0, 100)
_SUBINDEX = 5
"""Offset in an SDO request, CoE header included."""

_TEMPORARY = frozenset((Cause.BUSY, Cause.TOO_FAST))


class GatewayError(EapError):
    """A request that the gateway itself refuses."""

    def __init__(self, cause: Cause) -> None:
        super().__init__(cause.text)
        self.cause = cause


class ErrorReply(NamedTuple):
    """Error message in reply to a request."""

    type: MailboxType
    body: bytes


def error_reply(kind: MailboxType, request: bytes, cause: Cause, text: str = "") -> ErrorReply:
    """Return the error that answers a request.

    Args:
        kind: Its protocol.
        request: What it holds behind the mailbox header.
        cause: Why it is refused.
        text: More than *cause* says, where the protocol has room for words.
    """
    body = _PROTOCOLS[kind].error(request, cause, text or cause.text)
    return mailbox_error(cause.mailbox) if body is None else ErrorReply(kind, body)


def mailbox_error(detail: int) -> ErrorReply:
    """Return an error of the mailbox itself."""
    return ErrorReply(MailboxType.ERR, MailboxErrorReply(detail=detail).encode())


def _coe_error(request: bytes, cause: Cause, text: str) -> bytes | None:
    del text
    if len(request) < CoeHeader.SIZE:
        return None
    code, service = cause.sdo, request[1] >> 4
    if service == CoeService.SDO_INFORMATION:
        body = SdoInfoHeader(SdoInfoOpcode.ERROR).encode() + InfoError(code).encode()
        return encode_coe(CoeService.SDO_INFORMATION, body)
    # Emergencies and PDOs are no requests and have no abort.
    if service != CoeService.SDO_REQUEST:
        return None
    subindex = request[_SUBINDEX] if len(request) > _SUBINDEX else 0
    return encode_abort(int.from_bytes(request[3:_SUBINDEX], "little"), subindex, code)


def _foe_error(request: bytes, cause: Cause, text: str) -> bytes | None:
    text_bytes = text.encode() + b"\0"
    if not request:
        return None
    if cause in _TEMPORARY:  # no end of the transfer, only of patience
        return encode_foe(FoeOpcode.BUSY, _NOT_BEGUN.number, text_bytes)
    return encode_foe(FoeOpcode.ERROR, cause.foe, text_bytes)


def _soe_error(request: bytes, cause: Cause, text: str) -> bytes | None:
    del text
    opcode = request[0] & 0x07 if len(request) >= SoeHeader.SIZE else 0
    if opcode not in {SoeOpcode.READ_REQUEST, SoeOpcode.WRITE_REQUEST}:
        return None
    return encode_soe(
        # The response opcode of SoE is that of its request plus one.
        SoeOpcode(opcode + 1),
        int.from_bytes(request[2:4], "little"),
        cause.soe.to_bytes(2, "little"),
        drive=request[0] >> 5,
        elements=request[1],
        error=True,
    )


def _aoe_error(request: bytes, cause: Cause, text: str) -> bytes | None:
    del text
    try:
        # Without a whole AMS header there is no address to answer to.
        header = AmsHeader.decode(request)
    except CodecError:
        return None
    return response_to(header, AmsAnswer(error_code=cause.ads))


def _no_error(*_: object) -> None:
    """Leave the error to the mailbox: the protocol has none for the causes of a gateway."""


def error_in(kind: MailboxType, body: bytes) -> int:
    """Return the error that a slave answered with, as one of ADS; 0 for none."""
    return _PROTOCOLS[kind].result(body)


def _result_of_error_reply(_: bytes) -> int:
    return AdsError.SERVICE


def _result_of_coe(body: bytes) -> int:
    if len(body) < CoeHeader.SIZE + SdoHeader.SIZE:
        return 0
    head = SdoHeader.decode(body, CoeHeader.SIZE)
    # An abort may come with the service of a request or of a response.
    if body[1] >> 4 not in _SDO or head.specifier != SdoRequest.ABORT:
        return 0
    return ads_result(SdoAbortError(head.value, head.index, head.subindex))


def _result_of_soe(body: bytes) -> int:
    return AdsError.GENERAL if len(body) >= SoeHeader.SIZE and body[0] & _SOE_ERROR else 0


def _result_of_foe(body: bytes) -> int:
    return _FOE_ERRORS.get(body[0], 0) if body else 0


def _done(_: bytes) -> int:
    return 0


class ProtocolRules(NamedTuple):
    """Requests and answers of one protocol, as access rules and the audit see them.

    Attributes:
        operation: Returns the operation of a request, None for a step of a transfer.
        error: Returns an error of the gateway in the protocol, None where only a mailbox error
            will do.
        result: Returns the error in the answer of a slave as one of ADS, 0 for none.  A protocol
            without errors of its own has none: a change is recorded as done.
    """

    operation: Callable[[bytes], Operation | None]
    error: Callable[[bytes, Cause, str], bytes | None]
    result: Callable[[bytes], int]


_PROTOCOLS: dict[MailboxType, ProtocolRules] = {
    MailboxType.ERR: ProtocolRules(_of_other, _no_error, _result_of_error_reply),
    MailboxType.AOE: ProtocolRules(_of_aoe, _aoe_error, _done),
    MailboxType.EOE: ProtocolRules(_of_eoe, _no_error, _done),
    MailboxType.COE: ProtocolRules(_of_coe, _coe_error, _result_of_coe),
    MailboxType.FOE: ProtocolRules(_of_foe, _foe_error, _result_of_foe),
    MailboxType.SOE: ProtocolRules(_of_soe, _soe_error, _result_of_soe),
    MailboxType.VOE: ProtocolRules(_of_other, _no_error, _done),
}
