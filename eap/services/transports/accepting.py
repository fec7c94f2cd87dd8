"""Listeners of this process: they accept connections, admit, serve and close them.

The policy is :mod:`eap.net.limits`.  All listeners of the process share one table, because
they share the descriptors of the process.
"""

from __future__ import annotations

import asyncio
import logging
import socket
import struct
from contextlib import suppress
from itertools import count
from time import monotonic_ns
from typing import Generic, Protocol, TypeVar

from eap.net.limits import (
    OVERDUE_NS,
    Activity,
    CloseReason,
    Connection,
    ConnectionTable,
    ListenerLimits,
    ListenerStats,
    host_of,
)
from eap.net.realtime import OUT_OF_DESCRIPTORS, descriptor_reserve, spare_descriptors
from eap.services.limited_log import caused_by

# Short, because established clients wait meanwhile.
_ACCEPT_SLICE_NS, _LOCAL_ACCEPT_SLICE_NS = 5_000_000, 20_000_000
"""Time slice for accepting connections."""
_PAUSE_S = 1.0
"""Pause after an error of the listener; new connections wait in its backlog."""
_CREDENTIALS = struct.Struct("3i")
_numbers = count(1)

logger = logging.getLogger(__name__)

C = TypeVar("C", bound=Connection)


class ConnectionServer(Protocol[C]):
    """User of a listener, which knows the protocol."""

    def connection_from(self, sock: socket.socket, host: str) -> C:
        """Return the connection on an accepted socket.

        Raises:
            OSError: the peer has disconnected already.
        """

    async def serve_connection(self, connection: C, sock: socket.socket) -> None:
        """Serve *connection* until its end; the caller closes *sock*."""

    def refuse_connection(self, sock: socket.socket, why: str) -> None:
        """Count a connection that is not admitted; the caller closes it next."""


class TaskConnection:
    """Connection that one task serves, and that is closed by cancelling it.

    Attributes:
        host: Host that the policy counts it for.
        used_at_ns: Time of the latest complete frame.
        late_since_ns: Since when a frame is incomplete, or answers are not read; None otherwise.
        is_used: Whether there was a complete frame.
        closed_for: Reason for which the policy closed it.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.used_at_ns = monotonic_ns()
        self.late_since_ns: int | None = None
        self.is_used = False
        self.closed_for: CloseReason | None = None
        self._task: asyncio.Task[None] | None = None

    @property
    def activity(self) -> Activity:
        """Current use, for the policy."""
        return Activity.IDLE if self.is_used else Activity.UNUSED

    def begin(self) -> None:
        """Make the running task the one that serves this connection."""
        self._task = asyncio.current_task()
        if self.closed_for is not None:
            self.close(self.closed_for)

    def note_partial(self) -> None:
        """Note the first byte of a frame."""
        if self.late_since_ns is None:
            self.late_since_ns = monotonic_ns()

    def note_frame(self) -> None:
        """Note a complete frame."""
        self.used_at_ns = monotonic_ns()
        self.late_since_ns = None
        self.is_used = True

    def close(self, why: CloseReason) -> None:
        """Cancel the task, now or as soon as it begins."""
        self.closed_for = why
        if self._task is not None:
            self._task.cancel()


class Listeners:
    """All listeners of one process, with their common table.

    Args:
        overdue_ns: Time limit of a peer to complete a frame, or to read answers.
    """

    def __init__(self, overdue_ns: int = OVERDUE_NS) -> None:
        self.table = ConnectionTable()
        self._overdue_ns = overdue_ns
        self._reported: dict[str, int] = {}

    def stats(self) -> list[ListenerStats]:
        """Return the figures of all listeners."""
        return [each.stats for each in self.table.listeners]

    async def serve(self) -> None:
        """Close overdue connections and report crowded listeners, until cancelled."""
        while True:
            await asyncio.sleep(self._overdue_ns / 4e9)
            for connection in self.table.remove_overdue(monotonic_ns(), self._overdue_ns):
                connection.close(CloseReason.OVERDUE)
            for stats in self.stats():
                self._report(stats)

    def _report(self, stats: ListenerStats) -> None:
        total = stats.refused + stats.evicted + stats.overdue
        if total == self._reported.get(stats.name, 0):
            return
        self._reported[stats.name] = total
        logger.warning(
            "%s: too many or too slow connections: %d of %d open; since the start %d"
            " refused, %d closed for new ones, %d closed as too slow",
            *(stats.name, stats.open, stats.limit, stats.refused, stats.evicted, stats.overdue),
            extra=caused_by(("connections", stats.name), stats.name),
        )


class ListeningSocket(Generic[C]):
    """One listening socket.

    Args:
        sock: The socket; closed by :meth:`close`.
        name: Shown in ``status`` and the log.
        server: Serves the connections.
        listeners: All listeners of the process.
        limits: Limits of the connections.
    """

    def __init__(
        self,
        sock: socket.socket,
        name: str,
        server: ConnectionServer[C],
        listeners: Listeners,
        limits: ListenerLimits,
    ) -> None:
        self._socket = sock
        self._server = server
        self._table = listeners.table
        self._listener = listeners.table.add_listener(name, limits)
        self._is_local = sock.family == socket.AF_UNIX
        reserve = descriptor_reserve()
        # Half of the reserve is for the operator of this host.
        # Counted once: the limit stays while the process runs.
        self._spare = spare_descriptors(0, reserve // 2 if self._is_local else reserve)

    async def serve(self) -> None:
        """Accept and serve until cancelled; then close all connections."""
        self._socket.setblocking(False)
        async with asyncio.TaskGroup() as group:
            try:
                while True:
                    await wait_readable(self._socket)
                    if not self._accept_some(group):
                        await asyncio.sleep(_PAUSE_S)
            finally:
                for connection in list(self._listener.connections):
                    connection.close(CloseReason.ENDED)

    def close(self) -> None:
        """Close the socket, which is not served any more."""
        self._table.remove_listener(self._listener)
        self._socket.close()

    def _accept_some(self, group: asyncio.TaskGroup) -> bool:
        """Accept waiting connections for one time slice; return False to pause."""
        end_ns = monotonic_ns() + (_LOCAL_ACCEPT_SLICE_NS if self._is_local else _ACCEPT_SLICE_NS)
        # By time, not by number: what a connection costs depends on its protocol.
        while monotonic_ns() < end_ns:
            try:
                sock, _ = self._socket.accept()
            except (BlockingIOError, ConnectionAbortedError, InterruptedError):
                return True
            except OSError as exc:
                return self._close_unused(exc)
            # accept() does not inherit O_NONBLOCK on Linux.
            sock.setblocking(False)
            try:
                connection = self._server.connection_from(sock, self._host_of(sock))
            except OSError as exc:
                logger.debug("%s: a peer disconnected at once: %s", self._listener.name, exc)
                sock.close()
                continue
            self._admit(connection, sock, group)
        return True

    def _host_of(self, sock: socket.socket) -> str:
        if self._is_local:
            # Clients of a Unix socket have no address; one process counts as one host.
            return f"process {process_of(sock)[0]}"
        return host_of(sock.getpeername()[0], sock.getsockname()[0])

    def _admit(self, connection: C, sock: socket.socket, group: asyncio.TaskGroup) -> None:
        # Each connection needs one descriptor, and the process needs some for files and the audit.
        spare = self._spare - sock.fileno()
        refusal, victim = self._table.admit(
            self._listener, connection, monotonic_ns(), spare_descriptors=spare
        )
        if refusal:
            logger.debug("%s: connection refused: %s", self._listener.name, refusal)
            self._server.refuse_connection(sock, refusal)
            sock.close()
            return
        if victim is not None:
            victim.close(CloseReason.EVICTED)
        # The victim is told to close; the limit may be exceeded for as long as it takes.
        task = group.create_task(self._serve(connection, sock))
        task.add_done_callback(lambda _: self._forget(connection, sock))

    async def _serve(self, connection: C, sock: socket.socket) -> None:
        try:
            await self._server.serve_connection(connection, sock)
        except* OSError as group:
            logger.debug("%s: connection ended: %s", self._listener.name, group.exceptions[0])
        except* Exception:  # a failed connection must not end the others
            logger.exception("%s: a connection failed", self._listener.name)

    def _forget(self, connection: C, sock: socket.socket) -> None:
        sock.close()
        self._table.remove(self._listener, connection)

    def _close_unused(self, error: OSError) -> bool:
        """Close an unused connection to free a descriptor; return whether there was one."""
        logger.debug("%s: %s", self._listener.name, error)
        # Without a free descriptor accept() fails until one is closed, and would spin.
        if error.errno not in OUT_OF_DESCRIPTORS:
            return False
        victim = self._table.shed(monotonic_ns())
        if victim is not None:
            victim.close(CloseReason.EVICTED)
        return victim is not None


async def wait_readable(sock: socket.socket) -> None:
    """Wait until the socket has data to read, or a connection to accept."""
    loop = asyncio.get_running_loop()
    readable = loop.create_future()
    loop.add_reader(sock, _set_once, readable)
    try:
        await readable
    finally:
        loop.remove_reader(sock)


def _set_once(future: asyncio.Future[None]) -> None:
    if not future.done():
        future.set_result(None)


def process_of(connection: socket.socket) -> tuple[int, int]:
    """Return process id and user id of the other end of a Unix socket."""
    octets = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, uid, _ = _CREDENTIALS.unpack(octets)
    return pid, uid


def connection_name(connection: socket.socket) -> str:
    """Return the peer with a number, a name that is unique in this process."""
    host, port = "", 0
    if connection.family == socket.AF_INET:
        with suppress(OSError):  # the peer has disconnected already
            host, port = connection.getpeername()
    return f"{host}:{port}#{next(_numbers)}"
