"""Cached description of one bus, kept current by the events of the engine.

The engine sends a change before the answer to any request that it has done after it, so that a
client that has requested a state and got its answer finds that state here.  Other changes
come within the engine's pause between two looks at its sockets, 20 ms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from eap.errors import EngineGoneError
from eap.runtime.bus_request import BusChange, Ping, Republish, SlaveDescription
from eap.services.engine_link import EngineLink

ANSWER_S = 1.0


class BusDescription(NamedTuple):
    """A bus without counters and times, which only an explicit request brings."""

    is_up: bool = False
    """Whether it has been brought up, wherever its slaves are now."""
    fault: str = "nothing is known about it yet"
    slaves: Mapping[int, SlaveDescription] = MappingProxyType({})
    """By station address, in the order of the bus; while it is not up those that are expected."""


class BusView:
    """The description of one bus.

    Args:
        link: To the engine.
        number: Of the bus in messages.

    Attributes:
        latest: As it was received last; empty from a restart of the engine to its first message.
        on_change: Called after each change.
    """

    def __init__(self, link: EngineLink, number: int) -> None:
        self.latest = BusDescription()
        self.on_change: list[Callable[[], None]] = []
        self._link = link
        self._number = number
        self._is_complete = False
        link.on_change.append(self._take)
        link.on_restart.append(self._forget)

    @property
    def is_current(self) -> bool:
        """Whether :meth:`current` returns without waiting."""
        return self._is_complete and self._link.is_alive

    async def current(self) -> BusDescription:
        """Return the description, as a rule without waiting; raise EngineGoneError.

        A request goes to the engine only if it has sent nothing for a second, or nothing about
        this bus: a dead engine says nothing, and must not leave an old state here for long.
        """
        if self.is_current:
            return self.latest
        return await self.confirm()

    async def confirm(self) -> BusDescription:
        """Return the description as the engine has it now; raise EngineGoneError.

        For a request that would be refused because of it: its client may know more, from the
        process image or from the slave itself, than has come here.
        """
        if self._is_complete:
            await self._link.request(lambda number: Ping(id=number), ANSWER_S)
        else:
            await self._link.request(
                lambda number: Republish(id=number, bus=self._number), ANSWER_S
            )
        if not self._is_complete:
            raise EngineGoneError("the engine says nothing about the bus")
        return self.latest

    def _take(self, change: BusChange) -> None:
        if change.bus != self._number:
            return
        known = {**self.latest.slaves, **{slave.station: slave for slave in change.slaves}}
        # Without the messages before, which another process has read, some slaves are not known.
        self._is_complete = all(station in known for station in change.stations)
        slaves = {station: known[station] for station in change.stations if self._is_complete}
        self.latest = BusDescription(change.is_up, change.fault, slaves)
        for notify in self.on_change:
            notify()

    def _forget(self) -> None:
        self.latest = BusDescription()
        self._is_complete = False
        for notify in self.on_change:
            notify()
