"""Server of the control socket: many clients, each with its requests in order, and their audit.

Rule 1: a client can only delay itself.  Nothing is queued for it: a subscription samples the values
again when its last line has left, and a client that reads nothing for SLOW_READER_S is
disconnected. A client's pending bus requests are cancelled when it leaves, and its conversations
are ended.
Rule 2: a process that may open the socket may do everything, unless the plant has users.  Then
processes of the appliance's own user and of root still may: their files are open to them anyway.
Other users have the role that the plant file gives them, and none without an entry there.  Changes
are audited with the user, since a process number says nothing later.
"""

from __future__ import annotations

import asyncio
import grp
import logging
import os
import pwd
import select
import socket
from collections.abc import AsyncIterator, Callable, Iterable, Sequence, Sized
from contextlib import asynccontextmanager, suppress
from functools import partial
from typing import Any, NamedTuple, SupportsIndex, TypeAlias

from devicebus.errors import BusError
from eap.ads.request import AdsRefusedError, parse_request
from eap.ams.access import service_of
from eap.ams.spec import AccessService, Role
from eap.config.users import PlantUserSection
from eap.control.bus import BUS_METHODS, BusOpenParameters
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
from eap.net.limits import Activity, ListenerLimits
from eap.od.abort import SdoAbortError
from eap.patterns import match_names
from eap.runtime.bus_errors import to_record
from eap.runtime.logins import Principal
from eap.services.control.audit import change_of, error_in_result
from eap.services.control.bus_methods import BusConnection, Buses
from eap.services.control.methods import Methods, Watch
from eap.services.transports.accepting import Listeners, ListeningSocket, TaskConnection, process_of

RecordChange: TypeAlias = Callable[[str, str, dict[str, Any]], None]
"""Called with who it was, station, and what is told of the change."""
AnnounceChange: TypeAlias = Callable[[str, str, dict[str, Any]], str]
"""Called likewise before a change; returns why it may not be done, empty if it may."""
_FIRST_REQUEST_S = 1.0
LIMITS = ListenerLimits(total=MAX_CLIENTS, reserved=0, per_host=MAX_CLIENTS)

_ROOT = 0
_FOR_VIEWERS = frozenset(
    (
        *("hello", "status", "pd_list", "variables", "read", "subscribe", "unsubscribe", "state"),
        *("od_list", "od_describe", "od_read", "od_dump", "export", "plan", "routing_export"),
        *("routing_plan", "gateway_status", "routes_list", "routes_test", "routes_export", "trace"),
        *("log_levels", "field_points", "bus_describe", "bus_open", "bus_close"),
    )
)
"""Methods that change nothing."""
_BY_PARAMETERS = frozenset(("bus_ask", "bus_transfer"))
"""Methods that read or change; so does ams_ask, of which the audit has the ADS request."""

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


class ControlPeer(NamedTuple):
    """Client of the control socket.

    Attributes:
        text: User and process, for the audit.
        user: User of the plant file, with a role; its name is empty for the appliance's own user.
    """

    text: str
    user: Principal

    @property
    def is_own(self) -> bool:
        """True for root and the appliance's user, whose programs may act for other users."""
        return not self.user.name


class PeerRoles:
    """Roles of clients.

    Args:
        users: Users of the plant; without any, each client may do everything.
        operators: Patterns of the variables that operators set.
    """

    def __init__(
        self, users: Sequence[PlantUserSection] = (), operators: Iterable[str] = ()
    ) -> None:
        self._users = users
        self._operators = tuple(operators)

    def own_peer(self, connection: socket.socket) -> ControlPeer | None:
        """Return a client that may do everything, None if the user database has to be asked."""
        pid, uid = process_of(connection)
        if self._users and uid not in {_ROOT, os.geteuid()}:
            return None
        return ControlPeer(_peer_text(pid, uid), Principal("", Role.ENGINEER))

    def identify(self, connection: socket.socket) -> ControlPeer | None:
        """Return another client, by the user database; None for one without a role."""
        pid, uid = process_of(connection)
        try:
            account = pwd.getpwuid(uid)
        except KeyError:
            return None
        groups = {_group_name(gid) for gid in os.getgrouplist(account.pw_name, account.pw_gid)}
        for user in self._users:
            if account.pw_name in user.unix or not groups.isdisjoint(user.groups):
                return ControlPeer(_peer_text(pid, uid), Principal(user.name, user.role))
        return None

    def reason_denied(
        self, peer: ControlPeer, request: Request, *, is_change: Callable[[], bool]
    ) -> str:
        """Return why a client may not make a request, empty if it may.

        *is_change* says whether one that depends on its parameters changes something.
        """
        if peer.is_own:
            return ""
        if request.params.get("origin") is not None:
            return "only programs of the appliance's user act for other users"
        needed = _needed_role(request, is_change)
        if not peer.user.may_act_as(needed):
            return f"{peer.user.name} is {peer.user.role}, and {request.method} needs {needed}"
        if request.method == "write" and peer.user.role is Role.OPERATOR:
            return self._reason_not_set(request.params)
        return ""

    def _reason_not_set(self, params: dict[str, Any]) -> str:
        values = params.get("values")
        for name in values if isinstance(values, dict) else ():
            full = f"{params.get('station')}/{name}"
            if not any(match_names(pattern, [full]) for pattern in self._operators):
                return f"{full} is set by engineers only: access.operators does not name it"
        return ""


def _peer_text(pid: int, uid: int) -> str:
    return f"uid {uid}, pid {pid}"


def _needed_role(request: Request, is_change: Callable[[], bool]) -> Role:
    if request.method == "write":
        return Role.OPERATOR
    if request.method in _FOR_VIEWERS:
        return Role.VIEWER
    is_read = request.method in _BY_PARAMETERS and not is_change()
    return Role.VIEWER if is_read or _is_ads_read(request) else Role.ENGINEER


def _is_ads_read(request: Request) -> bool:
    if request.method != "ams_ask":
        return False
    try:
        data = bytes.fromhex(request.params.get("data", ""))
        operations = parse_request(request.params["command"], data).operations
    except (AdsRefusedError, KeyError, TypeError, ValueError):
        return False
    return all(service_of(each) is AccessService.READ for each in operations)


def _group_name(gid: int) -> str:
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return ""


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
