"""Transfers that take several messages: which of a client's requests belong together (ETG.1000.6).

While a transfer runs, the slave's server for its protocol belongs to one client: a segment or a
packet of somebody else would end up in the wrong file.  Whether it runs is told by nothing but the
octets of requests and replies, so any client and any slave can be followed.
"""

from __future__ import annotations

from typing import Protocol

from devicebus.mailbox.match import has_more
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import CoeHeader, CoeService
from eap.codec.eoe import EoeType
from eap.codec.foe import DATA_OVERHEAD, FoeHeader, FoeOpcode
from eap.codec.mailbox import MailboxType
from eap.codec.sdo import SdoHeader, SdoRequest, SdoResponse
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.gateway.aoe_course import AoeCourse

_SDO_DATA = CoeHeader.SIZE + SdoHeader.SIZE
"""Where the data of a normal SDO begins."""
_SDO_SEGMENTS = frozenset((SdoRequest.DOWNLOAD_SEGMENT, SdoRequest.UPLOAD_SEGMENT))
_EXPEDITED, _LAST = 0x02, 0x01
_BEFORE_FOE = DATA_OVERHEAD - FoeHeader.SIZE
_SOE_INCOMPLETE = 0x08


class Course(Protocol):
    """How far the transfers of one protocol are, of one client with one slave.

    Attributes:
        is_running: Whether more requests belong to what was begun.
    """

    is_running: bool

    def ask(self, body: bytes) -> bool:
        """Note a request; return whether the slave answers it at all."""

    def answer(self, body: bytes) -> None:
        """Note a reply."""

    def is_step(self, body: bytes) -> bool:
        """Say whether a request goes on with a transfer, and is known to be repeated if it is."""


class Transfer:
    """What one client has under way with one slave in one protocol.

    Args:
        kind: The protocol.
        sizes: Of the slave's mailboxes; those count that are in force when a message comes.
    """

    def __init__(self, kind: MailboxType, sizes: MailboxSizes) -> None:
        self._kind = kind
        self._course = _course(kind, sizes)
        self._request = b""
        self._is_done = self._is_busy = False

    @property
    def is_running(self) -> bool:
        """Whether the slave's server still belongs to this client."""
        return self._course.is_running

    def is_repeated(self, body: bytes) -> bool:
        """Say whether a request is the last step once more, whose reply got lost on its way.

        A slave would refuse it: to a slave every packet has come once.  After BUSY it is none,
        that is how a client asks whether the slave has time now.
        """
        is_same = body == self._request and self._is_done and not self._is_busy
        return is_same and self._course.is_step(body)

    def ask(self, body: bytes) -> bool:
        """Begin or go on with a request; return whether the slave answers it at all."""
        self._request = body
        self._is_busy = False
        is_answered = self._course.ask(body)
        self._is_done = not is_answered
        return is_answered

    def answer(self, body: bytes) -> None:
        """Note a reply to the last request."""
        self._is_done = True
        self._is_busy = is_busy(body) if isinstance(self._course, _Foe) else False
        self._course.answer(body)

    def has_more(self, reply: bytes) -> bool:
        """Say whether the slave sends more behind its last reply, by itself."""
        if isinstance(self._course, AoeCourse):
            return self._course.has_more
        return has_more(self._kind, reply)

    @property
    def whole(self) -> bytes:
        """By what the answer to the fragments that came is known, the last one now; or nothing."""
        return self._course.whole if isinstance(self._course, AoeCourse) else b""

    def end(self) -> None:
        """Note that nothing is under way any more, whatever was."""
        self._is_done = False
        self._course.is_running = False


def is_busy(body: bytes) -> bool:
    """Say whether a message of FoE tells the client to ask again."""
    return body[:1] == bytes((FoeOpcode.BUSY,))


def _course(kind: MailboxType, sizes: MailboxSizes) -> Course:
    match kind:
        case MailboxType.COE:
            return _Coe()
        case MailboxType.FOE:
            return _Foe(sizes)
        case MailboxType.SOE:
            return _Soe()
        case MailboxType.AOE:
            return AoeCourse()
        case MailboxType.EOE:
            return _Eoe()
    return _Single()


class _Single:
    """A request and a reply."""

    def __init__(self) -> None:
        self.is_running = False

    def ask(self, body: bytes) -> bool:
        del body
        return True

    def answer(self, body: bytes) -> None:
        del body

    def is_step(self, body: bytes) -> bool:
        del body
        return False


class _Coe(_Single):
    """SDOs in segments; whatever else there is begins and ends with one request."""

    def __init__(self) -> None:
        super().__init__()
        self._goes_on = False

    def ask(self, body: bytes) -> bool:
        self._goes_on = False
        service = _coe_service(body)
        if service != CoeService.SDO_REQUEST or len(body) <= CoeHeader.SIZE:
            self.is_running = False
            return service not in {CoeService.TX_PDO, CoeService.RX_PDO, CoeService.EMERGENCY}
        command = body[CoeHeader.SIZE]
        specifier = command >> 5
        if specifier == SdoRequest.ABORT:
            self.is_running = False
            return False
        if specifier == SdoRequest.DOWNLOAD:
            self._goes_on = not command & _EXPEDITED and _size(body) > len(body) - _SDO_DATA
        elif specifier == SdoRequest.DOWNLOAD_SEGMENT:
            self._goes_on = not command & _LAST
        return True

    def answer(self, body: bytes) -> None:
        self.is_running = False
        if _coe_service(body) != CoeService.SDO_RESPONSE or len(body) <= CoeHeader.SIZE:
            return
        command = body[CoeHeader.SIZE]
        specifier = command >> 5
        if specifier == SdoResponse.UPLOAD:
            self.is_running = not command & _EXPEDITED and _size(body) > len(body) - _SDO_DATA
        elif specifier == SdoResponse.UPLOAD_SEGMENT:
            self.is_running = not command & _LAST
        elif specifier in {SdoResponse.DOWNLOAD, SdoResponse.DOWNLOAD_SEGMENT}:
            self.is_running = self._goes_on

    def is_step(self, body: bytes) -> bool:
        is_sdo = _coe_service(body) == CoeService.SDO_REQUEST and len(body) > CoeHeader.SIZE
        return is_sdo and body[CoeHeader.SIZE] >> 5 in _SDO_SEGMENTS


class _Foe(_Single):
    """Files; a packet that does not fill the mailbox is the last one."""

    def __init__(self, sizes: MailboxSizes) -> None:
        super().__init__()
        self._sizes = sizes
        self._is_last = False

    def ask(self, body: bytes) -> bool:
        opcode = body[0] if body else 0
        if opcode == FoeOpcode.ACK and self._is_last:
            self.is_running = False
            return False
        if opcode == FoeOpcode.ERROR:
            self.is_running = False
            return False
        self._is_last = opcode == FoeOpcode.DATA and len(body) < self._sizes.to_slave - _BEFORE_FOE
        return True

    def answer(self, body: bytes) -> None:
        opcode = body[0] if body else 0
        if opcode == FoeOpcode.DATA:
            self._is_last = len(body) < self._sizes.to_master - _BEFORE_FOE
            self.is_running = True
        elif opcode == FoeOpcode.ACK:
            self.is_running = not self._is_last
        else:
            self.is_running = opcode == FoeOpcode.BUSY

    def is_step(self, body: bytes) -> bool:
        return body[:1] in {bytes((FoeOpcode.DATA,)), bytes((FoeOpcode.ACK,))}


class _Soe(_Single):
    """Written elements that come in fragments; only the last of these is answered."""

    def ask(self, body: bytes) -> bool:
        is_write = len(body) >= SoeHeader.SIZE and body[0] & 0x07 == SoeOpcode.WRITE_REQUEST
        self.is_running = is_write and bool(body[0] & _SOE_INCOMPLETE)
        return not self.is_running

    def answer(self, body: bytes) -> None:
        self.is_running = False


class _Eoe(_Single):
    """Settings are answered, and what is no message at all; Ethernet frames are not."""

    def ask(self, body: bytes) -> bool:
        return not body or body[0] & 0x0F in _EOE_REQUESTS


_EOE_REQUESTS = frozenset(
    (
        EoeType.SET_IP_REQUEST,
        EoeType.SET_FILTER_REQUEST,
        EoeType.GET_IP_REQUEST,
        EoeType.GET_FILTER_REQUEST,
    )
)


def _coe_service(body: bytes) -> int:
    return body[1] >> 4 if len(body) >= CoeHeader.SIZE else 0


def _size(body: bytes) -> int:
    return int.from_bytes(body[_SDO_DATA - 4 : _SDO_DATA], "little")
