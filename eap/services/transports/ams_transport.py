"""The AMS/TCP listener of an address: the stations behind it, and the clients that connected."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from secrets import randbelow

from eap.ids import NetId
from eap.net.connections import CloseReason, Limits
from eap.net.tcp import set_stream_options
from eap.runtime.discards import Refusal
from eap.services.transports.accepting import Listeners, ListeningSocket, connection_name
from eap.services.transports.ams_connection import AmsConnection, ClientAddresses
from eap.services.transports.demultiplexer import Demultiplexer

LIMITS = Limits()

logger = logging.getLogger(__name__)


class AmsClients:
    """Connections to all AMS/TCP listeners of this process, by name; the carrier of their door.

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


class AmsTransport:
    """One listening socket and the stations behind it.

    A peer that has vanished without a word is found out by the kernel within a minute.

    Args:
        listener: Opened by the supervisor; it stays open.
        entrance: To the stations that are reached by it.
        clients: Where those who have connected are found when an answer is there.
        refuse: Counts what is not answered as it was wanted.
        listeners: Of this process.
    """

    def __init__(
        self,
        listener: socket.socket,
        demultiplexer: Demultiplexer,
        clients: AmsClients,
        refuse: Callable[[Refusal], None],
        listeners: Listeners,
    ) -> None:
        self.refuse = refuse
        self._demultiplexer = demultiplexer
        self._clients = clients
        name = "ams-tcp {}:{}".format(*listener.getsockname())
        self._listening = ListeningSocket(listener, name, self, listeners, LIMITS)

    async def serve(self) -> None:
        """Accept until cancelled; then close all connections."""
        await self._listening.serve()

    def connection_from(self, sock: socket.socket, host: str) -> AmsConnection:
        """Return the connection on a socket that was accepted (ConnectionServer)."""
        set_stream_options(sock)
        return AmsConnection(
            connection_name(sock),
            sock.getpeername()[0],
            self,
            host=host,
            give_address=self._give_address,
        )

    async def serve_connection(self, connection: AmsConnection, sock: socket.socket) -> None:
        """Serve a connection until its end (ConnectionServer)."""
        loop = asyncio.get_running_loop()
        await loop.connect_accepted_socket(lambda: connection, sock)
        try:
            await connection.closed
        finally:
            connection.close(CloseReason.ENDED)

    def refuse_connection(self, sock: socket.socket, why: str) -> None:
        """Count a connection that gets no place (ConnectionServer)."""
        del sock, why
        self.refuse(Refusal.AMS_FULL)

    def connection_opened(self, connection: AmsConnection) -> None:
        """Keep it (PacketTaker)."""
        self._clients.add(connection)

    def connection_closed(self, connection: AmsConnection, why: str) -> None:
        """Let others have its place (PacketTaker)."""
        logger.debug("AMS/TCP connection %s: %s", connection.name, why)
        self._clients.remove(connection)
        self._demultiplexer.connection_closed(connection.name)

    def take_packet(self, packet: bytes, connection: AmsConnection) -> None:
        """Hand a request to the stations (PacketTaker)."""
        self._demultiplexer.receive(packet, connection.name)

    def take_answer(self, packet: bytes, connection: AmsConnection) -> None:
        """Count a response: nothing is asked by connections that others opened (PacketTaker)."""
        del packet, connection
        self.refuse(Refusal.AMS_UNASKED)

    def _give_address(self, host: str) -> tuple[NetId, int]:
        return self._clients.addresses.next(host, self._demultiplexer.has)
