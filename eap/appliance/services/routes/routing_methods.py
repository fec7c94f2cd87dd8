"""The methods of the control protocol about what routers are told."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from eap.appliance.control import of_station, parameters, unless_unavailable
from eap.appliance.control_routing import (
    RoutingApplyParameters,
    RoutingDifference,
    RoutingExportParameters,
    RoutingPlanParameters,
    RunningRouting,
)
from eap.appliance.services.routes.station_routing import StationRouting


class RoutingMethods:
    """Answers for the routers of all stations here, by the names of the stations."""

    def __init__(self, stations: Mapping[str, StationRouting]) -> None:
        self._stations = stations

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name."""
        return {
            "routing_export": self._export,
            "routing_plan": self._plan,
            "routing_apply": self._apply,
            "routing_rollback": self._roll_back,
        }

    def _export(self, params: dict[str, Any]) -> RunningRouting:
        station = self._station(parameters(params, RoutingExportParameters).station)
        last = station.applied
        if last is None:
            return RunningRouting(routing=station.routes.spec)
        return RunningRouting(
            routing=last.spec, previous=last.previous, cause=last.cause, undone=last.undone
        )

    def _plan(self, params: dict[str, Any]) -> RoutingDifference:
        wanted = parameters(params, RoutingPlanParameters)
        plan = self._station(wanted.station).plan(wanted.routing)
        return RoutingDifference(changes=plan.changes, refused=plan.refused)

    async def _apply(self, params: dict[str, Any]) -> RoutingDifference:
        wanted = parameters(params, RoutingApplyParameters)
        station = self._station(wanted.station)
        plan = station.plan(wanted.routing)
        if plan.refused:
            return RoutingDifference(changes=[], refused=plan.refused)
        with unless_unavailable():
            changes = await station.apply(wanted.routing, wanted.cause)
        return RoutingDifference(changes=changes, refused=[])

    async def _roll_back(self, params: dict[str, Any]) -> RoutingDifference:
        station = self._station(parameters(params, RoutingExportParameters).station)
        with unless_unavailable():
            return RoutingDifference(changes=await station.roll_back(), refused=[])

    def _station(self, name: str) -> StationRouting:
        return of_station(name, self._stations)
