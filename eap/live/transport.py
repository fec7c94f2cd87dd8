"""Connections that carry requests of the control protocol, with asyncio.

:class:`UnixConnection` is the control socket of an appliance of this host.
"""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import AsyncGenerator
from contextlib import suppress
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeVar

import msgspec
from msgspec.structs import replace

from eap.control.protocol import (
    MAX_LINE,
    SUBSCRIBE,
    ControlReply,
    ErrorCode,
    ValuesEvent,
    decode_reply,
    encode_request,
)
from eap.errors import ControlError
from eap.ops.client import checked
from eap.services.tasks import TaskSet


class ValuesSubscription(msgspec.Struct, frozen=True, kw_only=True):
    """Variables of a station to watch.

    Attributes:
        station: The station.
        names: Its variables; all if empty.
        period_ms: Period of events.
        only_changes: Events have only the values that changed; the first has all.
    """

    station: str
    names: tuple[str, ...] = ()
    period_ms: int = 500
    only_changes: bool = False

    def params(self) -> dict[str, Any]:
        """Return the parameters of ``subscribe``."""
        return {
            "station": self.station,
            "names": self.names,
            "period_ms": self.period_ms,
            "on": "change" if self.only_changes else "period",
        }


class PlantConnection(Protocol):
    """Open connection to one appliance; it is of no use after an error UNAVAILABLE."""

    async def request(self, method: str, params: dict[str, Any]) -> Any:
        """Return the result of a method; raise ControlError or BusError if it is refused."""

    def watch(self, wanted: ValuesSubscription) -> AsyncGenerator[ValuesEvent | ControlError]:
        """Yield the values of variables until the connection ends.

        A value that cannot be read now is an error that is yielded.  A slow consumer gets fewer
        events, and of each variable the latest value.
        """

    async def close(self) -> None:
        """Close it; what waits gets ControlError."""


def gone(why: str) -> ControlError:
    """Return the error of a connection that has ended."""
    return ControlError(why, code=ErrorCode.UNAVAILABLE)


AnswerT = TypeVar("AnswerT")


class NumberedConnection(ABC, Generic[AnswerT]):
    """Base of connections by a stream whose requests and answers have numbers.

    Args:
        reader: Of the stream.
        writer: Of the same.
        name: Of the task that receives.
    """

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, name: str
    ) -> None:
        self._reader = reader
        self._writer = writer
        self._waiting: dict[int, asyncio.Future[AnswerT]] = {}
        self._error: ControlError | None = None
        self._tasks = TaskSet(name)
        self._tasks.start(self._receive())

    async def close(self) -> None:
        """Close it; what waits gets ControlError."""
        await self._tasks.close()
        self._end("the connection was closed")
        self._writer.close()
        with suppress(OSError):
            await self._writer.wait_closed()

    @abstractmethod
    async def _receive(self) -> None:
        """Take answers until the stream ends."""

    def _end(self, why: str) -> None:
        """Raise an error in all requests that wait, and in later ones."""
        if self._error is not None:
            return
        self._error = gone(why)
        for answer in self._waiting.values():
            if not answer.done():
                answer.set_exception(self._error)
                answer.exception()  # so that asyncio does not miss a requester just cancelled


class UnixConnection(NumberedConnection[ControlReply]):
    """The control socket of one appliance (PlantConnection).

    Requests are answered in their order; several may be under way.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        super().__init__(reader, writer, "control connection")
        self._last_id = 0
        self._watches: dict[int, _LatestValues] = {}

    @classmethod
    async def open(cls, path: Path) -> Self:
        """Connect to the socket at *path*; raise ControlError if nothing listens there."""
        try:
            streams = await asyncio.open_unix_connection(str(path), limit=MAX_LINE)
        except OSError as exc:
            raise gone(f"{path} cannot be reached: {exc.strerror}") from None
        return cls(*streams)

    async def request(self, method: str, params: dict[str, Any]) -> Any:
        """Return the result of a method; raise ControlError or BusError if it is refused."""
        return (await self._request(method, params)).result

    async def watch(self, wanted: ValuesSubscription) -> AsyncGenerator[ValuesEvent | ControlError]:
        """Yield the values of variables until the connection ends."""
        reply = await self._request(SUBSCRIBE.name, wanted.params())
        number = SUBSCRIBE.decode(reply.result).subscription
        # Events may have come between the answer and this line, see _dispatch.
        latest = self._watches.setdefault(number, _LatestValues())
        try:
            while True:
                yield await latest.next()
        finally:
            if self._error is None:
                with suppress(ControlError):
                    await self._request("unsubscribe", {"subscription": number})
            del self._watches[number]  # not earlier: events come until the answer

    async def _request(self, method: str, params: dict[str, Any]) -> ControlReply:
        if self._error is not None:
            raise self._error
        self._last_id += 1
        number = self._last_id
        answer: asyncio.Future[ControlReply] = asyncio.get_running_loop().create_future()
        # Before the request is written: its answer may come while drain() waits.
        self._waiting[number] = answer
        try:
            self._writer.write(encode_request(number, method, params))
            await self._writer.drain()
            reply = await answer
        except OSError as exc:
            raise gone(f"the appliance does not answer: {exc}") from None
        finally:
            self._waiting.pop(number, None)
        return checked(reply)

    async def _receive(self) -> None:
        why = "the appliance closed the connection"
        try:
            while line := await self._reader.readline():
                self._dispatch(decode_reply(line))
        except (OSError, ValueError, ControlError) as exc:
            why = f"the connection to the appliance broke: {exc}"
        self._end(why)

    def _dispatch(self, reply: ControlReply) -> None:
        if reply.subscription is not None:
            if reply.event is not None:
                watch = self._watches.setdefault(reply.subscription, _LatestValues())
                watch.put(reply.event)
        elif reply.id is None:  # an error that ends the connection
            # No request is to blame for a line without a number: the server refuses the connection.
            self._end(reply.error.message if reply.error else "the appliance refused a line")
        elif (answer := self._waiting.get(reply.id)) is not None and not answer.done():
            answer.set_result(reply)

    def _end(self, why: str) -> None:
        super()._end(why)
        for watch in self._watches.values():
            watch.end(self._error or gone(why))


class _LatestValues:
    """Events of a subscription that were not consumed yet, as one."""

    def __init__(self) -> None:
        self._event: ValuesEvent | ControlError | None = None
        self._end: ControlError | None = None
        self._has_news = asyncio.Event()

    def put(self, event: dict[str, Any]) -> None:
        if (failure := event.get("error")) is not None:
            self._event = ControlError(failure["message"], code=failure["code"])
        else:
            self._event = _merged(self._event, msgspec.convert(event, ValuesEvent))
        self._has_news.set()

    def end(self, error: ControlError) -> None:
        self._end = error
        self._has_news.set()

    async def next(self) -> ValuesEvent | ControlError:
        await self._has_news.wait()
        event, self._event = self._event, None
        if event is None:
            assert self._end is not None  # noqa: S101
            raise self._end
        # The end stays known: every later call raises it, too.
        if self._end is None:
            self._has_news.clear()
        return event


def _merged(before: ValuesEvent | ControlError | None, event: ValuesEvent) -> ValuesEvent:
    if not isinstance(before, ValuesEvent):
        return event
    return replace(
        event,
        # An event may have only some of the values: those of the one before are still the latest.
        values=before.values | event.values,
        quality=before.quality | event.quality,
        stale=(*(name for name in before.stale if name not in event.values), *event.stale),
        skipped=before.skipped + event.skipped,
    )
