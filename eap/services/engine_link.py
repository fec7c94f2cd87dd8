"""Link of services to the engine: requests for its stations and buses, and their replies.

Replies are matched by number.  An engine that dies leaves the socket pair open and silent, so each
reply has a time-out, and a request that waits longer pings the engine.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from contextlib import suppress
from time import monotonic_ns

import msgspec

from eap.errors import EngineGoneError
from eap.runtime.bus_errors import to_error
from eap.runtime.engine_messages import (
    BusChange,
    Cancel,
    EngineMessage,
    EngineReply,
    EngineRequest,
    EngineStarted,
    Ping,
    UnsolicitedMessage,
)

SILENCE_LIMIT_S = 1.0
"""Time without any message after a ping until the engine counts as gone."""

_MAX_MESSAGE = 1 << 20
_BATCH = 64

logger = logging.getLogger(__name__)


class EngineLink:
    """Sends requests to the engine; constructed inside the loop that serves it.

    Args:
        sock: Local end of the pair; closed by :meth:`close`.
        silence_limit_s: As SILENCE_LIMIT_S.

    Attributes:
        on_restart: Called when another engine has connected to the pair.
        on_unsolicited: Called with each unsolicited message of a slave.
        on_change: Called with each change of a bus.
        received_s: Time of the loop at which the latest message of the engine came.
    """

    def __init__(self, sock: socket.socket, *, silence_limit_s: float = SILENCE_LIMIT_S) -> None:
        self._socket = sock
        self._socket.setblocking(False)
        self._silence_limit_s = silence_limit_s
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._receive)
        self._encoder = msgspec.msgpack.Encoder()
        self._decoder = msgspec.msgpack.Decoder(EngineMessage)
        self._waiting: dict[int, asyncio.Future[EngineReply]] = {}
        # Start above the numbers of the previous process: late answers to it match no request.
        self._last_id = monotonic_ns()
        self.received_s = 0.0
        self.on_restart: list[Callable[[], None]] = []
        self.on_unsolicited: list[Callable[[UnsolicitedMessage], None]] = []
        self.on_change: list[Callable[[BusChange], None]] = []

    @property
    def is_alive(self) -> bool:
        """True if the latest message of the engine is younger than the silence limit."""
        return self._loop.time() < self.received_s + self._silence_limit_s

    async def request(self, make: Callable[[int], EngineRequest], timeout_s: float) -> EngineReply:
        """Send the request that *make* returns for its number, and wait for the reply.

        When this is cancelled, the request is cancelled at the engine.

        Raises:
            EngineGoneError: no engine answers, or it was restarted meanwhile.
            BusError, EngineRefusedError: the request failed.
        """
        request = make(self._next_id())
        future: asyncio.Future[EngineReply] = self._loop.create_future()
        self._waiting[request.id] = future
        try:
            self.post(request)
            answer = await self._wait(future, self._loop.time() + timeout_s)
        except (asyncio.CancelledError, EngineGoneError):
            # An engine that does not read has no use for it; the first error is reported.
            with suppress(EngineGoneError):
                self.post(Cancel(id=request.id))
            raise
        finally:
            del self._waiting[request.id]
        if answer.error is not None:
            raise to_error(answer.error)
        return answer

    def send(self, make: Callable[[int], EngineRequest]) -> None:
        """Send a request whose reply is ignored; raises as :meth:`post` does."""
        self.post(make(self._next_id()))

    def post(self, request: EngineRequest) -> None:
        """Send one message.

        Raises:
            EngineGoneError: the socket is full, because the engine reads no messages.
        """
        try:
            self._socket.send(self._encoder.encode(request))
        except OSError as exc:
            raise EngineGoneError(f"the engine accepts no requests: {exc.strerror}") from None

    def close(self) -> None:
        """Close the local end; the loop may have ended."""
        if not self._loop.is_closed():
            self._loop.remove_reader(self._socket)
        self._socket.close()

    async def _wait(self, future: asyncio.Future[EngineReply], end_s: float) -> EngineReply:
        pinged_s: float | None = None
        while True:
            wait_s = min(self._silence_limit_s, end_s - self._loop.time())
            await asyncio.wait({future}, timeout=max(0.0, wait_s))
            now_s = self._loop.time()
            if future.done():
                return future.result()
            # Any message proves that the engine lives: a slow request is no reason to give up.
            if now_s >= end_s or (pinged_s is not None and self.received_s < pinged_s):
                raise EngineGoneError("the engine does not answer")
            pinged_s = now_s
            self.send(lambda number: Ping(id=number))

    def _next_id(self) -> int:
        self._last_id += 1
        return self._last_id

    def _receive(self) -> None:
        # A batch, because a busy bus must not keep the loop from all other tasks.
        for _ in range(_BATCH):
            try:
                message = self._socket.recv(_MAX_MESSAGE)
            except OSError:
                return
            if not message:  # the supervisor has closed both ends: this process ends too
                self._loop.remove_reader(self._socket)
                return
            self._handle(message)

    def _handle(self, data: bytes) -> None:
        try:
            message = self._decoder.decode(data)
        except ValueError as exc:
            logger.warning("message of the engine dropped: %s", exc)
            return
        self.received_s = self._loop.time()
        if isinstance(message, EngineStarted):
            self._restarted()
        elif isinstance(message, UnsolicitedMessage):
            for call in self.on_unsolicited:
                call(message)
        elif isinstance(message, BusChange):
            for notify in self.on_change:
                notify(message)
        elif (future := self._waiting.get(message.id)) is not None and not future.done():
            future.set_result(message)

    def _restarted(self) -> None:
        for future in self._waiting.values():
            if not future.done():
                # The new engine knows nothing of requests to the old one.
                future.set_exception(EngineGoneError("the engine was started again"))
        for call in self.on_restart:
            call()
