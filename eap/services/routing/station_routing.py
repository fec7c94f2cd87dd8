"""Routing configuration of one station: from the plant file, or applied while the station runs.

An applied configuration is stored, and in force until the plant file that the appliance is started
with is edited.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, Protocol

from msgspec.structs import replace

from eap.ams.spec import RoutingSpec, describe_routing
from eap.errors import ControlError, EnvironmentalError
from eap.runtime.store import AppliedRouting, StationFile, digest_of
from eap.services.routing.station_routes import StationRoutes
from eap.services.tasks import JobQueue

logger = logging.getLogger(__name__)


class RoutingPlan(NamedTuple):
    """Changes that another specification makes, and reasons against it, one line each."""

    changes: list[str]
    refused: list[str]


class BrokerConnections(Protocol):
    """Connections of a station to MQTT brokers."""

    async def follow(self, spec: RoutingSpec, put_in_force: Callable[[], None]) -> None:
        """Close those that *spec* has not, call *put_in_force*, open those that are missing."""


class StationRouting:
    """Routes, brokers, access rules and users of one station, which may change while it runs.

    Args:
        name: Of the station.
        routes: Of the station, not started yet.
        store: Of the applied configuration.
        set_access: Puts the access rules in force.
        brokers: Connections to MQTT brokers.
    """

    def __init__(
        self,
        name: str,
        routes: StationRoutes,
        store: StationFile[AppliedRouting],
        set_access: Callable[[RoutingSpec], None],
        brokers: BrokerConnections,
    ) -> None:
        self.routes = routes
        self._brokers = brokers
        self._name = name
        self._store = store
        self._set_access = set_access
        # The digest tells later whether the plant file was edited since.
        self._base = digest_of(routes.spec)
        self._applied = self._usable(store.read())
        self._jobs = JobQueue(f"routing of station {name}")

    @property
    def applied(self) -> AppliedRouting | None:
        """Configuration that was applied last; None if none was since the plant file was edited."""
        return self._applied

    def start(self) -> None:
        """Start with the configuration that was applied last, or with that of the plant file."""
        if self._applied is None:
            self.routes.start()
        else:
            if self._applied.spec != self.routes.spec:
                logger.warning(
                    "station %s: routes and access rules are as applied last; 'eapctl plan' shows"
                    " what differs from the plant file",
                    self._name,
                )
            self.routes.start(self._applied.spec)
        self._set_access(self.routes.spec)

    def plan(self, spec: RoutingSpec) -> RoutingPlan:
        """Return the changes that *spec* makes."""
        return RoutingPlan(describe_routing(self.routes.spec, spec), _missing_for(spec))

    async def apply(self, spec: RoutingSpec, cause: str) -> list[str]:
        """Store *spec*, then put it in force; return the changes.

        Raises:
            ControlError: MQTT is not installed, or too many changes wait already.
            EnvironmentalError: it cannot be stored.
        """
        return await self._jobs.run(partial(self._apply, spec, cause))

    async def roll_back(self) -> list[str]:
        """Undo the last change, or redo it; return the changes.

        Raises:
            ControlError: there was no change, or too many changes wait already.
            EnvironmentalError: it cannot be stored.
        """
        return await self._jobs.run(self._roll_back)

    async def _apply(self, spec: RoutingSpec, cause: str) -> list[str]:
        plan = self.plan(spec)
        if plan.refused:
            raise ControlError("; ".join(plan.refused))
        if spec != self.routes.spec:
            before = self.routes.spec
            if self._applied is not None and self._applied.cause == cause:
                before = (
                    self._applied.previous
                )  # one change in several steps: the state before the first
            await self._change(
                AppliedRouting(base=self._base, spec=spec, previous=before, cause=cause)
            )
        return plan.changes

    async def _roll_back(self) -> list[str]:
        now = self._applied
        if now is None:
            raise ControlError("routes and access rules were not changed while the station ran")
        changes = describe_routing(now.spec, now.previous)
        await self._change(
            replace(now, spec=now.previous, previous=now.spec, undone=not now.undone)
        )
        return changes

    def _usable(self, kept: AppliedRouting | None) -> AppliedRouting | None:
        """Return the stored configuration, unless the plant file was edited since."""
        if kept is None or kept.base == self._base:
            return kept
        if kept.spec != self.routes.spec:
            logger.warning(
                "station %s: the plant file was edited since routes or access rules were changed;"
                " the file is in force",
                self._name,
            )
        try:
            self._store.set_aside()
        except EnvironmentalError as exc:
            logger.warning("%s", exc)
        return None

    async def _change(self, applied: AppliedRouting) -> None:
        await asyncio.to_thread(self._store.save, applied)  # packets must not wait for the disk
        self._applied = applied
        await self._brokers.follow(applied.spec, partial(self._put_in_force, applied.spec))

    def _put_in_force(self, spec: RoutingSpec) -> None:
        self.routes.replace_spec(spec)
        self._set_access(spec)


def _missing_for(spec: RoutingSpec) -> list[str]:
    """Return what this installation lacks for the brokers of *spec*, one line each."""
    if not spec.mqtt:
        return []
    # Imported here: few plants have a broker.
    from eap.net.mqtt import require_mqtt

    try:
        require_mqtt()
    except EnvironmentalError as exc:
        return [str(exc)]
    return []
