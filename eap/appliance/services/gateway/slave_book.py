"""What is known of the slaves of a bus: their mailboxes, protocols and states.

A gateway needs it for every request, and the engine need not be asked for every one: what it said
is good for a moment.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress

from devicebus.errors import BusError
from eap.appliance.bus_request import BusReport, SlaveReport
from eap.errors import EngineGoneError
from eap.gateway.refusal import Reason

FRESH_S = 0.5


class SlaveBook:
    """The slaves of one bus.

    Args:
        describe: Asks the engine.
    """

    def __init__(self, describe: Callable[[], Awaitable[BusReport]]) -> None:
        self._describe = describe
        self._slaves: dict[int, SlaveReport] = {}
        self._fault: Reason | None = None
        self._until_s = 0.0
        self._turn = asyncio.Lock()

    async def find(self, station: int) -> SlaveReport | Reason:
        """Return a slave, or why it cannot be asked anything."""
        await self._look()
        if self._fault is not None:
            return self._fault
        return self._slaves.get(station, Reason.NO_SLAVE)

    async def stations(self) -> tuple[int, ...]:
        """Return the station addresses in the order of the bus, none while it is down."""
        await self._look()
        return tuple(self._slaves)

    async def _look(self) -> None:
        loop = asyncio.get_running_loop()
        if loop.time() < self._until_s:
            return
        async with self._turn:  # who comes meanwhile waits for the same answer
            if loop.time() < self._until_s:
                return
            self._slaves, self._fault = {}, Reason.BUS_DOWN
            with suppress(BusError, EngineGoneError):
                report = await self._describe()
                if report.is_up:
                    self._slaves = {slave.station: slave for slave in report.slaves}
                    self._fault = None
            self._until_s = loop.time() + FRESH_S
