"""The EAP devices of an appliance: what services make of the stations that they were handed."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from time import monotonic_ns

from eap.ams.spec import RoutingSpec
from eap.device.eap_dictionary import DeviceIdentity
from eap.errors import ImageError
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec
from eap.pd.words import StationWord
from eap.runtime.startup import Step, no_step
from eap.runtime.station_image import StationImage
from eap.runtime.store import StationStore
from eap.services.ads.station_ads import StationAds
from eap.services.device.image_values import ImageValues
from eap.services.device.sources import SourcePlayer
from eap.services.device.station_device import StationDevice
from eap.services.device.station_keeper import StationEngine, StationKeeper
from eap.services.routing.planned import access_of, make_router
from eap.services.routing.station_router import StationRouter
from eap.services.routing.station_routes import StationRoutes
from eap.services.routing.station_routing import StationRouting

_LATELY_NS = 2_000_000_000


class Devices:
    """All devices, with what belongs to each.

    Args:
        plant: Name of the plant.
        stations: What the engine runs.
        states: In which states, Op where none is given.
        images: The process image of each station.
        engine: Who runs the stations.
        release: Of this software.
        routing: What the routers of the stations are told; nothing for one that is not there.
        step: Is told which station is built next.

    Attributes:
        by_station: The devices.
        routers: Of AMS packets, by station.
        routing: What these routers are told, their routes among it.
        ads: What they find at the NetIDs of routers and EAP ports, by station.
    """

    def __init__(
        self,
        plant: str,
        stations: Sequence[StationSpec],
        states: Mapping[str, DeviceState],
        images: Mapping[str, StationImage],
        engine: StationEngine,
        release: str,
        routing: Mapping[str, RoutingSpec] = {},
        *,
        step: Step = no_step,
    ) -> None:
        self.by_station: dict[str, StationDevice] = {}
        self.routers: dict[str, StationRouter] = {}
        self.routing: dict[str, StationRouting] = {}
        self.ads: dict[str, StationAds] = {}
        self._players: list[SourcePlayer] = []
        self._release = release
        self._images = images
        self._has_restarted = asyncio.Event()
        for station in stations:
            step(f"building station {station.name}")
            state = states.get(station.name, DeviceState.OP)
            store = StationStore(plant, station.name)
            keeper = StationKeeper(station, state, store.configuration, engine)
            self._add(station, keeper, store, routing.get(station.name, RoutingSpec()))

    async def serve(self) -> None:
        """Serve all of them until cancelled.

        Raises:
            ExceptionGroup: a source cannot be played, as ``play_sources`` says.
        """
        async with asyncio.TaskGroup() as group:
            for router in self.routers.values():
                group.create_task(router.serve())
            for ads in self.ads.values():
                group.create_task(ads.serve())
            for player in self._players:
                group.create_task(player.serve())
            group.create_task(self._follow_restarts())

    def engine_has_restarted(self) -> None:
        """Tell the new engine, soon, what it may have missed."""
        self._has_restarted.set()

    def _add(
        self,
        station: StationSpec,
        keeper: StationKeeper,
        store: StationStore,
        routing: RoutingSpec,
    ) -> None:
        name, image = station.name, self._images[station.name]
        if _runs(image):
            self._has_restarted.set()  # services before this one, in the middle of a change
        player = SourcePlayer(station, image)
        keeper.on_change = player.change
        self._players.append(player)
        identity = DeviceIdentity(
            device_name=f"EAP station {name}",
            hardware_version=os.uname().machine,
            software_version=self._release,
        )
        device = StationDevice(keeper, ImageValues(image), identity)
        self.by_station[name] = device
        self.routers[name] = router = make_router(station, routing)
        self.routing[name] = StationRouting(
            name,
            StationRoutes(router, routing, store.routes),
            store.routing,
            partial(_set_access, station, router),
        )
        self.routing[name].start()
        self.ads[name] = StationAds(station, device, image, router, identity)

    async def _follow_restarts(self) -> None:
        while True:
            await self._has_restarted.wait()
            self._has_restarted.clear()
            for image in self._images.values():
                with suppress(ImageError):  # whoever reads it is told
                    image.catch_up()  # an engine that died may have retired nothing
            for device in self.by_station.values():
                await device.tell_again()


def _set_access(station: StationSpec, router: StationRouter, told: RoutingSpec) -> None:
    router.set_access(access_of(station, told))


def _runs(image: StationImage) -> bool:
    """Tell whether an engine has run a cycle of the station just now."""
    ran_at_ns = image.image.words[StationWord.CYCLE_AT_NS]
    return bool(ran_at_ns) and monotonic_ns() - ran_at_ns < _LATELY_NS
