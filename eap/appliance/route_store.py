"""What is kept of routes: those that were added, and what another plant file said of a router."""

from __future__ import annotations

from eap.aoe.spec import Record, RouteSpec, RoutingSpec
from eap.appliance.station_file import StationFile


class RouteStore(StationFile[tuple[RouteSpec, ...]]):
    """The added routes of one station."""

    def __init__(self, plant: str, station: str) -> None:
        super().__init__(plant, station, "routes", tuple[RouteSpec, ...], "added routes")

    def load(self) -> tuple[RouteSpec, ...]:
        """Return what is kept, nothing if that cannot be used."""
        return self.read() or ()


class AppliedRouting(Record, frozen=True, kw_only=True):
    """What a router was told while it ran.

    Attributes:
        base: Digest of what the plant file said that the appliance was started with.
        spec: What is in force.
        previous: What was before, for a rollback.
        cause: Which change brought it, see ``Stored.cause``.
        undone: Whether that change was rolled back: *previous* is what it had brought.
    """

    base: str
    spec: RoutingSpec
    previous: RoutingSpec
    cause: str = ""
    undone: bool = False


class RoutingStore(StationFile[AppliedRouting]):
    """What the router of one station was told while it ran."""

    def __init__(self, plant: str, station: str) -> None:
        super().__init__(plant, station, "routing", AppliedRouting, "routes and access rules")


def set_routes_aside(plant: str, station: str) -> None:
    """Let a station start as if nothing had been kept of its routes."""
    for file in (RouteStore(plant, station), RoutingStore(plant, station)):
        file.set_aside()


def bring_routes_back(plant: str, station: str) -> None:
    """Undo :func:`set_routes_aside`, unless something was kept since."""
    for file in (RouteStore(plant, station), RoutingStore(plant, station)):
        file.bring_back()
