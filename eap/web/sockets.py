"""WebSockets of browsers: topics out, the wanted topics in.

A client that does not read stalls nobody: its own task waits for it, only the latest message of
each part of a topic is kept for it, and after SLOW_S without progress it is disconnected.
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
from eap.web.topics import PageTopics, PendingMessages

MAX_CLIENTS = 200
MAX_PER_HOST = 100
SLOW_S = 10.0
_MAX_MESSAGE = 4096
_HEARTBEAT_S = 20.0
_RATE = 20, 2.0
"""Messages of a client at once, and each second in the long run."""


class TopicRequest(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Message of a client: the topics that it gets from now on."""

    subscribe: list[str]


class WebSocketServer:
    """WebSockets of all clients.

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
        # One host must not take all places.
        of_host = sum(1 for known, _ in self._open.values() if known == host)
        if len(self._open) >= MAX_CLIENTS or of_host >= MAX_PER_HOST:
            return refusal(503, "too many WebSockets are open")
        socket = web.WebSocketResponse(
            heartbeat=_HEARTBEAT_S, max_msg_size=_MAX_MESSAGE, compress=False
        )
        await socket.prepare(request)
        self._open[socket] = host, request[TOKEN]
        pending = PendingMessages()
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
                sending = group.create_task(self._send_all(socket, pending))
                await self._receive(socket, pending)
                # It would wait for messages for ever.
                sending.cancel()
        except* (OSError, TimeoutError, RuntimeError):
            # The client has gone, or does not read: close() would wait for it.
            if request.transport is not None:
                with suppress(AttributeError):  # asyncio: a TLS transport that was closed twice
                    request.transport.abort()
        finally:
            del self._open[socket]
            self._topics.leave(pending)
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

    async def _receive(self, socket: web.WebSocketResponse, pending: PendingMessages) -> None:
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
            errors = self._topics.replace(pending, wanted.subscribe)
            answer: dict[str, Any] = {
                "type": "subscribed",
                "topics": [each for each in wanted.subscribe if each not in errors],
                "errors": errors,
            }
            await self._send(socket, msgspec.json.encode(answer))

    async def _send_all(self, socket: web.WebSocketResponse, pending: PendingMessages) -> None:
        while True:
            for message in await pending.take():
                await self._send(socket, message)

    async def _send(self, socket: web.WebSocketResponse, message: bytes) -> None:
        async with asyncio.timeout(SLOW_S):
            await socket.send_frame(message, WSMsgType.TEXT)


def _decode(message: WSMessage) -> TopicRequest | None:
    if message.type is not WSMsgType.TEXT:
        return None
    try:
        return msgspec.json.decode(message.data, type=TopicRequest)
    except msgspec.MsgspecError:
        return None
