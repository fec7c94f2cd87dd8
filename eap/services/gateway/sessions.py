"""Sessions of one client: with one slave in one mailbox protocol, and with the master's dictionary.

Rule 1: a request is answered within a time limit, by the slave or by the gateway.
Rule 2: a repeated step of a transfer gets the same answer again, and changes nothing.
Rule 3: a transfer without a next step is aborted, and its memory is freed.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Container, Iterator, Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import msgspec
from msgspec.structs import replace

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.request import Operation
from eap.ams.access import group_and_offset
from eap.codec.foe import FoeOpcode
from eap.codec.mailbox import MailboxError, MailboxType
from eap.errors import CodecError, EapError, TruncatedError
from eap.gateway import error_table
from eap.gateway.error_table import Cause, cause_of_result
from eap.gateway.requests import GatewayError, error_reply, mailbox_error, operation_of
from eap.ids import Endpoint
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState
from eap.services.slaves.access import RemoteAccessError

IDLE_S = 5.0
"""Limit for the pause between two steps of a transfer."""
# The slave gets all of the download then.
WRITES = 5
"""Answer times that the last step of a download may take."""
MAX_SESSIONS = 512
_GRACE_S = 0.03
"""For the bus, which answers at the deadline itself."""
_BUSY = bytes((FoeOpcode.BUSY,))


class GatewayReply(msgspec.Struct, frozen=True):
    """Message in reply to a client."""

    type: MailboxType
    body: bytes
    reason: Cause | None = None
    """Of the gateway's own refusal; None for an answer of the slave."""
    is_repeat: bool = False
    """True for the answer to a repeated step of a transfer, the same as to the step itself."""
    is_overdue: bool = False
    """True if the gateway's own limit has passed, and not one of the slave or of a router."""


class SessionCodec(Protocol):
    """Server's side of one mailbox protocol in front of a slave, for one client.

    Attributes:
        sizes: Of the mailboxes that the client writes to and reads from.
    """

    sizes: MailboxSizes

    @property
    def is_running(self) -> bool:
        """True if a transfer is active, so that more requests belong to it."""

    async def answer(self, body: bytes) -> list[bytes]:
        """Return the answers to a message.

        Raises:
            MailboxRefusedError: it can only be answered with a mailbox error.
            CodecError: it is cut, or none of this protocol.
            EapError: the slave was not reached.
        """

    def is_step(self, body: bytes) -> bool:
        """Return whether a request continues a transfer, so that its repeat changes nothing."""

    def completes_write(self, body: bytes) -> bool:
        """Return whether a request is the last of many, for all of which the slave works now."""

    def reset(self) -> None:
        """Abort the active transfer, at the slave too."""


class ClientSession:
    """Requests of one client to one slave in one protocol, one after the other.

    Args:
        kind: The protocol.
        codec: Its server's side.
        answer_s: Limit for an answer.
        idle_s: As IDLE_S.
    """

    def __init__(
        self, kind: MailboxType, codec: SessionCodec, *, answer_s: float, idle_s: float = IDLE_S
    ) -> None:
        self.codec = codec
        self._kind = kind
        self._answer_s = answer_s
        self._idle_s = idle_s
        self._request = b""
        self._replies: list[GatewayReply] | None = None
        self._lock = asyncio.Lock()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def is_running(self) -> bool:
        """True if a transfer is active."""
        return self.codec.is_running

    async def handle(self, body: bytes, *, is_step: bool) -> list[GatewayReply]:
        """Return the answers to a request, which may be none.

        Args:
            body: Behind the mailbox header.
            is_step: Whether it only makes sense within a transfer.
        """
        now_s = asyncio.get_running_loop().time()
        times = WRITES if self.codec.completes_write(body) else 1
        if self._lock.locked():
            try:
                async with asyncio.timeout_at(now_s + self._answer_s):
                    await self._lock.acquire()
            except TimeoutError:
                return _overdue(self._error_replies(body, Cause.TIMEOUT))
        else:
            await self._lock.acquire()  # without waiting, and without the price of a time-out
        try:
            return await self._handle(body, now_s + times * self._answer_s, is_step=is_step)
        finally:
            self._lock.release()

    def close(self) -> None:
        """Abort the active transfer."""
        self._stop_timer()
        self.codec.reset()
        self._replies = None

    async def _handle(self, body: bytes, deadline_s: float, *, is_step: bool) -> list[GatewayReply]:
        if self._is_repeated(body):
            return [replace(each, is_repeat=True) for each in self._replies or ()]
        # A step after a time-out of the session: its transfer is over at the slave, too.
        if is_step and not self.is_running:
            return self._error_replies(body, Cause.SERVICE, "no active transfer")
        self._stop_timer()
        self._request, self._replies = body, None
        replies = await self._answer(body, deadline_s)
        self._replies = replies
        if self.is_running:
            self._timer = asyncio.get_running_loop().call_later(self._idle_s, self.close)
        return replies

    def _is_repeated(self, body: bytes) -> bool:
        """Return whether a request repeats the last step, whose reply was lost."""
        if body != self._request or self._replies is None or not self.codec.is_step(body):
            return False
        # After BUSY it is no repetition: by it a client asks whether the slave has time now.
        is_busy = (
            self._kind is MailboxType.FOE
            and self._replies[-1:]
            and (self._replies[-1].body[:1] == _BUSY)
        )
        return not is_busy

    async def _answer(self, body: bytes, deadline_s: float) -> list[GatewayReply]:
        try:
            async with asyncio.timeout_at(deadline_s + _GRACE_S):
                answers = await self.codec.answer(body)
        except TimeoutError:
            self.close()
            return _overdue(self._error_replies(body, Cause.TIMEOUT))
        # The session goes on: a mailbox error of the slave ends one request, not the client.
        except MailboxRefusedError as exc:
            self.codec.reset()
            return [GatewayReply(*mailbox_error(exc.detail))]
        except CodecError as exc:
            is_cut = isinstance(exc, TruncatedError)
            return self._error_replies(body, Cause.TOO_SHORT if is_cut else Cause.SERVICE)
        except EapError as exc:
            self.close()
            replies = self._error_replies(body, cause_of(exc), text_of(exc))
            # The router has the same limit for a remote slave, and answers at it.
            is_overdue = asyncio.get_running_loop().time() >= deadline_s
            return _overdue(replies) if is_overdue else replies
        except BaseException:
            self.close()
            raise
        return [GatewayReply(self._kind, answer) for answer in answers]

    def _error_replies(self, body: bytes, reason: Cause, text: str = "") -> list[GatewayReply]:
        return error_replies(self._kind, body, reason, text)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def error_replies(
    kind: MailboxType, body: bytes, reason: Cause, text: str = ""
) -> list[GatewayReply]:
    """Return the error that answers a request."""
    return [GatewayReply(*error_reply(kind, body, reason, text), reason=reason)]


def _overdue(replies: list[GatewayReply]) -> list[GatewayReply]:
    return [replace(each, is_overdue=True) for each in replies]


def cause_of(error: EapError) -> Cause:
    """Return the cause of an error of the gateway, of the routing to a slave, or of the slave."""
    match error:
        case GatewayError():
            return error.cause
        case RemoteAccessError() if error.is_routing_error:
            return cause_of_result(error.result)
        case RemoteAccessError():
            return Cause.SERVICE
    return error_table.cause_of(error)


def text_of(error: EapError) -> str:
    """Return the text of an error beyond its cause; empty for an ADS error, which adds nothing."""
    return "" if isinstance(error, RemoteAccessError) else str(error)


class SessionKey(NamedTuple):
    """The client of a session, its slave, and the protocol."""

    endpoint: Endpoint
    address: int
    """Station address, virtual address, or 0 for the master."""
    kind: MailboxType


class KeyedSession(Protocol):
    """Session with a slave or with the master."""

    @property
    def is_running(self) -> bool:
        """True if a transfer is active."""

    def close(self) -> None:
        """Abort the active transfer."""


S = TypeVar("S", bound=KeyedSession)


class SessionTable(Generic[S]):
    """Sessions of one kind, at most MAX_SESSIONS; the least recently used one makes room."""

    def __init__(self) -> None:
        self._open: dict[SessionKey, S] = {}

    def get(self, key: SessionKey, begin: Callable[[], S]) -> S:
        """Return the session of *key*, a new one if there is none."""
        session = self._open.pop(key, None)
        if session is None:
            if len(self._open) >= MAX_SESSIONS:
                self._drop_oldest()
            session = begin()
        self._open[key] = session  # at the end: the least recently used one is in front
        return session

    def of_slave(self, address: int, kind: MailboxType) -> Sequence[tuple[SessionKey, S]]:
        """Return the sessions of all clients with one slave in one protocol."""
        return [
            (key, each)
            for key, each in self._open.items()
            if key.address == address and key.kind is kind
        ]

    def running(self) -> Iterator[SessionKey]:
        """Yield the keys of sessions with an active transfer."""
        return (key for key, session in self._open.items() if session.is_running)

    def drop(self, key: SessionKey) -> None:
        """End a session, if there is one."""
        session = self._open.pop(key, None)
        if session is not None:
            session.close()

    def close_of(self, endpoint: Endpoint) -> None:
        """End the sessions of a client."""
        for key in [key for key in self._open if key.endpoint == endpoint]:
            self.drop(key)

    def close_to(self, addresses: Container[int]) -> None:
        """End the sessions with some addresses."""
        for key in [key for key in self._open if key.address in addresses]:
            self.drop(key)

    def close(self) -> None:
        """End all."""
        while self._open:
            self._open.popitem()[1].close()

    def _drop_oldest(self) -> None:
        # A session with an active transfer is dropped only if all have one.
        idle = (key for key, each in self._open.items() if not each.is_running)
        self.drop(next(idle, next(iter(self._open))))


class MasterSession:
    """Session of one client with the master: segmented transfers of two clients do not meet.

    Args:
        dictionary: Of the master.
        max_size: Bytes of the longest answer behind its mailbox header.
        refresh: Sees to it that what an object shows is not old; it gets the object's index.
        is_fresh: Says whether that is so already.
    """

    is_running = False

    def __init__(
        self,
        dictionary: ObjectDictionary,
        max_size: int,
        refresh: Callable[[int], Awaitable[None]],
        is_fresh: Callable[[int], bool],
    ) -> None:
        self._dictionary = dictionary
        self._refresh = refresh
        self._is_fresh = is_fresh
        self._server = CoeServer(dictionary, _op, MailboxSizes.of_data(max_size))

    async def handle(self, kind: MailboxType, body: bytes) -> list[GatewayReply]:
        """Return the answers to a request."""
        if kind is not MailboxType.COE:
            return error_replies(kind, body, Cause.NO_PROTOCOL)
        await self._refresh(_index_of(operation_of(kind, body)))
        return self.handle_now(body)

    def is_ready(self, operation: Operation | None) -> bool:
        """Say whether the answer to a request by CoE, which does *operation*, need not wait."""
        return self._is_fresh(_index_of(operation))

    def handle_now(self, body: bytes) -> list[GatewayReply]:
        """Return the answers to a request by CoE that is ready."""
        try:
            answers = self._server.receive_message(body, 0)
        except MailboxRefusedError as exc:
            if exc.detail == MailboxError.SIZE_TOO_SHORT:
                return [GatewayReply(*error_reply(MailboxType.COE, body, Cause.TOO_SHORT))]
            return [GatewayReply(*mailbox_error(exc.detail))]
        return [GatewayReply(MailboxType.COE, answer) for answer in answers]

    async def read(self, index: int, subindex: int, *, complete: bool) -> bytes:
        """Return an entry or an object as it is now; raise SdoAbortError."""
        await self._refresh(index)
        read = self._dictionary.upload_complete if complete else self._dictionary.upload
        return read(index, subindex, OdState.OP)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an entry; raise SdoAbortError."""
        self._dictionary.download(index, subindex, data, OdState.OP)

    def close(self) -> None:
        """Abort the active transfer."""
        self._server.reset()


def _index_of(operation: Operation | None) -> int:
    return group_and_offset(operation)[1] >> 16 if operation else 0


def _op() -> OdState:
    return OdState.OP
