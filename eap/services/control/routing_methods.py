"""Methods of the control protocol about the configuration of routers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from eap.control import device as words
from eap.control.device import RoutingDifference
from eap.control.protocol import of_station, unless_unavailable
from eap.services.routing.station_routing import StationRouting


class RoutingMethods:
    """Answers for the routers of all stations here, by the names of the stations."""

    def __init__(self, stations: Mapping[str, StationRouting]) -> None:
        self._stations = stations

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return dict(
            (
                words.ROUTING_EXPORT.served_by(self._export),
                words.ROUTING_PLAN.served_by(self._plan),
                words.ROUTING_APPLY.served_by(self._apply),
                words.ROUTING_ROLLBACK.served_by(self._roll_back),
            )
        )

    def _export(self, wanted: words.StationParameters) -> words.RunningRouting:
        station = self._station(wanted.station)
        last = station.applied
        if last is None:
            return words.RunningRouting(routing=station.routes.spec)
        return words.RunningRouting(
            routing=last.spec, previous=last.previous, cause=last.cause, undone=last.undone
        )

    def _plan(self, wanted: words.RoutingPlanParameters) -> RoutingDifference:
        plan = self._station(wanted.station).plan(wanted.routing)
        return RoutingDifference(changes=plan.changes, refused=plan.refused)

    async def _apply(self, wanted: words.RoutingApplyParameters) -> RoutingDifference:
        station = self._station(wanted.station)
        plan = station.plan(wanted.routing)
        if plan.refused:
            return RoutingDifference(changes=[], refused=plan.refused)
        with unless_unavailable():
            changes = await station.apply(wanted.routing, wanted.cause)
        return RoutingDifference(changes=changes, refused=[])

    async def _roll_back(self, wanted: words.StationParameters) -> RoutingDifference:
        station = self._station(wanted.station)
        with unless_unavailable():
            return RoutingDifference(changes=await station.roll_back(), refused=[])

    def _station(self, name: str) -> StationRouting:
        return of_station(name, self._stations)
