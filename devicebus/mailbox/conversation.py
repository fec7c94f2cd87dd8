"""Conversation: a client's side of a mailbox protocol, written as a generator.

    def read_twice() -> Conversation[bytes]:
        first = yield MailboxRequest(MailboxType.COE, request)
        more = yield MailboxRequest(MailboxType.COE, request, listen=True)  # nothing is sent
        return first.data + more.data

The driver (:func:`drive`, :func:`drive_async`, or a master's mailbox) sends the request, waits, and
resumes the generator with the reply.  It throws MailboxTimeoutError when no reply comes and
MailboxRefusedError when the slave answers with a mailbox error, and closes the generator to cancel
it.

:func:`answers` matches a slave's replies to requests, by their content alone (ETG.1000.6).  The
mailbox counter cannot match them: a reply carries the slave's own sequence.  A reply that is too
short to identify matches any request of its protocol, so that the conversation reports the defect
instead of a time-out.  A conversation that listens for fragments passes a shortened request: it
holds only the fields that fragments repeat.

BusError raised by *exchange* of a driver is thrown into the generator, which may handle it: a SoE
procedure command is cleared after a failure, a scan skips a slave that does not answer.  Any other
error, as of a lost engine or a cancelled task, closes the generator and goes to the caller.

The records travel as they are, in MessagePack, between the processes that share a master.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Awaitable, Callable, Generator, Iterator
from contextlib import contextmanager
from typing import NamedTuple, TypeAlias, TypeVar

import msgspec

from devicebus.errors import BusError, MailboxProtocolError
from eap.codec import foe
from eap.codec.ams import AmsCommand, AmsHeader, StateFlags
from eap.codec.coe import (
    CoeHeader,
    CoeService,
    SdoHeader,
    SdoInfoHeader,
    SdoInfoOpcode,
    SdoRequest,
    SdoResponse,
    encode_abort,
)
from eap.codec.eoe import EoeHeader, EoeType
from eap.codec.foe import FoeHeader, FoeOpcode
from eap.codec.mailbox import MailboxType, VoeHeader
from eap.codec.soe import SoeHeader, SoeOpcode
from eap.errors import CodecError
from eap.od.abort import AbortCode

T = TypeVar("T")

RESPONSE_TIMEOUT_NS = 2_000_000_000
"""Default time-out for the answer of a slave (default of ESI files)."""


class MailboxRequest(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One step of a conversation; :func:`answers` identifies its reply."""

    type: MailboxType
    request: bytes
    """Message to send, without the mailbox header."""
    listen: bool = False
    """Send nothing; wait for one more message that answers *request*."""
    timeout_ns: int = RESPONSE_TIMEOUT_NS
    delay_ns: int = 0
    """Pause before sending, as after a busy reply."""
    expects_reply: bool = True
    """If false, the conversation is resumed after sending, with a message without data."""


class MailboxMessage(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A mailbox message without its header."""

    type: MailboxType
    data: bytes
    at_ns: int = 0
    """Time of arrival; 0 without a clock, where a count of messages is the only limit."""
    counter: int = 0
    """Counter of its mailbox header: the slave's own sequence, unrelated to the request."""


Conversation: TypeAlias = Generator[MailboxRequest, MailboxMessage, T]


RATE_WINDOW_NS = 2_000_000_000
"""Averaging window of Progress.rate()."""


class Progress:
    """Progress of a transfer, readable at any time.

    Attributes:
        done: Bytes transferred.
        total: Total size in bytes, None where the protocol does not carry it.
    """

    __slots__ = ("_seen", "done", "total")

    def __init__(self, total: int | None = None) -> None:
        self.done = 0
        self.total = total
        self._seen: deque[tuple[int, int]] = deque()

    def rate(self, now_ns: int) -> float:
        """Return bytes per second over the last two seconds, 0 at the first call.

        Intended for one caller, a few times a second.
        """
        seen = self._seen
        while len(seen) > 1 and seen[1][0] <= now_ns - RATE_WINDOW_NS:
            seen.popleft()
        seen.append((now_ns, self.done))
        first_ns, first = seen[0]
        return (self.done - first) * 1e9 / (now_ns - first_ns) if now_ns > first_ns else 0.0


@contextmanager
def reading(what: str, subject: object = "") -> Iterator[None]:
    """Convert CodecError, raised while a slave's message is decoded, to MailboxProtocolError.

    The error names *what* and *subject*; the text of the latter is only built for an error.
    """
    try:
        yield
    except CodecError as exc:
        subject_text = f" {subject}" if subject else ""
        raise MailboxProtocolError(f"{what}{subject_text}: {exc}") from None


def next_counter(counter: int) -> int:
    """Return the counter that follows *counter*: 1 to 7, then 1 again; 0 disables the check."""
    return counter % 7 + 1


class CounterCheck:
    """Check of one sender's counters: repeated and missing messages.

    Attributes:
        repeated: Number of messages with the counter of the message before.
        gaps: Number of gaps in the sequence.
    """

    __slots__ = ("_last", "gaps", "repeated")

    def __init__(self) -> None:
        self.repeated = 0
        self.gaps = 0
        self._last = 0

    def restart(self) -> None:
        """Accept any counter next; the counts stay."""
        self._last = 0

    def is_new(self, counter: int) -> bool:
        """Count a message; return false for a repetition of the message before."""
        last, self._last = self._last, counter
        # Counter 0 is always accepted: its sender does not count.
        if not counter or not last:
            return True
        if counter == last:
            self.repeated += 1
            return False
        if counter != next_counter(last):
            self.gaps += 1
        return True


# Short: a slave that accepts no messages must not delay other clients by this one.
_ABORT_TIMEOUT_NS = 50_000_000
# Other protocols have no transfers that stay open. A slave without a transfer ignores the message,
# so it is safe to send it whenever the slave's state is unknown.
ABORT_MESSAGES = {
    MailboxType.COE: MailboxRequest(
        MailboxType.COE,
        encode_abort(0, 0, AbortCode.GENERAL),
        timeout_ns=_ABORT_TIMEOUT_NS,
        expects_reply=False,
    ),
    MailboxType.FOE: MailboxRequest(
        MailboxType.FOE,
        foe.encode_message(foe.FoeOpcode.ERROR, foe.FoeErrorCode.NOT_DEFINED),
        timeout_ns=_ABORT_TIMEOUT_NS,
        expects_reply=False,
    ),
}
"""Messages that end an abandoned transfer, by protocol."""


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


def is_aoe_fragment(reply: bytes) -> bool:
    """Return true if *reply* is an AoE fragment, and not the acknowledgement of one."""
    flags = int.from_bytes(reply[18:20], "little")
    return reply[16:18] == _FRAGMENT and not flags & StateFlags.RESPONSE


def _has_more_info(reply: bytes) -> bool:
    is_info = len(reply) >= INFO_START and _service(reply) == CoeService.SDO_INFORMATION
    return is_info and reply[4:6] != b"\0\0"


def _has_more_elements(reply: bytes) -> bool:
    return len(reply) >= SoeHeader.SIZE and bool(reply[0] & 0x08)


def _never(*_: bytes) -> bool:
    return False


class ReplyRules(NamedTuple):
    """Rules of one protocol for a master and a gateway.

    Attributes:
        answers: Returns whether a reply answers a request.
        shortest: Bytes of the shortest request that has an answer.
        has_more: Returns whether fragments may follow a reply.
        is_unsolicited: Returns whether slaves send a message without a request; it may raise
            CodecError.
    """

    answers: Callable[[bytes, bytes], bool]
    shortest: int
    has_more: Callable[[bytes], bool]
    is_unsolicited: Callable[[bytes], bool]


_COE_UNSOLICITED = frozenset(
    (
        CoeService.EMERGENCY,
        CoeService.TX_PDO,
        # No answer has the service of a remote request, whichever way it goes.
        CoeService.TX_PDO_REMOTE_REQUEST,
        CoeService.RX_PDO_REMOTE_REQUEST,
    )
)
_SOE_UNSOLICITED = frozenset((SoeOpcode.NOTIFICATION, SoeOpcode.EMERGENCY))
_RULES: dict[MailboxType, ReplyRules] = {
    MailboxType.ERR: ReplyRules(_never, 0, _never, _never),
    MailboxType.AOE: ReplyRules(
        _answers_aoe,
        0,
        is_aoe_fragment,  # AoE does not mark its last fragment
        lambda data: (
            not AmsHeader.decode(data).state_flags & StateFlags.RESPONSE
            and not is_aoe_fragment(data)
        ),
    ),
    MailboxType.EOE: ReplyRules(
        _answers_eoe, 1, _never, lambda data: EoeHeader.decode(data).type == EoeType.FRAGMENT
    ),
    MailboxType.COE: ReplyRules(
        _answers_coe,
        CoeHeader.SIZE,
        _has_more_info,
        lambda data: CoeHeader.decode(data).service in _COE_UNSOLICITED,
    ),
    MailboxType.FOE: ReplyRules(_answers_foe, FoeHeader.SIZE, _never, _never),
    MailboxType.SOE: ReplyRules(
        _answers_soe,
        1,
        _has_more_elements,
        lambda data: SoeHeader.decode(data).opcode in _SOE_UNSOLICITED,
    ),
    # A VoE message says nothing of its kind.
    MailboxType.VOE: ReplyRules(_answers_voe, 0, _never, lambda _: True),
}


def answers(kind: MailboxType, request: bytes, reply: bytes) -> bool:
    """Return true if *reply* answers *request*, both of one protocol, without mailbox header."""
    rules = _RULES[kind]
    return len(request) >= rules.shortest and rules.answers(request, reply)


def has_more(kind: MailboxType, reply: bytes) -> bool:
    """Return true if fragments may follow *reply*."""
    return _RULES[kind].has_more(reply)


def is_unsolicited(kind: MailboxType, data: bytes) -> bool:
    """Return true for a message that slaves send unsolicited; any other without request is late."""
    try:
        return _RULES[kind].is_unsolicited(data)
    except CodecError:
        return False


RequestT = TypeVar("RequestT")
ReplyT = TypeVar("ReplyT")


def drive(
    conversation: Generator[RequestT, ReplyT, T], exchange: Callable[[RequestT], ReplyT]
) -> T:
    """Run a conversation to its end, one exchange after the other; return its result."""
    try:
        request = next(conversation)
        while True:
            try:
                reply = exchange(request)
            except BusError as exc:
                request = conversation.throw(exc)
            else:
                request = conversation.send(reply)
    except StopIteration as end:
        result: T = end.value
        return result
    finally:
        # Also after an error of *exchange*, so that a transfer under way is released at once.
        conversation.close()


async def drive_async(
    conversation: Generator[RequestT, ReplyT, T], exchange: Callable[[RequestT], Awaitable[ReplyT]]
) -> T:
    """Run a conversation to its end as :func:`drive` does, waiting for each exchange."""
    try:
        request = next(conversation)
        while True:
            try:
                reply = await exchange(request)
            except BusError as exc:
                request = conversation.throw(exc)
            else:
                request = conversation.send(reply)
    except StopIteration as end:
        result: T = end.value
        return result
    finally:
        conversation.close()
