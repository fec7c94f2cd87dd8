"""All AMS/TCP connections that one station opens: one for each peer that a route leads to."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable
from typing import Protocol

from eap.aoe.routes import Route
from eap.aoe.spec import DoorKind
from eap.aoe.way import Door, Way
from eap.appliance.discards import Refusal
from eap.appliance.services.ams.ams_uplink import AmsUplink, Hops, Peer
from eap.appliance.services.routing.service import Carrier
from eap.codec.amstcp import AMS_TCP_PORT
from eap.ids import parse_host

logger = logging.getLogger(__name__)

DOOR = f"{DoorKind.AMS_TCP}:"
"""Begin of the names of doors to peers; the address of the peer follows."""


class UplinkRouter(Hops, Protocol):
    """What uplinks need of the router of their station.

    Attributes:
        on_routes: Called with the hop of each route that was added or removed.
    """

    on_routes: list[Callable[[Way], None]]

    @property
    def table(self) -> Iterable[Route]:
        """All routes."""

    def add_door(self, door: Door, carrier: Carrier) -> None:
        """Let packets come and go by *door*."""

    def remove_door(self, name: str) -> None:
        """Forget a door."""


class AmsUplinks:
    """The uplinks of one station: they follow its routes.

    Args:
        router: Of the station.
        sources: The station's own IPv4 addresses.
        refuse: Counts what is not taken.
    """

    def __init__(
        self, router: UplinkRouter, sources: Collection[str], refuse: Callable[[Refusal], None]
    ) -> None:
        self._router = router
        self._sources = sources
        self._refuse = refuse
        self._uplinks: dict[Way, AmsUplink] = {}
        self._tasks: dict[Way, asyncio.Task[None]] = {}
        self._claims: dict[tuple[str, int], AmsUplink] = {}
        self._group: asyncio.TaskGroup | None = None
        for route in router.table:
            self._follow(route.hop)
        router.on_routes.append(self._follow)

    async def serve(self) -> None:
        """Keep the connections until cancelled."""
        async with asyncio.TaskGroup() as self._group:
            for way in self._uplinks:
                self._start(way)
            await asyncio.Event().wait()

    def _follow(self, hop: Way) -> None:
        """Open the connection to *hop*, or close it, as there are routes to it or none."""
        if not hop.door.startswith(DOOR):
            return
        is_used = any(route.hop == hop for route in self._router.table)
        if is_used and hop not in self._uplinks:
            self._open(hop)
        elif not is_used and hop in self._uplinks:
            self._close(hop)

    def _open(self, hop: Way) -> None:
        try:
            peer = Peer(*parse_host(hop.connection, AMS_TCP_PORT))
        except ValueError as exc:
            logger.warning("a route leads nowhere: %s", exc)
            return
        self._uplinks[hop] = uplink = AmsUplink(
            peer,
            *hop,
            self._router,
            sources=self._sources,
            claims=self._claims,
            refuse=self._refuse,
            may_be_client=lambda: all(
                route.is_client for route in self._router.table if route.hop == hop
            ),
        )
        self._router.add_door(Door(hop.door, is_stream=True, is_hub=True), uplink)
        self._start(hop)

    def _close(self, hop: Way) -> None:
        if (task := self._tasks.pop(hop, None)) is not None:
            task.cancel()
        self._uplinks.pop(hop).end()
        self._router.hop_up(*hop)  # nothing is known of it any more
        self._router.remove_door(hop.door)

    def _start(self, hop: Way) -> None:
        if self._group is not None:
            self._tasks[hop] = self._group.create_task(self._uplinks[hop].serve())
