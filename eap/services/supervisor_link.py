"""Link of services to the supervisor, which opens and closes sockets while the appliance runs.

Replies are matched by number; each reply has a time-out.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Iterable
from time import monotonic_ns
from typing import TypeAlias

from msgspec.structs import replace

from eap.errors import EnvironmentalError
from eap.runtime.handover import BusSocket, SharedSocket
from eap.runtime.passing import (
    CloseSocket,
    KeepBuses,
    OpenBus,
    OpenSocket,
    SupervisorReply,
    SupervisorRequest,
    close_descriptors,
    pass_descriptors,
    receive_reply,
)

_Received: TypeAlias = tuple[SupervisorReply, dict[str, int]]

REPLY_S = 10.0
"""Time limit of a reply: the supervisor may search for the process that holds a port."""
BUS_REPLY_S = 30.0
"""The same for a bus: the process of simulated slaves starts first."""


class SupervisorLink:
    """Sends requests to the supervisor; constructed inside the loop that serves it.

    Args:
        sock: Local end of the pair; closed by :meth:`close`.
        reply_s: As REPLY_S.
    """

    def __init__(self, sock: socket.socket, *, reply_s: float = REPLY_S) -> None:
        self._socket = sock
        self._socket.setblocking(False)
        self._reply_s = reply_s
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._receive)
        self._waiting: dict[int, asyncio.Future[_Received]] = {}
        # Start above the numbers of the previous process: late replies to it match no request.
        self._last_id = monotonic_ns()

    async def open(self, wanted: SharedSocket) -> SharedSocket:
        """Return *wanted* with descriptors of its sockets, which the caller closes.

        Raises:
            EnvironmentalError: it cannot be opened, or the supervisor does not answer.
        """
        _, found = await self.request(lambda number: OpenSocket(number, wanted.key))
        key = wanted.key
        return SharedSocket(
            key.kind, key.address, key.port, key.group, key.vlan_id, wanted.owners, **found
        )

    async def open_bus(self, wanted: BusSocket) -> BusSocket:
        """Return *wanted* with its number and descriptors, which the caller closes.

        Raises as :meth:`open`, also if its slaves cannot be simulated.
        """
        reply, found = await self.request(
            lambda number: OpenBus(number, wanted.key), max(self._reply_s, BUS_REPLY_S)
        )
        return replace(wanted.key, number=reply.number, **found)

    def keep_buses(self, station: str, buses: Iterable[BusSocket]) -> None:
        """Have the supervisor close all buses of *station* but these."""
        # As in close_socket.
        pass_descriptors(self._socket, KeepBuses(station, tuple(each.key for each in buses)), [])

    def close_socket(self, shared: SharedSocket) -> None:
        """Have the supervisor close a socket that no process uses any more."""
        # If there is no room, the next services process has it closed.
        pass_descriptors(self._socket, CloseSocket(shared.key), [])

    async def request(
        self, make: Callable[[int], SupervisorRequest], reply_s: float | None = None
    ) -> _Received:
        """Send the request that *make* returns for its number; return the reply.

        The named descriptors come with it.

        Raises:
            EnvironmentalError: it failed, or the supervisor does not answer.
        """
        self._last_id = number = self._last_id + 1
        future: asyncio.Future[_Received] = self._loop.create_future()
        self._waiting[number] = future
        try:
            if not pass_descriptors(self._socket, make(number), []):
                raise EnvironmentalError("the supervisor accepts no requests")
            async with asyncio.timeout(self._reply_s if reply_s is None else reply_s):
                reply, descriptors = await future
        except TimeoutError:
            raise EnvironmentalError("the supervisor does not answer") from None
        finally:
            del self._waiting[number]
        if reply.error:
            raise EnvironmentalError(reply.error)
        return reply, descriptors

    def close(self) -> None:
        """Close the local end; the loop may have ended."""
        if not self._loop.is_closed():
            self._loop.remove_reader(self._socket)
        self._socket.close()

    def _receive(self) -> None:
        while (received := receive_reply(self._socket)) is not None:
            future = self._waiting.get(received[0].id)
            if future is None or future.done():
                close_descriptors(received[1])
            else:
                future.set_result(received)
