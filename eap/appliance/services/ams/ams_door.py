"""The AMS/TCP listener of an address: the stations there, and who has connected to them."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable, Coroutine
from secrets import randbelow
from typing import Any

from eap.appliance.discards import Refusal
from eap.appliance.services.accepting import accept_connections, connection_name
from eap.appliance.services.ams.ams_connection import (
    PATIENCE_S,
    AmsConnection,
    ClientAddresses,
    set_options,
)
from eap.appliance.services.ams.ams_shares import Shares
from eap.appliance.services.routing.entrance import Entrance
from eap.ids import NetId

logger = logging.getLogger(__name__)


class AmsClients:
    """Who has connected to any listener of this process, by name; the carrier of their door.

    Attributes:
        addresses: For clients that ask for an AMS address.
    """

    def __init__(self) -> None:
        self.addresses = ClientAddresses(randbelow(1 << 16))
        self._connections: dict[str, AmsConnection] = {}

    def __len__(self) -> int:
        return len(self._connections)

    def add(self, connection: AmsConnection) -> None:
        """Take one more."""
        self._connections[connection.name] = connection

    def remove(self, connection: AmsConnection) -> None:
        """Forget one that has ended."""
        del self._connections[connection.name]

    def send(self, connection: str, packets: tuple[bytes, ...]) -> str | None:
        """Send packets by a connection; return why not if there is none of that name."""
        found = self._connections.get(connection)
        return "the connection was closed" if found is None else found.send(packets)


class AmsDoor:
    """One listening socket and the stations behind it.

    A peer that has vanished without a word is found out by the kernel within a minute.

    Args:
        listener: Opened by the supervisor; it stays open.
        entrance: To the stations that are reached by it.
        clients: Where those who have connected are found when an answer is there.
        refuse: Counts what is not answered as it was wanted.
        patience_s: How long a packet, or answers that wait to be taken, may last.
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
        self.refuse = refuse
        self._listener = listener
        self._entrance = entrance
        self._clients = clients
        self._patience_s = patience_s
        self._shares = Shares()
        self._connections: set[AmsConnection] = set()

    async def serve(self) -> None:
        """Accept until cancelled; then close all connections."""
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._watch_slow())
                await accept_connections(self._listener, "AMS/TCP", self._take)
        finally:
            for connection in list(self._connections):
                connection.close("the appliance ends")

    def connection_opened(self, connection: AmsConnection) -> None:
        """Keep it (PacketTaker)."""
        self._connections.add(connection)
        self._clients.add(connection)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Let others have its place (PacketTaker)."""
        logger.debug("AMS/TCP connection %s: %s", connection.name, why)
        self._connections.remove(connection)
        self._clients.remove(connection)
        self._shares.give_back(connection.host)
        self._entrance.connection_closed(connection.name)

    def take_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Hand a request to the stations (PacketTaker)."""
        self._entrance.receive(packet, connection.name)

    def take_answer(self, packet: bytes, connection: AmsConnection) -> None:
        """Count a response: nothing is asked by connections that others opened (PacketTaker)."""
        del packet, connection
        self.refuse(Refusal.AMS_UNASKED)

    def _take(
        self, sock: socket.socket, address: tuple[str, int]
    ) -> Coroutine[Any, Any, None] | None:
        host, _ = address
        why_not = self._shares.take(host, sock.getsockname()[0])
        if why_not is not None:
            logger.debug("AMS/TCP connection from %s closed: %s", host, why_not)
            self.refuse(Refusal.AMS_FULL)
            sock.close()
            return None
        return self._open(sock, host)

    async def _open(self, sock: socket.socket, host: str) -> None:
        loop = asyncio.get_running_loop()
        name = connection_name(sock)
        try:
            set_options(sock)
            await loop.connect_accepted_socket(
                lambda: AmsConnection(name, host, self, give_address=self._give_address), sock
            )
        except OSError as exc:  # it has gone again already
            logger.debug("AMS/TCP connection %s: %s", name, exc.strerror)
            self._shares.give_back(host)
            sock.close()

    def _give_address(self, host: str) -> tuple[NetId, int]:
        return self._clients.addresses.next(host, self._entrance.has)

    async def _watch_slow(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            await asyncio.sleep(self._patience_s / 4)
            for connection in list(self._connections):
                connection.find_slow(loop.time(), self._patience_s)
