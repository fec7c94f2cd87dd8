"""MQTT brokers of one station, which follow its routing configuration while it runs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from eap.ams.routes import Origin
from eap.ams.spec import MqttSpec, RoutingSpec
from eap.runtime.drop_counters import DropReason
from eap.services.routing.station_router import StationRouter

if TYPE_CHECKING:
    from eap.services.transports.mqtt_transport import MqttTransport


class _Settings(NamedTuple):
    """All that a transport depends on; with other settings it is another one."""

    spec: MqttSpec
    learns: bool


class StationBrokers:
    """The transports to the brokers of one station, by network.

    Args:
        router: Router of the station.
    """

    def __init__(self, router: StationRouter) -> None:
        self._router = router
        self._count_dropped: Callable[[DropReason], object] = lambda reason: None
        self._transports: dict[str, MqttTransport] = {}
        self._settings: dict[str, _Settings] = {}
        self._tasks: dict[str, asyncio.Task[None]] = {}
        self._group: asyncio.TaskGroup | None = None

    def open(self, spec: RoutingSpec, count_dropped: Callable[[DropReason], object]) -> None:
        """Add the transports of *spec*, to be served.

        Raises:
            EnvironmentalError: there is a broker, and MQTT is not installed.
        """
        self._count_dropped = count_dropped
        for network, settings in _settings_of(spec).items():
            self._add(network, settings)

    async def serve(self) -> None:
        """Keep the connections until cancelled."""
        try:
            async with asyncio.TaskGroup() as self._group:
                for network in self._transports:
                    self._start(network)
                await asyncio.Event().wait()
        finally:
            self._group = None

    async def follow(self, spec: RoutingSpec, put_in_force: Callable[[], None]) -> None:
        """Close and open connections as *spec* has them; the others stay as they are.

        Args:
            spec: The new configuration.
            put_in_force: Called when brokers that leave are gone, before new ones are there: so
                that the access rules of a network are never later than the network.
        """
        wanted = _settings_of(spec)
        leaving = [name for name, before in self._settings.items() if wanted.get(name) != before]
        tasks = [self._tasks.pop(network) for network in leaving if network in self._tasks]
        for task in tasks:
            task.cancel()
        # Each tells its broker that it leaves, for a limited time.
        await asyncio.gather(*tasks, return_exceptions=True)
        # From here on nothing waits: no packet meets a network without its transport.
        for network in leaving:
            self._remove(network)
        put_in_force()
        for network, settings in wanted.items():
            if network not in self._transports:
                self._add(network, settings)
                self._start(network)

    def _add(self, network: str, settings: _Settings) -> None:
        # Imported here: few plants have a broker.
        from eap.services.transports.mqtt_transport import MqttTransport

        self._transports[network] = MqttTransport(
            settings.spec, self._router, self._count_dropped, learns=settings.learns
        )
        self._settings[network] = settings

    def _remove(self, network: str) -> None:
        name = self._transports.pop(network).name
        del self._settings[network]
        for route in list(self._router.table):
            if route.hop.transport == name and route.origin is Origin.LEARNED:
                self._router.remove_route(*route.key)
        self._router.remove_transport(name)

    def _start(self, network: str) -> None:
        if self._group is not None:
            transport = self._transports[network]
            self._tasks[network] = self._group.create_task(transport.serve())


def _settings_of(spec: RoutingSpec) -> dict[str, _Settings]:
    return {each.network: _Settings(each, spec.learns_by_mqtt(each.network)) for each in spec.mqtt}
