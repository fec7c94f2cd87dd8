"""Notifications of a master: its bus is looked at while somebody is to be told of it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from time import monotonic_ns, time_ns
from typing import TypeAlias

from eap.aoe.ads_notifications import NotificationTable
from eap.aoe.way import Way
from eap.codec.adsnotification import to_filetime
from eap.errors import EapError
from eap.ids import NetId

LOOK_S = 0.05
"""How often the bus is looked at, at most: states change slowly."""

Look: TypeAlias = Callable[[], Awaitable[None]]
"""Has the master know how its bus is; raises EapError."""
Send: TypeAlias = Callable[[Way, bytes], object]
"""Sends a packet to a client, and does not wait for that."""

logger = logging.getLogger(__name__)


class MasterWatch:
    """Tells the clients of one master.

    Args:
        table: Whom it tells of what.
        look: Looks at the bus.
        send: Reaches the clients.
        net_id: Of the bus port.
        port: AMS port of the master.
    """

    def __init__(
        self, table: NotificationTable, look: Look, send: Send, net_id: NetId, port: int
    ) -> None:
        self._table = table
        self._look = look
        self._send = send
        self._net_id = net_id
        self._port = port
        self._task: asyncio.Task[None] | None = None
        table.on_add = self._start

    def _start(self) -> None:
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())

    async def _run(self) -> None:
        while (due_ns := self._table.next_timeout()) is not None:
            await asyncio.sleep(max(LOOK_S, (due_ns - monotonic_ns()) / 1e9))
            try:
                await self._look()
            except EapError as exc:
                logger.debug("notifications of %s wait: %s", self._net_id, exc)
                continue
            for notice in self._table.handle_cycle(monotonic_ns(), to_filetime(time_ns())):
                self._send(notice.client.way, notice.encode(self._net_id, self._port))
