"""Reconnecting links: connections that are re-established, after growing pauses, when they end."""

from __future__ import annotations

import asyncio
import socket
from abc import ABC, abstractmethod
from random import uniform
from typing import NamedTuple

from eap.net.tcp import set_stream_options


class ReconnectPolicy(NamedTuple):
    """ReconnectPolicy between two attempts to connect."""

    first_s: float
    longest_s: float
    lasting_s: float
    """A connection that lasted longer was a good one: the next pause is the first again."""


class Backoff:
    """Waits that grow twofold up to a limit, each shortened by chance.

    So clients that lost one peer at the same moment come back at different ones.

    Args:
        first_s: The longest that the first wait may be.
        longest_s: The limit.
    """

    def __init__(self, first_s: float, longest_s: float) -> None:
        self._first_s = first_s
        self._longest_s = longest_s
        self._next_s = first_s

    def next_s(self) -> float:
        """Return the next wait in seconds."""
        wait_s = self._next_s
        self._next_s = min(2 * wait_s, self._longest_s)
        return uniform(wait_s / 2, wait_s)  # noqa: S311  to spread waits, no secret

    def reset(self) -> None:
        """Begin with the first wait again."""
        self._next_s = self._first_s


class ReconnectingLink(ABC):
    """Connection to one peer that is made again whenever it ends.

    A protocol says how to connect and serve, and what an end means for its users.

    Attributes:
        reason: Why there is no connection, as it was reported; empty while there is one.
    """

    def __init__(self, pauses: ReconnectPolicy) -> None:
        self.reason = ""
        self._pauses = pauses

    async def run(self) -> None:
        """Keep the connection until cancelled, or as long as it is wanted."""
        loop = asyncio.get_running_loop()
        backoff = Backoff(self._pauses.first_s, self._pauses.longest_s)
        is_wanted = True
        while is_wanted:
            began_s = loop.time()
            reason = await self._connect()
            has_lasted = loop.time() - began_s > self._pauses.lasting_s
            if has_lasted:
                backoff.reset()
            if not self._disconnected(reason, has_lasted=has_lasted):
                return
            await asyncio.sleep(backoff.next_s())
            is_wanted = self._is_wanted()

    @abstractmethod
    async def _connect(self) -> str:
        """Connect, and serve until the connection ends; return why there is none, or none any more.

        An empty reason stands for an orderly end.
        """

    @abstractmethod
    def _disconnected(self, reason: str, *, has_lasted: bool) -> bool:
        """Notify the users of the link; return whether to connect again."""

    def _is_wanted(self) -> bool:
        """Return whether to connect again after a pause."""
        return True

    def _is_new_reason(self, reason: str) -> bool:
        """Keep a reason; say whether it is another one than before, and worth a line in the log."""
        is_news, self.reason = reason != self.reason, reason
        return is_news


async def connect_tcp(
    host: str, port: int, source: str | None, *, timeout_s: float, unconfirmed_s: float
) -> socket.socket:
    """Return a socket that is connected.

    Args:
        host: Address of the peer.
        port: Its port.
        source: Own address to connect from, None for any.
        timeout_s: Time for the peer to accept.
        unconfirmed_s: Time for the peer to confirm sent data, before the connection is lost.

    Raises:
        TimeoutError: the peer does not answer in time.
        OSError: the peer refuses the connection, or is not reached.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        set_stream_options(sock, unconfirmed_s)
        if source is not None:
            sock.bind((source, 0))
        async with asyncio.timeout(timeout_s):
            await asyncio.get_running_loop().sock_connect(sock, (host, port))
        # To an ephemeral port of this host, a connect may get that port as its own (simultaneous
        # open).
        if sock.getsockname() == sock.getpeername():
            raise ConnectionRefusedError  # noqa: TRY301  connected to itself: no listener
    except BaseException:
        sock.close()
        raise
    return sock
