"""The AMS/TCP listener of an address: the stations there, and who has connected to them."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

from eap.appliance.discards import Refusal
from eap.appliance.services.accepting import accept_connections, connection_name
from eap.appliance.services.ams_connection import PATIENCE_S, AmsClients, AmsConnection
from eap.appliance.services.routing.entrance import Entrance

MAX_CONNECTIONS = 128
"""Of one listener."""
_PROBE_AFTER_S = 30
_PROBES = 3
_PROBE_S = 10

logger = logging.getLogger(__name__)


class AmsDoor:
    """One listening socket and the stations behind it.

    A peer that has vanished without a word is found out by the kernel within a minute.

    Args:
        listener: Opened by the supervisor; it stays open.
        entrance: To the stations that are reached by it.
        clients: Where those who have connected are found when an answer is there.
        refuse: Counts what is not answered as it was wanted.
        patience_s: As in :class:`AmsConnection`.
    """

    def __init__(
        self,
        listener: socket.socket,
        entrance: Entrance,
        clients: AmsClients,
        refuse: Callable[[Refusal], None],
        *,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._listener = listener
        self._entrance = entrance
        self._clients = clients
        self._refuse = refuse
        self._patience_s = patience_s
        self._count = 0

    async def serve(self) -> None:
        """Accept until cancelled."""
        await accept_connections(self._listener, "AMS/TCP", self._take)

    def _take(self, connection: socket.socket, peer: str) -> Coroutine[Any, Any, None] | None:
        if self._count >= MAX_CONNECTIONS:
            logger.debug("AMS/TCP connection from %s closed: too many", peer)
            self._refuse(Refusal.AMS_FULL)
            connection.close()
            return None
        self._count += 1
        return self._serve(connection)

    async def _serve(self, connection: socket.socket) -> None:
        try:
            with connection:
                await self._talk(connection)
        finally:
            self._count -= 1

    async def _talk(self, connection: socket.socket) -> None:
        name = connection_name(connection)
        _set_options(connection)
        reader, writer = await asyncio.open_connection(sock=connection)
        client = AmsConnection(
            name,
            reader,
            writer,
            self._entrance,
            self._refuse,
            patience_s=self._patience_s,
        )
        self._clients.add(name, client)
        with suppress(OSError):  # it broke off, which is its right
            try:
                await client.serve()
                async with asyncio.timeout(self._patience_s):
                    await self._entrance.wait_below(name, 1)
                    writer.close()
                    await writer.wait_closed()
            finally:
                writer.transport.abort()
                self._clients.remove(name)
                self._entrance.connection_closed(name)


def _set_options(connection: socket.socket) -> None:
    connection.setblocking(False)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (
        (socket.TCP_KEEPIDLE, _PROBE_AFTER_S),
        (socket.TCP_KEEPINTVL, _PROBE_S),
        (socket.TCP_KEEPCNT, _PROBES),
        (socket.TCP_NODELAY, 1),
    ):
        connection.setsockopt(socket.IPPROTO_TCP, option, value)
