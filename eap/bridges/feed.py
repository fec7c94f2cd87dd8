"""Variables of an appliance that patterns select, with their present values.

Nothing here raises for an appliance that does not answer: its values become stale.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping
from contextlib import aclosing, suppress
from time import time_ns

from eap.bridges.values import BridgeVariable, Quality, Sample, select
from eap.control.protocol import (
    HELLO,
    MAX_SUBSCRIPTIONS,
    VARIABLES,
    ErrorCode,
    ValuesEvent,
)
from eap.errors import ControlError
from eap.live.client import LiveClient
from eap.live.transport import ValuesSubscription
from eap.pd.quality import QUALITY_NS

DIRECTORY_S = 10.0
"""Period in which variables that appear or go are noticed."""
RETRY_S = 0.5
OLD_NS = 2_000_000_000
"""Beyond the period, values of a station that runs no cycle are stale."""

logger = logging.getLogger(__name__)


class BridgeFeed:
    """Values of the variables of an appliance that *patterns* select.

    Args:
        connect: Returns a client of the appliance that is not connected yet.
        patterns: ``STATION/NAME``, with ``*`` for any text without slashes.
        period_ms: Period of values, at least 10.
        on_variables: Called when *variables* has changed.
        on_values: Called with the values that changed, or whose quality did, by ``STATION/NAME``.
        now: Unix time in nanoseconds.

    Attributes:
        variables: The variables, by ``STATION/NAME``.
        samples: The latest value of each; none before the first.
    """

    def __init__(
        self,
        connect: Callable[[], LiveClient],
        patterns: Iterable[str],
        period_ms: int,
        *,
        on_variables: Callable[[], None] = lambda: None,
        on_values: Callable[[Mapping[str, Sample]], None] = lambda _: None,
        now: Callable[[], int] = time_ns,
    ) -> None:
        self.variables: dict[str, BridgeVariable] = {}
        self.samples: dict[str, Sample] = {}
        self._connect = connect
        self._patterns = tuple(patterns)
        self._period_ms = period_ms
        self._on_variables = on_variables
        self._on_values = on_values
        self._now = now
        self._clients: list[LiveClient] = []
        self._watches: dict[str, asyncio.Task[None]] = {}
        self._by_station: dict[str, tuple[BridgeVariable, ...]] = {}
        self._has_gone = asyncio.Event()
        self._to_report: set[str] = set()

    def report_again(self, written: str) -> None:
        """Report the next value of a variable even if it is the one before.

        A bridge that shows its clients what they wrote calls this: where the plant sets the value
        back within a period, no change would be seen.

        Args:
            written: ``STATION/NAME``, or a member or element of it.
        """
        for name in self.variables:
            if written == name or (written.startswith(name) and written[len(name)] in ".["):
                self._to_report.add(name)

    async def run(self) -> None:
        """Follow the appliance until cancelled."""
        try:
            async with asyncio.TaskGroup() as group:
                while True:
                    pause_s = DIRECTORY_S
                    try:
                        await self._follow_directory(group)
                    except ControlError as exc:
                        logger.debug("variables: %s", exc)
                        pause_s = RETRY_S
                    self._has_gone.clear()
                    with suppress(TimeoutError):
                        async with asyncio.timeout(pause_s):
                            await self._has_gone.wait()
        finally:
            for client in self._clients:
                await client.close()

    def _client(self, number: int) -> LiveClient:
        """Return the client for the station at a position: a connection has few subscriptions."""
        while len(self._clients) <= number // MAX_SUBSCRIPTIONS:
            self._clients.append(self._connect())
        return self._clients[number // MAX_SUBSCRIPTIONS]

    async def _follow_directory(self, group: asyncio.TaskGroup) -> None:
        """Read which variables there are, and subscribe to those that are new."""
        stations = (await self._client(0).call(HELLO)).stations
        found = {}
        for station in stations:
            rows = await self._client(0).call(VARIABLES, station=station)
            found[station] = tuple(select(rows, station, self._patterns))
        changed = [name for name in found if found[name] != self._by_station.get(name)]
        if changed or found.keys() != self._by_station.keys():
            self._by_station = found
            self.variables = {each.name: each for own in found.values() for each in own}
            self.samples = {n: each for n, each in self.samples.items() if n in self.variables}
            self._on_variables()
        for number, station in enumerate(stations):
            running = self._watches.get(station)
            # A subscription has its names from its begin on: other variables need another one.
            if running is not None and (station in changed or running.done()):
                running.cancel()
                running = None
            if running is None and found[station]:
                watch = self._watch(self._client(number), station, found[station])
                self._watches[station] = group.create_task(watch)

    async def _watch(
        self, client: LiveClient, station: str, variables: tuple[BridgeVariable, ...]
    ) -> None:
        names = tuple(each.variable for each in variables)
        wanted = ValuesSubscription(station=station, names=names, period_ms=self._period_ms)
        async with aclosing(client.watch(wanted)) as events:
            async for event in events:
                if isinstance(event, ValuesEvent):
                    self._take(event)
                    continue
                logger.debug("values of %s: %s", station, event)
                self._age(variables)
                if event.code == ErrorCode.UNKNOWN_NAME:  # configured anew
                    self._has_gone.set()
                    return

    def _take(self, event: ValuesEvent) -> None:
        old_ns = OLD_NS + self._period_ms * 1_000_000
        # 0 comes from an appliance of an older release, which sends no time.
        is_old = 0 < event.time_ns < self._now() - old_ns
        changed = {}
        for variable, value in event.values.items():
            name = f"{event.station}/{variable}"
            age = event.quality.get(variable, 0)
            quality = Quality.STALE if is_old or variable in event.stale else Quality.GOOD
            if age is None:
                quality, age = Quality.BAD, 0
            before = self.samples.get(name)
            sample = Sample(value, quality, event.time_ns - age * QUALITY_NS)
            self.samples[name] = sample
            # Without the time, which is another one in every cycle.
            is_as_before = before is not None and before[:2] == sample[:2]
            if not is_as_before or name in self._to_report:
                changed[name] = sample
                self._to_report.discard(name)
        if changed:
            self._on_values(changed)

    def _age(self, variables: Iterable[BridgeVariable]) -> None:
        """Mark the values of a station that does not answer as stale."""
        changed = {}
        for each in variables:
            sample = self.samples.get(each.name)
            if sample is not None and sample.quality is Quality.GOOD:
                changed[each.name] = sample._replace(quality=Quality.STALE)
        if changed:
            self.samples |= changed
            self._on_values(changed)
