"""WebSockets of browsers: topics out, the wanted topics in.

A client that does not read stalls nobody: its own task waits for it, its slot keeps the latest
message of each topic, and after SLOW_S without progress it is disconnected.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import Any

import msgspec
from aiohttp import WSCloseCode, WSMessage, WSMsgType, web

from eap.net.limits import RateLimiter
from eap.release import RELEASE
from eap.web.feed import PlantFeed
from eap.web.guard import TOKEN, Guard, needs_user, refusal
from eap.web.sessions import SESSION_S
from eap.web.topics import PageTopics, Slot

MAX_CLIENTS = 200
MAX_PER_HOST = 100
SLOW_S = 10.0
_MAX_MESSAGE = 4096
_HEARTBEAT_S = 20.0
_RATE = 20, 2.0
"""Messages of a client at once, and each second in the long run."""


class Wanted(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Message of a client: all topics that it wants from now on."""

    subscribe: list[str]


class Sockets:
    """All WebSockets.

    Args:
        feed: The plant.
        topics: Make the messages.
        guard: Has the sessions.
    """

    def __init__(self, feed: PlantFeed, topics: PageTopics, guard: Guard) -> None:
        self._feed = feed
        self._topics = topics
        self._guard = guard
        self._open: dict[web.WebSocketResponse, tuple[str, str]] = {}

    async def serve(self, request: web.Request) -> web.StreamResponse:
        """Serve one client until it leaves."""
        user = needs_user(request)
        # Browsers send cookies with a WebSocket of any site, and need no permission to read it.
        if (refused := self._guard.refuse_foreign(request)) is not None:
            return refused
        host = self._guard.host_of(request)
        of_host = sum(1 for known, _ in self._open.values() if known == host)
        if len(self._open) >= MAX_CLIENTS or of_host >= MAX_PER_HOST:
            return refusal(503, "too many WebSockets are open")
        socket = web.WebSocketResponse(
            heartbeat=_HEARTBEAT_S, max_msg_size=_MAX_MESSAGE, compress=False
        )
        await socket.prepare(request)
        self._open[socket] = host, request[TOKEN]
        slot = Slot()
        welcome = {
            "type": "welcome",
            "version": 1,
            "release": RELEASE,
            "plant": self._feed.plant,
            "user": user.name,
            "role": user.role,
        }
        try:
            # A session that has expired ends here too; the page connects again.
            async with asyncio.timeout(SESSION_S), asyncio.TaskGroup() as group:
                await self._send(socket, msgspec.json.encode(welcome))
                sending = group.create_task(self._send_all(socket, slot))
                await self._receive(socket, slot)
                sending.cancel()
        except* (OSError, TimeoutError, RuntimeError):
            # The client has gone, or does not read: close() would wait for it.
            if request.transport is not None:
                with suppress(AttributeError):  # asyncio: a TLS transport that was closed twice
                    request.transport.abort()
        finally:
            del self._open[socket]
            self._topics.leave(slot)
        return socket

    async def close_all(self) -> None:
        """Tell all clients that the server ends."""
        for socket in list(self._open):
            with suppress(OSError, TimeoutError, RuntimeError):
                async with asyncio.timeout(0.2):
                    await socket.close(code=WSCloseCode.GOING_AWAY, message=b"the server ends")

    async def end_session(self, token: str) -> None:
        """Close the WebSockets of a session that has ended."""
        for socket, (_, own) in list(self._open.items()):
            if own == token:
                with suppress(OSError, TimeoutError, RuntimeError):
                    async with asyncio.timeout(0.2):
                        await socket.close(code=WSCloseCode.POLICY_VIOLATION)

    async def _receive(self, socket: web.WebSocketResponse, slot: Slot) -> None:
        clock = asyncio.get_running_loop().time
        rate = RateLimiter(*_RATE, clock())
        async for message in socket:
            if not rate.take(clock()):
                await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=b"too many messages")
                return
            if (wanted := _decode(message)) is None:
                text = b'expected {"subscribe": [TOPIC, ...]}'
                await socket.close(code=WSCloseCode.INVALID_TEXT, message=text)
                return
            errors = self._topics.replace(slot, wanted.subscribe)
            answer: dict[str, Any] = {
                "type": "subscribed",
                "topics": [each for each in wanted.subscribe if each not in errors],
                "errors": errors,
            }
            await self._send(socket, msgspec.json.encode(answer))

    async def _send_all(self, socket: web.WebSocketResponse, slot: Slot) -> None:
        while True:
            for message in await slot.take():
                await self._send(socket, message)

    async def _send(self, socket: web.WebSocketResponse, message: bytes) -> None:
        async with asyncio.timeout(SLOW_S):
            await socket.send_frame(message, WSMsgType.TEXT)


def _decode(message: WSMessage) -> Wanted | None:
    if message.type is not WSMsgType.TEXT:
        return None
    try:
        return msgspec.json.decode(message.data, type=Wanted)
    except msgspec.MsgspecError:
        return None
