"""Client of one appliance that reconnects by itself, with asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import aclosing, suppress
from typing import Any

from eap.control.protocol import AnswerT, ErrorCode, Method, ParametersT, ValuesEvent
from eap.errors import ControlError
from eap.live.transport import PlantConnection, ValuesSubscription, gone
from eap.net.reconnecting import Backoff

TIMEOUT_S = 5.0
"""Time for one answer: services may be restarting."""
_FIRST_PAUSE_S = 0.1
_LONGEST_PAUSE_S = 2.0


class LiveClient:
    """Client of one appliance that connects again after its connection ended.

    Args:
        open_connection: Opens a connection; raises ControlError if that fails.

    A request that fails for a broken connection is not repeated; the next one connects again.
    """

    def __init__(self, open_connection: Callable[[], Awaitable[PlantConnection]]) -> None:
        self._open = open_connection
        self._connection: PlantConnection | None = None
        self._opening = asyncio.Lock()

    async def request(self, method: str, /, *, within_s: float = TIMEOUT_S, **params: Any) -> Any:
        """Return the result of *method*.

        Raises:
            ControlError: the appliance refused, or did not answer within *within_s*.
            BusError: a bus or a slave refused or failed.
        """
        connection: PlantConnection | None = None
        try:
            async with asyncio.timeout(within_s):
                connection = await self._connected()
                return await connection.request(method, params)
        except TimeoutError:
            # Answers come in their order: a later request would wait behind this one.
            await self._drop(connection)
            raise gone(f"no answer within {within_s:g} s") from None
        except ControlError as exc:
            if exc.code == ErrorCode.UNAVAILABLE:
                await self._drop(connection)
            raise

    async def call(
        self,
        method: Method[ParametersT, AnswerT],
        /,
        *,
        within_s: float = TIMEOUT_S,
        **params: Any,
    ) -> AnswerT:
        """Return the answer to *method*; raises as :meth:`request`."""
        return method.decode(await self.request(method.name, within_s=within_s, **params))

    async def watch(self, wanted: ValuesSubscription) -> AsyncGenerator[ValuesEvent | ControlError]:
        """Yield values of variables, for as long as the caller iterates.

        While the appliance does not answer, and while a value cannot be read, an error is yielded
        once for each attempt; after a new connection the first event has all values again.
        """
        backoff = Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)
        while True:
            connection: PlantConnection | None = None
            try:
                connection = await self._connected()
                async with aclosing(connection.watch(wanted)) as events:
                    async for event in events:
                        # An error on a connection that was just made must not begin the short
                        # pauses anew.
                        if isinstance(event, ValuesEvent):
                            backoff.reset()
                        yield event
            except ControlError as exc:
                if exc.code == ErrorCode.UNAVAILABLE:
                    await self._drop(connection)
                yield exc
            await asyncio.sleep(backoff.next_s())

    async def close(self) -> None:
        """Close the connection; the next request opens another one."""
        await self._drop(self._connection)

    async def _connected(self) -> PlantConnection:
        # Requests that find no connection at the same time wait for one.
        async with self._opening:
            if self._connection is None:
                self._connection = await self._open()
            return self._connection

    async def _drop(self, connection: PlantConnection | None) -> None:
        """Close *connection*, unless another call has replaced it already."""
        if connection is None or connection is not self._connection:
            return
        self._connection = None
        with suppress(ControlError):
            await connection.close()
