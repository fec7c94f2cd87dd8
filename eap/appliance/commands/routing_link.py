"""What the routers of running stations are told, next to what a plant file says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeAlias

import msgspec

from eap.aoe.spec import RoutingSpec
from eap.appliance.control_routing import RoutingDifference, RunningRouting

Ask: TypeAlias = Callable[..., Any]
"""Asks a method of the appliance of a station: method, station, parameters."""


class RoutingLink:
    """Asks about routers.

    Args:
        ask: As above; raises ControlError.
        wanted: What the plant file says, by station.
    """

    def __init__(self, ask: Ask, wanted: Mapping[str, RoutingSpec]) -> None:
        self._ask = ask
        self._wanted = wanted

    def export(self, station: str) -> RunningRouting | None:
        """Return what a station is told; None if the plant file has nothing to say of that."""
        if station not in self._wanted:
            return None
        return msgspec.convert(self._ask("routing_export", station), RunningRouting)

    def plan(self, station: str) -> RoutingDifference:
        """Return what the plant file would change at a station."""
        if station not in self._wanted:
            return RoutingDifference(changes=[], refused=[])
        routing = msgspec.to_builtins(self._wanted[station])
        answer = self._ask("routing_plan", station, routing=routing)
        return msgspec.convert(answer, RoutingDifference)

    def apply(self, station: str, cause: str) -> RoutingDifference:
        """Tell a station what the plant file says, as a step of the change named *cause*."""
        routing = msgspec.to_builtins(self._wanted[station])
        answer = self._ask("routing_apply", station, routing=routing, cause=cause)
        return msgspec.convert(answer, RoutingDifference)

    def rollback(self, station: str) -> RoutingDifference:
        """Take the last change of a station back, or make it again."""
        return msgspec.convert(self._ask("routing_rollback", station), RoutingDifference)
