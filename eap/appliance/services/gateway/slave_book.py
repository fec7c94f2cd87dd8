"""What is known of the slaves of a bus: their mailboxes, protocols and states.

A gateway needs it for every request, and the engine need not be asked for every one: what it said
is good for a moment.  Whoever is to be refused for it is looked for once more, because clients that
have just seen a slave come to PREOP ask it at once.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable
from contextlib import suppress

from devicebus.errors import BusError
from eap.appliance.bus_request import BusReport, SlaveReport
from eap.errors import EngineGoneError
from eap.gateway.refusal import Reason

FRESH_S = 0.5
REFUSAL_FRESH_S = 0.02
"""For how long it is good that a slave cannot be asked."""


class SlaveBook:
    """The slaves of one bus.

    Args:
        describe: Asks the engine.
    """

    def __init__(self, describe: Callable[[], Awaitable[BusReport]]) -> None:
        self._describe = describe
        self._slaves: dict[int, SlaveReport] = {}
        self._fault: Reason | None = None
        self._asked_s = -math.inf
        self._turn = asyncio.Lock()

    async def find(self, station: int) -> SlaveReport | Reason:
        """Return a slave, or why it cannot be asked anything."""
        await self._look()
        slave = self._slaves.get(station)
        if slave is None or not slave.to_slave:
            await self._look(REFUSAL_FRESH_S)
        if self._fault is not None:
            return self._fault
        return self._slaves.get(station, Reason.NO_SLAVE)

    async def stations(self) -> tuple[int, ...]:
        """Return the station addresses in the order of the bus, none while it is down."""
        await self._look()
        return tuple(self._slaves)

    async def _look(self, fresh_s: float = FRESH_S) -> None:
        loop = asyncio.get_running_loop()
        if loop.time() < self._asked_s + fresh_s:
            return
        async with self._turn:  # who comes meanwhile waits for the same answer
            if loop.time() < self._asked_s + fresh_s:
                return
            slaves: dict[int, SlaveReport] = {}
            fault: Reason | None = Reason.BUS_DOWN
            with suppress(BusError, EngineGoneError):
                report = await self._describe()
                if report.is_up:
                    slaves = {slave.station: slave for slave in report.slaves}
                    fault = None
            self._slaves, self._fault = slaves, fault
            self._asked_s = loop.time()
