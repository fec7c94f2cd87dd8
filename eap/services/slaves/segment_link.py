"""Services' end of the pair on which a simulated segment takes commands: faults and values."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Mapping
from contextlib import suppress
from time import monotonic_ns
from typing import Any

import msgspec

from devicebus.errors import BusError

TIMEOUT_S = 2.0

_MAX_MESSAGE = 1 << 16


class SegmentLink:
    """Sends commands to one segment process; to be made inside the loop that serves it."""

    def __init__(self, sock: socket.socket, *, timeout_s: float = TIMEOUT_S) -> None:
        self._socket = sock
        self._socket.setblocking(False)
        self._timeout_s = timeout_s
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._receive)
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._last_id = monotonic_ns()  # of another number than those before a restart

    async def command(self, command: Mapping[str, Any]) -> None:
        """Let a command take effect.

        Raises:
            ValueError: the segment refuses it, with the reason.
            BusError: the segment does not answer.
        """
        self._last_id += 1
        number = self._last_id
        future: asyncio.Future[dict[str, Any]] = self._loop.create_future()
        self._waiting[number] = future
        try:
            self._socket.send(msgspec.json.encode({**command, "id": number}))
            async with asyncio.timeout(self._timeout_s):
                answer = await future
        except (OSError, TimeoutError):
            raise BusError("the simulated segment does not answer") from None
        finally:
            del self._waiting[number]
        if not answer.get("ok"):
            raise ValueError(str(answer.get("error", "refused")))

    def close(self) -> None:
        """Let go of the pair; the loop may have ended."""
        if not self._loop.is_closed():
            self._loop.remove_reader(self._socket)
        self._socket.close()

    def _receive(self) -> None:
        try:
            octets = self._socket.recv(_MAX_MESSAGE)
        except OSError:
            return
        if not octets:
            self._loop.remove_reader(self._socket)
            return
        with suppress(ValueError):
            answer = msgspec.json.decode(octets, type=dict[str, Any])
            # An answer after its time-out has no waiter any more.
            future = self._waiting.get(answer.get("id", 0))
            if future is not None and not future.done():
                future.set_result(answer)
