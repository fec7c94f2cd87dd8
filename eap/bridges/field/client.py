"""Client of one controller: it reads values in rounds, writes targets, and connects again."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import Callable, Mapping
from time import time
from typing import Any, NamedTuple

from eap.bridges.bridge import Bridge
from eap.bridges.field.plan import PointKey, ReadPlan, ReadSpan, batches, bytes_in
from eap.bridges.field.protocol import FieldConversation, FieldLink, FieldLinkError, ResultT
from eap.codec.datatypes import with_nan
from eap.codec.fieldaddresses import FieldPoint
from eap.config.bridge_sections import ControllerSection
from eap.control.field import FILL
from eap.errors import CodecError, EapError
from eap.net.reconnecting import Backoff
from eap.runtime.bridges import PeerStatus

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.2, 5.0
_LASTING_S = 5.0
_CHUNK = 65_536

logger = logging.getLogger(__name__)


class ControllerPoints(NamedTuple):
    """Sources and targets in one controller."""

    sources: Mapping[PointKey, FieldPoint]
    targets: Mapping[PointKey, FieldPoint]
    wrong: Mapping[PointKey, str] = {}
    """Those whose address fits no more, with the reason."""


class FieldClient:
    """Client of one controller.

    Args:
        bridge: The plant.
        controller: Its section of the plant file.
        port: Its TCP port.
        points: Its sources and targets.
        status: Its status, which this object keeps.
        make_link: Makes the conversations of a new connection.
    """

    def __init__(
        self,
        bridge: Bridge,
        controller: ControllerSection,
        port: int,
        points: ControllerPoints,
        status: PeerStatus,
        make_link: Callable[[], FieldLink],
    ) -> None:
        self._bridge = bridge
        self._host, self._port = controller.host, port
        self._period_s = controller.every_ms / 1000
        self._timeout_s = controller.timeout_ms / 1000
        self._points = points
        self._status = status
        self._make_link = make_link
        self._values: dict[PointKey, Any] = {}
        self._pending: dict[PointKey, Any] = {}
        self._failures: dict[PointKey, str] = dict(points.wrong)
        status.values = len(points.sources) + len(points.targets) + len(points.wrong)
        self._show_failures()

    def set(self, key: PointKey, plain: Any) -> None:
        """Have a changed value, in plain form, written in the next round."""
        if key in self._points.targets and (key not in self._values or self._values[key] != plain):
            self._values[key] = self._pending[key] = plain

    async def run(self) -> None:
        """Keep the connection until cancelled."""
        backoff = Backoff(_FIRST_PAUSE_S, _LONGEST_PAUSE_S)
        clock = asyncio.get_running_loop().time
        while True:
            began_s = clock()
            reason = await self._connect()
            # A controller that accepts connections and ends them at once must not be tried in short
            # pauses.
            if clock() - began_s > _LASTING_S:
                backoff.reset()
            # One line for each reason: attempts go on for as long as the controller is off.
            if self._status.is_up or self._status.reason != reason:
                logger.warning("%s: no connection: %s", self._status.name, reason)
            self._change(reason, is_up=False)
            await asyncio.sleep(backoff.next_s())

    async def _connect(self) -> str:
        """Connect and talk; return why the connection ended."""
        writer: asyncio.StreamWriter | None = None
        try:
            async with asyncio.timeout(self._timeout_s):
                reader, writer = await asyncio.open_connection(self._host, self._port)
            connection = _Connection(self._make_link(), reader, writer, self._timeout_s)
            await connection.talk(connection.link.open())
            await self._serve(connection)
        except TimeoutError:
            return f"no answer within {self._timeout_s:g} s"
        except (CodecError, FieldLinkError) as exc:
            return str(exc)
        except socket.gaierror as exc:
            return f"unknown host: {exc.strerror}"
        except OSError as exc:
            return os.strerror(exc.errno) if exc.errno else str(exc)
        finally:
            if writer is not None:
                # Not close(): it would wait for a controller that takes nothing.
                writer.transport.abort()
        return "ended"

    async def _serve(self, connection: _Connection) -> None:
        status = self._status
        status.connects += 1
        logger.info("%s: connected", status.name)
        self._change("", is_up=True)
        # The controller may have started anew, so it gets every value again.
        self._pending = dict(self._values)
        plan = ReadPlan(self._points.sources, connection.link.limits)
        clock = asyncio.get_running_loop().time
        due_s = clock()
        while True:
            began_s = clock()
            await self._write(connection)
            await self._read(connection, plan)
            status.reads += 1
            status.span_us = round((clock() - began_s) * 1e6)
            self._show_failures()
            # Rounds that were missed are left out, not made up for.
            due_s = max(due_s + self._period_s, clock())
            await asyncio.sleep(due_s - clock())

    async def _write(self, connection: _Connection) -> None:
        pending, self._pending = self._pending, {}
        try:
            while pending:
                key, plain = next(iter(pending.items()))
                point = self._points.targets[key]
                try:
                    data = point.type.encode(point.type.kind.from_plain(with_nan(plain)))
                except ValueError as exc:
                    self._failures[key] = f"{key.variable}: {exc}"
                else:
                    why = await connection.talk(connection.link.write(point, data))
                    self._note(key, why)
                    if not why:
                        self._status.writes += 1
                        self._bridge.status.sent += 1
                del pending[key]
        finally:
            # What the connection did not take is written after the next one is made.
            self._pending = pending | self._pending

    async def _read(self, connection: _Connection, plan: ReadPlan) -> None:
        found: dict[str, dict[str, Any]] = {}
        for batch in batches(plan.spans, connection.link.fits):
            replies = await connection.talk(connection.link.read(batch))
            for span, reply in zip(batch, replies, strict=True):
                if isinstance(reply, str):
                    # One wrong address fails a request for many values: read alone, only that value
                    # fails.
                    if not plan.split(span):
                        self._note(span.keys[0], reply)
                else:
                    self._decode(plan, span, reply, found)
        for station, values in found.items():
            try:
                await self._bridge.call(FILL, station=station, values=values)
            except EapError as exc:
                # Services starts again, or the station is being changed: the next round.
                logger.debug("%s: %s", self._status.name, exc)
                self._bridge.status.dropped += len(values)

    def _decode(
        self, plan: ReadPlan, span: ReadSpan, data: bytes, found: dict[str, dict[str, Any]]
    ) -> None:
        for key in span.keys:
            point = plan.points[key]
            try:
                value = point.type.decode(bytes_in(span, data, point))
            except ValueError as exc:
                self._note(key, str(exc))
                continue
            self._note(key, "")
            found.setdefault(key.station, {})[key.variable] = point.type.kind.to_plain(value)

    def _note(self, key: PointKey, why: str) -> None:
        if why:
            self._failures[key] = f"{key.station}/{key.variable}: {why}"
        else:
            self._failures.pop(key, None)

    def _show_failures(self) -> None:
        self._status.failed = len(self._failures)
        if self._status.is_up:
            self._status.reason = next(iter(self._failures.values()), "")

    def _change(self, reason: str, *, is_up: bool) -> None:
        status = self._status
        if (status.is_up, status.reason) != (is_up, reason):
            status.is_up, status.reason, status.since = is_up, reason, time()
            self._bridge.save()


class _Connection:
    """One connection, with its conversations one after the other."""

    def __init__(
        self,
        link: FieldLink,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        timeout_s: float,
    ) -> None:
        self.link = link
        self._reader = reader
        self._writer = writer
        self._timeout_s = timeout_s
        self._buffer = b""

    async def talk(self, conversation: FieldConversation[ResultT]) -> ResultT:
        """Run a conversation; raise OSError, TimeoutError or what it raises."""
        reply: bytes | None = None
        while True:
            try:
                frame = next(conversation) if reply is None else conversation.send(reply)
            except StopIteration as end:
                result: ResultT = end.value
                return result
            async with asyncio.timeout(self._timeout_s):
                self._writer.write(frame)
                await self._writer.drain()
                reply = await self._frame()

    async def _frame(self) -> bytes:
        while True:
            length = self.link.frame_length(self._buffer)
            if length is not None and len(self._buffer) >= length:
                frame, self._buffer = self._buffer[:length], self._buffer[length:]
                return frame
            data = await self._reader.read(_CHUNK)
            if not data:
                raise FieldLinkError("the controller closed the connection")
            self._buffer += data
