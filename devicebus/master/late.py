"""Which replies answer the request that waits now, and which an earlier or the next one.

The counter of a reply says nothing about its request.  After a time-out requests therefore carry a
tag in the address field, which slaves echo; with one that does not, the first reply that would
have answered what timed out is taken for late.

A slave may send the next fragment of an answer before anybody listens for it: it is kept.
"""

from __future__ import annotations

from collections import deque

from devicebus.mailbox.conversation import MailboxRequest
from devicebus.mailbox.match import answers, has_more, is_aoe_fragment
from eap.codec.ams import AmsHeader, StateFlags
from eap.codec.coe import CoeHeader, CoeService
from eap.codec.eoe import EoeHeader, EoeType
from eap.codec.mailbox import MailboxHeader, MailboxType
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.errors import CodecError

_COE_UNASKED = frozenset(
    (CoeService.EMERGENCY, CoeService.TX_PDO, CoeService.TX_PDO_REMOTE_REQUEST)
)
_SOE_UNASKED = frozenset((SoeOpcode.NOTIFICATION, SoeOpcode.EMERGENCY))
_TAG = 0x8000
_TAGS = 0x3FFF
MAX_KEPT = 64
"""Fragments that are kept at most."""


class ReplyJudge:
    """Tags the requests of one protocol to one slave and judges what comes back."""

    def __init__(self, kind: MailboxType) -> None:
        self._kind = kind
        self._kept: deque[bytes] = deque()
        self._has_more = False
        self._tag = 0
        self._echoes = False
        self._expired: list[MailboxRequest] = []
        self._suspected = False

    def next_address(self) -> int:
        """Return the address field of the next request: 0 until something has timed out."""
        self._suspected = self._has_more = False
        self._kept.clear()
        if self._tag:
            self._tag = _TAG | (self._tag + 1 & _TAGS)
        return self._tag

    def expire(self, ask: MailboxRequest) -> None:
        """The request that waited has timed out: its reply may still come."""
        if not self._suspected:
            self._expired.append(ask)
        self._tag = self._tag or _TAG

    def took(self, data: bytes) -> None:
        """A part was sent or handed to whoever waits for it: what belongs to it may follow."""
        self._has_more = has_more(self._kind, data)

    def keep(self, data: bytes) -> bool:
        """Keep a fragment that nobody listens for yet; say whether the message is one."""
        is_next = self._has_more and not is_unsolicited(self._kind, data)
        if not is_next or len(self._kept) >= MAX_KEPT:
            return False
        self._kept.append(data)
        self._has_more = has_more(self._kind, data)
        return True

    def take_kept(self, ask: MailboxRequest) -> bytes | None:
        """Return the fragment that *ask* listens for, if it was kept."""
        while self._kept:
            data = self._kept.popleft()
            if answers(ask.type, ask.request, data):
                return data
        return None

    def answers(self, header: MailboxHeader, data: bytes, ask: MailboxRequest) -> bool:
        """Whether a message is the reply that *ask* waits for."""
        if header.type == MailboxType.ERR or _fits(header, data, ask):
            return not self._is_late(header, data)
        self._forget(header, data)
        return False

    def _is_late(self, header: MailboxHeader, data: bytes) -> bool:
        if not self._tag:
            return False
        if header.address == self._tag:
            self._echoes = True
            self._expired.clear()
            return False
        if self._echoes or header.address & _TAG:
            return True
        self._suspected = self._forget(header, data)
        return self._suspected

    def _forget(self, header: MailboxHeader, data: bytes) -> bool:
        """The reply to what had timed out is there; say whether there was such a thing."""
        for ask in self._expired:
            if header.type == MailboxType.ERR or _fits(header, data, ask):
                self._expired.remove(ask)
                return True
        return False


def _fits(header: MailboxHeader, data: bytes, ask: MailboxRequest) -> bool:
    return header.type == ask.type and answers(ask.type, ask.request, data)


def is_unsolicited(kind: MailboxType, data: bytes) -> bool:
    """Whether a message is of a kind that slaves send unasked; what else comes unasked is late."""
    try:
        match kind:
            case MailboxType.COE:
                return CoeHeader.decode(data).service in _COE_UNASKED
            case MailboxType.SOE:
                return SoeHeader.decode(data).opcode in _SOE_UNASKED
            case MailboxType.EOE:
                return EoeHeader.decode(data).type == EoeType.FRAGMENT
            case MailboxType.AOE:
                is_response = AmsHeader.decode(data).state_flags & StateFlags.RESPONSE
                return not is_response and not is_aoe_fragment(data)
    except CodecError:
        return False
    return kind is MailboxType.VOE
