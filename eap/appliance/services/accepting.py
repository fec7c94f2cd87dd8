"""Connections of clients: accepted one after the other, and named."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Coroutine
from contextlib import suppress
from itertools import count
from typing import Any

_PAUSE_S = 1.0
"""After an error of the listener: mostly there are no descriptors left; who waits keeps waiting."""
_numbers = count(1)

logger = logging.getLogger(__name__)


async def accept_connections(
    listener: socket.socket,
    what: str,
    serve: Callable[[socket.socket, Any], Coroutine[Any, Any, None] | None],
) -> None:
    """Accept at *listener* until cancelled, with a task for each connection.

    Args:
        listener: It stays open.
        what: It is for, in words of the log.
        serve: Called with each connection and its peer's address (of IP: host and port), before
            the next one is accepted, so that a crowd is counted before it runs.  It returns what
            the task does, or None for one that it has closed.
    """
    listener.setblocking(False)
    loop = asyncio.get_running_loop()
    async with asyncio.TaskGroup() as group:
        while True:
            try:
                connection, address = await loop.sock_accept(listener)
            except OSError as exc:
                logger.warning("%s listener: %s", what, exc.strerror)
                await asyncio.sleep(_PAUSE_S)
                continue
            work = serve(connection, address)
            if work is not None:
                group.create_task(work)


def connection_name(connection: socket.socket) -> str:
    """Return a name that no other connection of this process ever has: peer, and a number."""
    host, port = "", 0
    if connection.family == socket.AF_INET:
        with suppress(OSError):  # the peer has gone again already
            host, port = connection.getpeername()
    return f"{host}:{port}#{next(_numbers)}"
