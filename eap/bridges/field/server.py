"""Server of a memory to clients of one protocol: connections, and writes passed to the plant."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections import Counter
from collections.abc import Callable, Mapping
from ipaddress import ip_address
from typing import Any, Literal

from eap.bridges.bridge import Bridge
from eap.bridges.field.memory import ServedMemory, ServedPoint
from eap.bridges.field.protocol import FieldSession
from eap.bridges.values import Sample
from eap.config.bridge_sections import FieldServer
from eap.config.field import served_point
from eap.config.listen import parse_listen
from eap.errors import CodecError, EapError, EnvironmentalError

MAX_CLIENTS = 64
MAX_CLIENTS_OF_HOST = 16
UNFINISHED_S = 10.0
"""Time for a client to complete a frame, or to take replies."""
_CHUNK = 65_536
_BACKLOG = 16

logger = logging.getLogger(__name__)


def open_server(listen: str) -> socket.socket:
    """Return a listening socket.

    Raises:
        EnvironmentalError: the port cannot be opened; the message says how to get it.
    """
    host, port = parse_listen(listen)
    family = socket.AF_INET6 if ip_address(host).version == 6 else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except PermissionError:
        raise EnvironmentalError(
            f"{listen}: ports below 1024 need CAP_NET_BIND_SERVICE; grant it to the appliance's"
            f" unit, or listen on another port"
        ) from None
    except OSError as exc:
        # strerror has the address again.
        raise EnvironmentalError(f"{listen}: {os.strerror(exc.errno or 0)}") from None


class FieldServing:
    """A server of variables.

    Args:
        bridge: The plant.
        server: Its addresses.
        key: Its transport in access rules.
        make_session: Makes the answers to one client.

    Attributes:
        memory: The served memory.
    """

    def __init__(
        self,
        bridge: Bridge,
        server: FieldServer,
        key: Literal["s7", "modbus"],
        make_session: Callable[[ServedMemory], FieldSession],
    ) -> None:
        self._bridge = bridge
        self._server = server
        self._key = key
        self._make_session = make_session
        self._hosts: Counter[str] = Counter()
        self._tasks: set[asyncio.Task[None]] = set()
        points = [
            ServedPoint(each.name, served_point(each, server), each.write) for each in server.items
        ]
        self.memory = ServedMemory(points)
        self._feed = bridge.feed(self.memory.names, server.every_ms, on_values=self._show)
        self._complaints: dict[str, str] = {}

    async def run(self) -> None:
        """Serve until cancelled.

        Raises:
            EnvironmentalError: the port cannot be opened.
        """
        status = self._bridge.status
        with open_server(self._server.listen) as listener:
            server = await asyncio.start_server(self._accept, sock=listener)
            url = f"{self._key}://{self._server.listen}"
            self._bridge.connected(url)
            status.clients = 0
            self._bridge.ready()
            try:
                await self._feed.run()
            finally:
                server.close()
                for task in self._tasks:
                    task.cancel()
                self._bridge.away(url, "ended")

    def _show(self, samples: Mapping[str, Sample]) -> None:
        for name, sample in samples.items():
            # Clients read the value before, or get the error that there is none yet.
            if not sample.has_value:
                continue
            self._bridge.status.sent += 1
            why = self.memory.update(name, sample.value)
            if why and self._complaints.get(name) != why:
                logger.warning("clients see the value before: %s", why)
            self._complaints[name] = why

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        peer = writer.get_extra_info("peername")
        if task is None or peer is None:  # it has gone already
            writer.transport.abort()
            return
        host = str(peer[0])
        is_full = self._hosts.total() >= MAX_CLIENTS or self._hosts[host] >= MAX_CLIENTS_OF_HOST
        # Without an answer: both protocols have none before the first request.
        if is_full:
            self._bridge.status.dropped += 1
            writer.transport.abort()
            return
        self._tasks.add(task)
        self._hosts[host] += 1
        self._bridge.status.clients = self._hosts.total()
        try:
            await self._serve(host, reader, writer)
        except asyncio.CancelledError:
            pass  # the bridge ends; asyncio logs handlers that say so
        except TimeoutError:
            logger.info("%s: disconnected: too slow", host)
        except (CodecError, OSError) as exc:
            logger.info("%s: disconnected: %s", host, exc)
        finally:
            writer.transport.abort()
            self._tasks.discard(task)
            self._hosts[host] -= 1
            self._bridge.status.clients = self._hosts.total()

    async def _serve(
        self, host: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        session, buffer = self._make_session(self.memory), b""
        while True:
            # A client may be silent for long, but not within a frame.
            async with asyncio.timeout(UNFINISHED_S if buffer else None):
                data = await reader.read(_CHUNK)
            if not data:
                return
            buffer += data
            while (length := session.frame_length(buffer)) is not None and len(buffer) >= length:
                frame, buffer = buffer[:length], buffer[length:]
                reply = await self._answer(session, host, frame)
                if reply:
                    writer.write(reply)
            async with asyncio.timeout(UNFINISHED_S):
                await writer.drain()

    async def _answer(self, session: FieldSession, host: str, frame: bytes) -> bytes:
        answer, why = session.answer(frame), ""
        changes: Mapping[str, Any]
        try:
            changes = next(answer)
            while True:
                why = await self._write(changes, host)
                changes = answer.send(why)
        except StopIteration as end:
            reply: bytes = end.value
            return reply

    async def _write(self, changes: Mapping[str, Any], host: str) -> str:
        """Write variables for a client; return why that was refused, empty if it was done."""
        try:
            await self._bridge.write_all(changes, transport=self._key, host=host)
        except EapError as exc:
            logger.info("%s: write refused: %s", host, exc)
            return str(exc)
        # A client that reads at once gets what it wrote; the plant's value follows.
        for name, value in changes.items():
            self.memory.update(name, value)
            self._feed.report_again(name)
        return ""
