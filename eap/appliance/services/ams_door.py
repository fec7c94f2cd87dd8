"""The AMS/TCP listener of an address: the stations there, and who has connected to them."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Sequence
from contextlib import suppress
from ipaddress import IPv4Address

from eap.appliance.discards import Refusal
from eap.appliance.services.ams_connection import PATIENCE_S, AmsConnection
from eap.appliance.services.aoe_desk import AoeDesk

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
        desks: Of the stations that are reached by it.
        refuse: Counts what is not answered as it was wanted.
        patience_s: As in :class:`AmsConnection`.
    """

    def __init__(
        self,
        listener: socket.socket,
        desks: Sequence[AoeDesk],
        refuse: Callable[[Refusal], None],
        *,
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._listener = listener
        self._desks = desks
        self._refuse = refuse
        self._patience_s = patience_s
        self._count = 0

    async def serve(self) -> None:
        """Accept until cancelled."""
        self._listener.setblocking(False)
        loop = asyncio.get_running_loop()
        async with asyncio.TaskGroup() as group:
            while True:
                try:
                    connection, address = await loop.sock_accept(self._listener)
                except OSError as exc:
                    logger.warning("AMS/TCP listener: %s", exc.strerror)
                    await asyncio.sleep(1)
                    continue
                if self._count < MAX_CONNECTIONS:
                    self._count += 1  # not in the task: a crowd is accepted before it runs
                    group.create_task(self._serve(connection, address[0]))
                else:
                    logger.debug("AMS/TCP connection from %s closed: too many", address[0])
                    self._refuse(Refusal.AMS_FULL)
                    connection.close()

    async def _serve(self, connection: socket.socket, host: str) -> None:
        try:
            with connection:
                await self._talk(connection, host)
        finally:
            self._count -= 1

    async def _talk(self, connection: socket.socket, host: str) -> None:
        is_here = is_this_host(host, connection.getsockname()[0])
        _set_options(connection)
        reader, writer = await asyncio.open_connection(sock=connection)
        client = AmsConnection(
            reader,
            writer,
            self._desks,
            self._refuse,
            is_this_host=is_here,
            patience_s=self._patience_s,
        )
        with suppress(OSError):  # it broke off, which is its right
            try:
                await client.serve()
                async with asyncio.timeout(self._patience_s):
                    writer.close()
                    await writer.wait_closed()
            finally:
                writer.transport.abort()


def is_this_host(peer: str, own: str) -> bool:
    """Tell whether *peer*, that connected to *own*, is this machine: who is has its address."""
    return IPv4Address(peer).is_loopback or peer == own


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
