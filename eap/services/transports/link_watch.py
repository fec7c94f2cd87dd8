"""Interfaces whose cable is pulled: whatever would go by them is answered for at once."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence

from eap.net.interface import link_is_up
from eap.services.routing.station_router import StationRouter

LOOK_S = 0.2
"""Between two looks."""


class LinkWatch:
    """Looks after the links of interfaces.

    Args:
        transports: By interface, which stations use it and by which of their doors.
        is_up: Says of an interface whether its link is up.
    """

    def __init__(
        self,
        transports: Mapping[str, Sequence[tuple[StationRouter, str]]],
        is_up: Callable[[str], bool] = link_is_up,
    ) -> None:
        self._transports = transports
        self._is_up = is_up
        self._down: set[str] = set()

    async def serve(self) -> None:
        """Look until cancelled; at once if there is nothing to look after."""
        while self._transports:
            self.look()
            await asyncio.sleep(LOOK_S)

    def look(self) -> None:
        """Tell the stations what has changed."""
        for interface, transports in self._transports.items():
            is_up, was_up = self._is_up(interface), interface not in self._down
            if is_up and not was_up:
                self._down.discard(interface)
                for station, transport in transports:
                    station.hop_up(transport, None)
            elif was_up and not is_up:
                self._down.add(interface)
                for station, transport in transports:
                    station.hop_down(transport, None, f"interface {interface} has no link")
