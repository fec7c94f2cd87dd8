"""The control socket: many clients, each with its requests in order and its subscriptions beside.

Rule: a client can only delay itself.  Nothing is queued for it: a subscription takes its next look
at the values when the last line has left, and who takes nothing for SLOW_READER_S is disconnected.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from typing import Any

from eap.appliance.control import (
    MAX_CLIENTS,
    MAX_LINE,
    MAX_SUBSCRIPTIONS,
    SLOW_READER_S,
    ErrorCode,
    UnsubscribeParameters,
    decode_request,
    encode_error,
    encode_event,
    encode_result,
    request_id,
)
from eap.appliance.methods import Methods, Watch, parameters
from eap.errors import ControlError, ImageError

logger = logging.getLogger(__name__)


class ControlServer:
    """Serve *methods* on a listening Unix socket."""

    def __init__(self, methods: Methods, *, slow_reader_s: float = SLOW_READER_S) -> None:
        self._methods = methods
        self._slow_reader_s = slow_reader_s
        self._clients = 0

    async def serve(self, listener: socket.socket) -> None:
        """Accept clients until cancelled; *listener* stays open."""
        listener.setblocking(False)
        loop = asyncio.get_running_loop()
        async with asyncio.TaskGroup() as group:
            while True:
                try:
                    connection, _ = await loop.sock_accept(listener)
                except OSError as exc:
                    # Out of descriptors: those who wait keep waiting, the plant goes on.
                    logger.warning("control socket: %s", exc.strerror)
                    await asyncio.sleep(1)
                    continue
                group.create_task(self.serve_client(connection))

    async def serve_client(self, connection: socket.socket) -> None:
        """Answer one client until it leaves."""
        reader, writer = await asyncio.open_unix_connection(sock=connection, limit=MAX_LINE)
        self._clients += 1
        try:
            client = _Client(self._methods, writer, self._slow_reader_s)
            if self._clients > MAX_CLIENTS:
                reason = f"{MAX_CLIENTS} clients are connected, which is all there is room for"
                await client.send(encode_error(None, ControlError(reason, code=ErrorCode.BUSY)))
            else:
                await client.run(reader)
        except* (OSError, TimeoutError) as group:
            logger.debug("control client left: %s", group.exceptions[0])
        finally:
            self._clients -= 1
            writer.transport.abort()


class _Client:
    def __init__(
        self, methods: Methods, writer: asyncio.StreamWriter, slow_reader_s: float
    ) -> None:
        self._methods = methods
        self._writer = writer
        self._slow_reader_s = slow_reader_s
        self._subscriptions: dict[int, asyncio.Task[None]] = {}
        self._last_subscription = 0

    async def send(self, line: bytes) -> None:
        """Put one line out, and wait until most of it has gone."""
        self._writer.write(line)
        async with asyncio.timeout(self._slow_reader_s):
            await self._writer.drain()

    async def run(self, reader: asyncio.StreamReader) -> None:
        async with asyncio.TaskGroup() as group:
            while line := await self._next_line(reader):
                await self._answer(line, group)
            for task in self._subscriptions.values():
                task.cancel()

    async def _next_line(self, reader: asyncio.StreamReader) -> bytes:
        """Return the next line, empty at the end or when the client sends no lines."""
        try:
            return await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError:
            return b""
        except asyncio.LimitOverrunError:
            reason = f"a line has at most {MAX_LINE} octets"
            error = ControlError(reason, code=ErrorCode.BAD_REQUEST)
            await self.send(encode_error(None, error))
            return b""

    async def _answer(self, line: bytes, group: asyncio.TaskGroup) -> None:
        number = None
        try:
            request = decode_request(line)
            number = request.id
            if request.method == "subscribe":
                await self._subscribe(number, request.params, group)
                return
            if request.method == "unsubscribe":
                result = self._unsubscribe(request.params)
            else:
                result = self._methods.call(request.method, request.params)
        except ControlError as exc:
            await self.send(encode_error(request_id(line) if number is None else number, exc))
        except ImageError as exc:
            error = ControlError(str(exc), code=ErrorCode.UNAVAILABLE)
            await self.send(encode_error(number, error))
        except Exception:
            logger.exception("control method failed")
            error = ControlError("this request failed inside", code=ErrorCode.INTERNAL)
            await self.send(encode_error(number, error))
        else:
            await self.send(encode_result(number, result))

    async def _subscribe(
        self, number: int | None, params: dict[str, Any], group: asyncio.TaskGroup
    ) -> None:
        if len(self._subscriptions) >= MAX_SUBSCRIPTIONS:
            reason = f"this connection has {MAX_SUBSCRIPTIONS} subscriptions, which is the limit"
            raise ControlError(reason, code=ErrorCode.BUSY)
        watch = self._methods.watch(params)
        self._last_subscription += 1
        subscription = self._last_subscription
        await self.send(encode_result(number, {"subscription": subscription}))
        self._subscriptions[subscription] = group.create_task(self._events(subscription, watch))

    def _unsubscribe(self, params: dict[str, Any]) -> dict[str, Any]:
        subscription = parameters(params, UnsubscribeParameters).subscription
        task = self._subscriptions.pop(subscription, None)
        if task is None:
            reason = f"no subscription {subscription} on this connection"
            raise ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
        task.cancel()
        return {"unsubscribed": subscription}

    async def _events(self, subscription: int, watch: Watch) -> None:
        while True:
            try:
                event = watch.next_event()
            except ImageError as exc:
                event = {"error": {"code": ErrorCode.UNAVAILABLE, "message": str(exc)}}
            if event is not None:
                await self.send(encode_event(subscription, event))
            await asyncio.sleep(watch.period_ms / 1000)
