"""Connections to other stations: made when there is data to send, and again when they break.

Data sent before there is a connection waits for it, in bounded memory.  A hop that is not reached
is down, so that requests for it are answered at once, and is tried again with growing pauses for as
long as a route leads to it.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Protocol, TypeAlias

from eap.appliance.services.tasks import TaskSet
from eap.net.reconnecting import Pauses, ReconnectingLink, connect_tcp

CONNECT_S = 3.0
"""How long the other side may take to accept."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 8.0
_LASTING_S = 5.0
"""A connection that ends sooner counts as one that could not be made."""
_UNCONFIRMED_S = 10.0
"""Time for the other side to confirm what was sent, before the connection is lost."""
_MAX_WAITING = 256 << 10
"""Octets that wait for one connection."""

Write: TypeAlias = Callable[[bytes], None]
Serve: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter, str], Awaitable[None]]
"""Takes what comes by a connection, with the address of its other end, until it ends."""


class Hops(Protocol):
    """The routers for which there are connections."""

    def hop_down(self, address: str, text: str) -> None:
        """Answer what waits for a hop, and what will be for it."""

    def hop_up(self, address: str) -> None:
        """Pass requests on again."""

    def is_wanted(self, address: str) -> bool:
        """Say whether a route leads there."""

    def is_awaited(self, address: str) -> bool:
        """Say whether an answer from there is waited for."""


class Uplinks:
    """The connections of one transport to other stations, by ``ADDRESS:PORT``.

    Args:
        hops: Hears of those that come and go.
        serve: Takes what comes by one.
        source: Own address to connect from; empty for any.
    """

    def __init__(self, hops: Hops, serve: Serve, source: str = "") -> None:
        self._hops = hops
        self._serve = serve
        self._source = source
        self._uplinks: dict[str, _Uplink] = {}
        self._tasks = TaskSet("connections to other stations")

    def send(self, address: str, data: bytes) -> str | None:
        """Send *data*, now or when there is a connection; return why not if that cannot be."""
        uplink = self._uplinks.get(address)
        if uplink is None:
            if not _is_address(address):
                return "the connection is closed"
            uplink = _Uplink(address, self._source, self._hops, self._serve)
            self._uplinks[address] = uplink
            self._tasks.start(self._run(address, uplink))
        return uplink.send(data)

    async def close(self) -> None:
        """Close all connections."""
        await self._tasks.close()

    async def _run(self, address: str, uplink: _Uplink) -> None:
        try:
            await uplink.run()
        finally:
            del self._uplinks[address]
            self._hops.hop_up(address)


class _Uplink(ReconnectingLink):
    """Link to one other station, and the data that waits for its connection."""

    def __init__(self, address: str, source: str, hops: Hops, serve: Serve) -> None:
        super().__init__(Pauses(FIRST_PAUSE_S, LONGEST_PAUSE_S, _LASTING_S))
        self._address = address
        self._source = source or None
        self._hops = hops
        self._serve = serve
        self._writer: asyncio.StreamWriter | None = None
        self._waiting: deque[bytes] = deque()
        self._octets = 0

    def send(self, data: bytes) -> str | None:
        """Send data, or keep it for the next connection; return why not if that cannot be."""
        if self._writer is not None:
            if self._writer.is_closing():
                return "the connection is closed"
            if self._writer.transport.get_write_buffer_size() > _MAX_WAITING:
                return "the other side takes nothing"
            self._writer.write(data)
            return None
        if self._octets + len(data) > _MAX_WAITING:
            return "too much waits for the connection"
        self._octets += len(data)
        self._waiting.append(data)
        return None

    async def _connect(self) -> str:
        """Connect, and serve until the end (ReconnectingLink)."""
        host, _, port = self._address.rpartition(":")
        try:
            sock = await connect_tcp(
                host,
                int(port),
                self._source,
                timeout_s=CONNECT_S,
                unconfirmed_s=_UNCONFIRMED_S,
            )
        except TimeoutError:
            return f"no connection within {CONNECT_S:g} s"
        except OSError as exc:
            return f"no connection: {exc.strerror or exc}"
        reader, writer = await asyncio.open_connection(sock=sock)
        try:
            self._hops.hop_up(self._address)
            self._writer = writer
            writer.writelines(self._waiting)
            self._forget()
            await self._serve(reader, writer, self._address)
        except (OSError, TimeoutError) as exc:
            return f"the connection broke: {exc.strerror or 'the other side takes nothing'}"
        finally:
            self._writer = None
            writer.transport.abort()
        return ""

    def _disconnected(self, reason: str, *, has_lasted: bool) -> bool:
        """Tell the routers, unless nobody waits for an answer (ReconnectingLink)."""
        del has_lasted
        self._forget()
        if not reason and not self._hops.is_awaited(self._address):
            return False
        self._hops.hop_down(self._address, reason or "the connection was closed")
        return True

    def _is_wanted(self) -> bool:
        """Say whether a route leads there (ReconnectingLink)."""
        return self._hops.is_wanted(self._address)

    def _forget(self) -> None:
        self._waiting.clear()
        self._octets = 0


def _is_address(text: str) -> bool:
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdecimal()
