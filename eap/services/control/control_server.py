"""Server of the control socket: many clients, each with its requests in order, and their audit.

Rule 1: a client can only delay itself.  Nothing is queued for it: a subscription samples the values
again when its last line has left, and a client that reads nothing for SLOW_READER_S is
disconnected. A client's pending bus requests are cancelled when it leaves, and its conversations
are ended.
Rule 2: a process that may open the socket may do everything, unless the plant has users: then
:mod:`eap.services.control.peer_roles` decides.  Changes are audited with the user, since a process
number says nothing later.
"""

from __future__ import annotations

import asyncio
import logging
import select
import socket
from collections.abc import AsyncIterator, Callable, Iterable, Mapping, Sized
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import Any, SupportsIndex, TypeAlias

from devicebus.errors import BusError
from eap.ads.request import Operation, Read, ReadWrite
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.coe import CoeHeader, SdoHeader
from eap.codec.mailbox import MailboxType
from eap.control.bus import BUS_METHODS, BusOpenParameters, MailboxData, kind_of
from eap.control.device import ApplyAnswer, StateAnswer
from eap.control.protocol import (
    MAX_CLIENTS,
    MAX_LINE,
    MAX_SUBSCRIPTIONS,
    SLOW_READER_S,
    ErrorCode,
    Failure,
    Request,
    Subscribed,
    Unsubscribed,
    UnsubscribeParameters,
    ValuesEvent,
    decode_request,
    encode_error,
    encode_event,
    encode_failure,
    encode_result,
    parameters,
    request_id,
)
from eap.errors import ControlError, EapError, ImageError
from eap.gateway.requests import error_in, operation_of
from eap.net.limits import Activity, ListenerLimits
from eap.od.abort import SdoAbortError
from eap.runtime.bus_errors import to_record
from eap.services.control.audit import operation_fields
from eap.services.control.bus_methods import BusConnection, Buses
from eap.services.control.methods import Methods, Watch
from eap.services.control.peer_roles import PeerRoles
from eap.services.transports.accepting import Listeners, ListeningSocket, TaskConnection, process_of

RecordChange: TypeAlias = Callable[[str, str, dict[str, Any]], None]
"""Called with who it was, station, and what is told of the change."""
AnnounceChange: TypeAlias = Callable[[str, str, dict[str, Any]], str]
"""Called likewise before a change; returns why it may not be done, empty if it may."""
_CHANGES = frozenset(
    (
        *("write", "stop", "od_write", "request_state", "apply", "rollback"),
        *("bus_bring", "bus_fault", "bus_forget", "bus_transfer", "gateway_start", "gateway_stop"),
        *("routes_add", "routes_remove", "routes_import", "routes_add_remote"),
        *("routing_apply", "routing_rollback", "set_log_level"),
    )
)
_HIDDEN = frozenset(("password", "spec", "xml", "routing"))
"""Parameters that are secret, or as long as a plant file."""
_READ_COMMANDS = frozenset((1, 4, 7))
"""Datagrams that only read: APRD, FPRD, BRD (ETG.1000.4)."""
_EEPROM_OWNER, _EEPROM_CONTROL, _EEPROM_READ = 0x0500, 0x0502, "0001"
"""Registers, and how the command begins that reads (ETG.1000.4)."""
_MAX_TEXT = 200


def change_of(
    request: Request, opened: Callable[[int], BusOpenParameters | None]
) -> tuple[str, dict[str, Any]] | None:
    """Return the station that a request changes, and fields for the audit; None if it only reads.

    Args:
        request: As it came, not checked yet.
        opened: Returns how a conversation with a slave was opened, None if there is none.
    """
    params = request.params
    if request.method == "bus_ask":
        number = params.get("conversation")
        conversation = opened(number) if isinstance(number, int) else None
        return None if conversation is None else _conversation_change(conversation, params)
    if not _is_change(request):
        return None
    described = {key: _shortened(value) for key, value in params.items() if key not in _HIDDEN}
    described.pop("origin", None)
    origin = params.get("origin")
    author = {}
    if isinstance(origin, dict):
        author = {key: _shortened(origin.get(key, "")) for key in ("user", "host", "comment")}
        client = "@".join(str(author[key]) for key in ("user", "host") if author[key])
        author["by"] = f"{_shortened(origin.get('transport', 'web'))}:{client}"
    station = str(
        described.pop("station", "") or str(described.get("target", "")).partition("/")[0]
    )
    return station, {"operation": request.method, "asked": described} | author


def _is_change(request: Request) -> bool:
    if request.method == "ams_ask":
        # An ADS request has a line of its own, which does not know its author.
        return request.params.get("origin") is not None
    if request.method == "bus_transfer":
        return not _are_reads(request.params)
    return request.method in _CHANGES


def error_in_result(result: Any, conversation: BusOpenParameters | None = None) -> str:
    """Return why a result says that it was not done, empty if it was.

    Args:
        result: Of a request.
        conversation: How the conversation was opened that it is an answer of, if it is one.
    """
    if conversation is not None and isinstance(result, MailboxData):
        kind, answer = kind_of(conversation.protocol), bytes.fromhex(result.data)
        code = error_in(kind, answer)
        if code and kind is MailboxType.COE:
            head = SdoHeader.decode(answer, CoeHeader.SIZE)
            return str(SdoAbortError(head.value, head.index, head.subindex))
        return AdsError.words_of(code) if code else ""
    if isinstance(result, StateAnswer) and result.error is not None:
        return result.error.text
    return "; ".join(result.refused) if isinstance(result, ApplyAnswer) else ""


def _conversation_change(
    conversation: BusOpenParameters, params: Mapping[str, Any]
) -> tuple[str, dict[str, Any]] | None:
    try:
        body = bytes.fromhex(params["request"])
    except (KeyError, TypeError, ValueError):
        return None
    operation = operation_of(kind_of(conversation.protocol), body)
    if operation is None or params.get("listen") or _is_read(operation):
        return None
    name = f"{conversation.station}/{conversation.port}/{conversation.slave}"
    return conversation.station, {"name": name} | dict(operation_fields(operation))


def _is_read(operation: Operation) -> bool:
    is_lookup = isinstance(operation, ReadWrite) and operation.group == IndexGroup.FOE_OPEN_READ
    return is_lookup or isinstance(operation, Read)


def _are_reads(params: Mapping[str, Any]) -> bool:
    rows = params.get("datagrams")
    return not isinstance(rows, list) or all(map(_is_read_row, rows))


def _is_read_row(row: Any) -> bool:
    """Say whether a datagram changes nothing; an EEPROM is read by writing a command."""
    match row:
        case [command, *_] if command in _READ_COMMANDS:
            return True
        case [_, _, place, data, *_]:
            # Registers 0x0500 and 0x0502: taking the EEPROM over and a read command change no
            # content.
            is_command = place == _EEPROM_CONTROL and str(data).startswith(_EEPROM_READ)
            return is_command or place == _EEPROM_OWNER
    return False


def _shortened(value: Any) -> Any:
    text = str(value)
    return value if len(text) <= _MAX_TEXT else f"{text[:_MAX_TEXT]}…"


_FIRST_REQUEST_S = 1.0
LIMITS = ListenerLimits(total=MAX_CLIENTS, reserved=0, per_host=MAX_CLIENTS)

logger = logging.getLogger(__name__)


def failure_of(exc: Exception) -> Failure:
    """Return the exception of a method as its client gets it; a defect is logged."""
    if isinstance(exc, ControlError):
        return Failure(exc.code, str(exc))
    if isinstance(exc, ImageError):
        return Failure(ErrorCode.UNAVAILABLE, str(exc))
    if isinstance(exc, BusError):
        why = to_record(exc)
        return Failure(ErrorCode.BUS, why.message, why.kind, why.detail)
    if isinstance(exc, SdoAbortError):
        return Failure(ErrorCode.ABORT, str(exc), detail=exc.code)
    logger.error("control method failed", exc_info=exc)
    return Failure(ErrorCode.INTERNAL, "internal error; the log of services has the cause")


class ControlServer:
    """Serve *methods*, and those on *buses*, on a listening Unix socket."""

    def __init__(
        self,
        methods: Methods,
        buses: Buses,
        record: RecordChange | None = None,
        *,
        announce: AnnounceChange | None = None,
        roles: PeerRoles | None = None,
        slow_reader_s: float = SLOW_READER_S,
    ) -> None:
        self._roles = roles or PeerRoles()
        self._methods = methods
        self._buses = buses
        self._record = record
        self._announce = announce
        self._slow_reader_s = slow_reader_s
        self._listening: ListeningSocket[ControlConnection] | None = None

    async def serve(self, listener: socket.socket, listeners: Listeners) -> None:
        """Accept clients until cancelled; *listener* stays open."""
        # Shares are counted by process: there is one host, and one user mostly.
        if self._listening is None:
            self._listening = ListeningSocket(listener, "control", self, listeners, LIMITS)
        await self._listening.serve()

    def connection_from(self, sock: socket.socket, host: str) -> ControlConnection:
        """Return the connection on a socket that was accepted (ConnectionServer)."""
        del sock
        return ControlConnection(host)

    def refuse_connection(self, sock: socket.socket, why: str) -> None:
        """Send a client the reason why its connection is closed (ConnectionServer)."""
        with suppress(OSError):
            sock.send(encode_error(None, ControlError(why, code=ErrorCode.BUSY)))

    async def serve_connection(self, connection: ControlConnection, sock: socket.socket) -> None:
        """Answer one client until it leaves (ConnectionServer)."""
        connection.begin()
        loop = asyncio.get_running_loop()
        reader = _Reader(connection, sock, loop)
        transport, protocol = await loop.connect_accepted_socket(
            lambda: asyncio.StreamReaderProtocol(reader, loop=loop), sock
        )
        writer = asyncio.StreamWriter(transport, protocol, reader, loop)
        try:
            # The user database may be on the network; few clients need it.
            peer = self._roles.own_peer(sock) or await asyncio.to_thread(self._roles.identify, sock)
            if peer is None:
                await self._refuse_peer(sock, reader, writer)
                return
            record = self._record and partial(self._record, peer.text)
            announce = self._announce and partial(self._announce, peer.text)
            client = _Client(
                self._methods,
                self._buses,
                writer,
                self._slow_reader_s,
                record,
                announce,
                partial(self._roles.reason_denied, peer),
                peer.user.name,
            )
            connection.subscriptions = client.subscriptions
            await client.run(reader)
        except* (OSError, TimeoutError) as group:
            logger.debug("control client disconnected: %s", group.exceptions[0])
        finally:
            # Not close(): it would wait for a client that does not read.
            transport.abort()

    async def _refuse_peer(
        self, sock: socket.socket, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Answer the first request of a client without a role."""
        line = b""
        with suppress(TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            async with asyncio.timeout(_FIRST_REQUEST_S):
                line = await reader.readuntil(b"\n")
        pid, uid = process_of(sock)
        why = f"user {uid} of this host has no role in the plant file"
        writer.write(encode_error(request_id(line), ControlError(why, code=ErrorCode.REFUSED)))
        if self._record is not None:
            self._record(f"uid {uid}, pid {pid}", "", {"operation": "connect", "error": why})


class ControlConnection(TaskConnection):
    """A client of the control socket.

    Attributes:
        is_answered: Whether a request of it is being answered.
        subscriptions: Those that it has.
    """

    def __init__(self, host: str) -> None:
        super().__init__(host)
        self.is_answered = False
        self.subscriptions: Sized = ()

    @property
    def activity(self) -> Activity:
        """Current use."""
        if self.subscriptions:
            return Activity.SUBSCRIBED
        return Activity.BUSY if self.is_answered else super().activity


class _Reader(asyncio.StreamReader):
    """Reads lines, and notices at once when the client has gone while it waits for an answer."""

    def __init__(
        self,
        connection: ControlConnection,
        sock: socket.socket,
        loop: asyncio.AbstractEventLoop,
    ) -> None:
        super().__init__(limit=MAX_LINE, loop=loop)
        self._connection = connection
        self._socket = sock
        self._clock = loop.time
        self._has_gone = False
        self._wait: asyncio.Timeout | None = None

    @asynccontextmanager
    async def while_there(self) -> AsyncIterator[None]:
        """Raise TimeoutError in a block that waits when the client has gone."""
        self._wait = asyncio.timeout_at(self._clock() if self._has_gone else None)
        self._connection.is_answered = True
        self._connection.late_since_ns = None
        try:
            async with self._wait:
                yield
        finally:
            self._connection.is_answered = False
            self._wait = None

    def feed_data(self, data: Iterable[SupportsIndex]) -> None:
        """Take data, some of a line or more."""
        super().feed_data(data)
        if bytes(data).endswith(b"\n"):
            self._connection.note_frame()
        elif not self._connection.is_answered:
            self._connection.note_partial()

    def feed_eof(self) -> None:
        """Handle the end of the client's input; it may still wait for answers."""
        super().feed_eof()
        poll = select.poll()
        poll.register(self._socket, 0)
        if poll.poll(0):  # hung up: not only its sending side is closed
            self._note_end()

    def set_exception(self, exc: Exception) -> None:
        """Take the end of a connection that broke."""
        super().set_exception(exc)
        self._note_end()

    def _note_end(self) -> None:
        self._has_gone = True
        if self._wait is not None:
            self._wait.reschedule(self._clock())


class _Client:
    def __init__(
        self,
        methods: Methods,
        buses: Buses,
        writer: asyncio.StreamWriter,
        slow_reader_s: float,
        record: Callable[[str, dict[str, Any]], None] | None,
        announce: Callable[[str, dict[str, Any]], str] | None,
        reason_denied: Callable[..., str],
        user: str,
    ) -> None:
        self._reason_denied = reason_denied
        self._user = user
        self._methods = methods
        self._announce = announce
        self._record = record
        self._buses = buses
        # Few clients use buses; the others need no state for them.
        self._bus: BusConnection | None = None
        self._writer = writer
        self._slow_reader_s = slow_reader_s
        self.subscriptions: dict[int, asyncio.Task[None]] = {}
        self._last_subscription = 0

    async def send(self, line: bytes) -> None:
        """Put one line out, and wait until most of it has gone."""
        self._writer.write(line)
        async with asyncio.timeout(self._slow_reader_s):
            await self._writer.drain()

    async def run(self, reader: _Reader) -> None:
        """Answer requests until the client leaves; then release its buses."""
        try:
            async with asyncio.TaskGroup() as group:
                while line := await self._next_line(reader):
                    await self._answer(line, reader, group)
                for task in self.subscriptions.values():
                    task.cancel()
        finally:
            if self._bus is not None:
                self._bus.close()

    async def _next_line(self, reader: asyncio.StreamReader) -> bytes:
        """Return the next line, empty at the end or when the client sends no lines."""
        try:
            return await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError:
            return b""
        except asyncio.LimitOverrunError:
            reason = f"a line has at most {MAX_LINE} bytes"
            error = ControlError(reason, code=ErrorCode.BAD_REQUEST)
            await self.send(encode_error(None, error))
            return b""

    async def _answer(self, line: bytes, reader: _Reader, group: asyncio.TaskGroup) -> None:
        number = None
        watch: Watch | None = None
        try:
            request = decode_request(line)
            number = request.id
            self._check_role(request)
            if request.method == "subscribe":
                result, watch = self._subscribe(request.params)
            else:
                async with reader.while_there():
                    result = await self._call_audited(request)
        # The client has disconnected, see while_there(): no answer can be sent.
        except TimeoutError:
            raise
        except Exception as exc:  # noqa: BLE001  failure_of() logs a defect
            number = request_id(line) if number is None else number
            await self.send(encode_failure(number, failure_of(exc)))
        else:
            # Sent before its task starts: the client knows the number when the first event comes.
            await self.send(encode_result(number, result))
            if watch is not None:
                task = group.create_task(self._events(result.subscription, watch))
                self.subscriptions[result.subscription] = task

    def _check_role(self, request: Request) -> None:
        """Raise ControlError, after writing it down, if the client's role does not allow it."""
        change = partial(change_of, request, self._opened)
        if why := self._reason_denied(request, is_change=lambda: change() is not None):
            if self._record is not None:
                station, fields = change() or ("", {"operation": request.method})
                self._record(station, fields | {"user": self._user, "error": why})
            raise ControlError(why, code=ErrorCode.REFUSED)

    async def _call_audited(self, request: Request) -> Any:
        """Have a change written down when it is known how it came out, before it is answered."""
        change = None if self._record is None else change_of(request, self._opened)
        if change is None or self._record is None:
            return await self._call(request)
        station, fields = change
        if self._user:
            fields |= {"user": self._user}
        conversation = None
        if request.method == "bus_ask":
            conversation = self._opened(request.params["conversation"])
        if self._announce is not None and (why := self._announce(station, fields)):
            raise ControlError(why, code=ErrorCode.REFUSED)
        error: str | None = None  # as long as nobody knows
        try:
            result = await self._call(request)
            error = error_in_result(result, conversation)
        except EapError as exc:
            error = str(exc)
            raise
        finally:
            self._record(station, fields | {"error": error})
        return result

    def _opened(self, number: int) -> BusOpenParameters | None:
        return None if self._bus is None else self._bus.opened(number)

    async def _call(self, request: Request) -> Any:
        if request.method == "unsubscribe":
            return self._unsubscribe(request.params)
        if request.method in BUS_METHODS:
            if self._bus is None:
                self._bus = BusConnection(self._buses)
            return await self._bus.call(request.method, request.params)
        return await self._methods.call(request.method, request.params)

    def _subscribe(self, params: dict[str, Any]) -> tuple[Subscribed, Watch]:
        if len(self.subscriptions) >= MAX_SUBSCRIPTIONS:
            reason = f"this connection has {MAX_SUBSCRIPTIONS} subscriptions, which is the limit"
            raise ControlError(reason, code=ErrorCode.BUSY)
        watch = self._methods.watch(params)
        self._last_subscription += 1
        return Subscribed(self._last_subscription), watch

    def _unsubscribe(self, params: dict[str, Any]) -> Unsubscribed:
        subscription = parameters(params, UnsubscribeParameters).subscription
        task = self.subscriptions.pop(subscription, None)
        if task is None:
            reason = f"no subscription {subscription} on this connection"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
        task.cancel()
        return Unsubscribed(subscription)

    async def _events(self, subscription: int, watch: Watch) -> None:
        clock = asyncio.get_running_loop().time
        period_s = watch.period_ms / 1000
        due_s = clock()
        while True:
            event: ValuesEvent | dict[str, Any] | None
            try:
                event = watch.next_event()
            except ImageError as exc:
                event = {"error": {"code": ErrorCode.UNAVAILABLE, "message": str(exc)}}
            except ControlError as exc:
                event = {"error": {"code": exc.code, "message": str(exc)}}
            if event is not None:
                await self.send(encode_event(subscription, event))
            # From one due time to the next: a sleep of the period would be late by more each time.
            due_s = max(due_s + period_s, clock())
            await asyncio.sleep(due_s - clock())
