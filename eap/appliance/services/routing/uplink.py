"""Connections to other stations: made when something is to be sent, and again when they break.

What is sent before there is one waits for it, in bounded memory.  A hop that cannot be reached is
down, so that requests for it are answered at once, and is tried again with growing pauses for as
long as some route leads to it.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Awaitable, Callable
from typing import Protocol, TypeAlias

from eap.appliance.services.tasks import TaskSet
from eap.net.backoff import Backoff

CONNECT_S = 3.0
"""How long the other side may take to accept."""
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 8.0
_LASTING_S = 5.0
"""A connection that ends sooner counts as one that could not be made."""
_MAX_WAITING = 256 << 10
"""Octets that wait for one connection."""

Write: TypeAlias = Callable[[bytes], None]
Serve: TypeAlias = Callable[[asyncio.StreamReader, asyncio.StreamWriter, str], Awaitable[None]]
"""Takes what comes by a connection, with the address of its other end, until it ends."""

logger = logging.getLogger(__name__)


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
    """The connections of one door to other stations, by ``ADDRESS:PORT``.

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
            uplink = self._uplinks[address] = _Uplink()
            self._tasks.start(self._run(address, uplink))
        return uplink.send(data)

    async def close(self) -> None:
        """Close all connections."""
        await self._tasks.close()

    async def _run(self, address: str, uplink: _Uplink) -> None:
        loop = asyncio.get_running_loop()
        backoff = Backoff(FIRST_PAUSE_S, LONGEST_PAUSE_S)
        try:
            while True:
                began_s = loop.time()
                text = await self._connect(address, uplink)
                uplink.drop()
                if not text and not self._hops.is_awaited(address):
                    return  # nobody misses it
                self._hops.hop_down(address, text or "the connection was closed")
                if loop.time() - began_s > _LASTING_S:
                    backoff.reset()
                await asyncio.sleep(backoff.next_s())
                if not self._hops.is_wanted(address):
                    return
        finally:
            del self._uplinks[address]
            self._hops.hop_up(address)

    async def _connect(self, address: str, uplink: _Uplink) -> str:
        """Have a connection as long as it lasts; return why it broke, nothing if it just ended."""
        host, _, port = address.rpartition(":")
        source = (self._source, 0) if self._source else None
        try:
            async with asyncio.timeout(CONNECT_S):
                reader, writer = await asyncio.open_connection(host, int(port), local_addr=source)
        except TimeoutError:
            return f"no connection within {CONNECT_S:g} s"
        except OSError as exc:
            return f"no connection: {exc.strerror or exc}"
        try:
            self._hops.hop_up(address)
            uplink.open(writer)
            await self._serve(reader, writer, address)
        except (OSError, TimeoutError) as exc:
            return f"the connection broke: {exc.strerror or 'the other side takes nothing'}"
        finally:
            writer.transport.abort()
        return ""


class _Uplink:
    """One connection, or what waits for it."""

    def __init__(self) -> None:
        self._writer: asyncio.StreamWriter | None = None
        self._waiting: deque[bytes] = deque()
        self._octets = 0

    def send(self, data: bytes) -> str | None:
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

    def open(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        for data in self._waiting:
            writer.write(data)
        self._forget()

    def drop(self) -> None:
        self._writer = None
        self._forget()

    def _forget(self) -> None:
        self._waiting.clear()
        self._octets = 0


def _is_address(text: str) -> bool:
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdecimal()
