"""The EAP devices of an appliance: what services make of the stations that they were handed."""

from __future__ import annotations

import asyncio
import platform
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from time import monotonic_ns

from eap.aoe.ads_notifications import Client
from eap.aoe.ads_operation import DeleteNotification, Operation
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.aoe_desk import AoeDesk
from eap.appliance.services.eap_ads import EapAds, device_info
from eap.appliance.services.image_values import ImageValues
from eap.appliance.services.image_variables import StationSymbols
from eap.appliance.services.sources import SourcePlayer
from eap.appliance.services.station_device import StationDevice
from eap.appliance.services.station_keeper import StationEngine, StationKeeper
from eap.appliance.station_image import StationImage
from eap.appliance.store import Store
from eap.codec.ads import AdsError
from eap.codec.adsnotification import AddNotification
from eap.device.eap_content import Identity
from eap.errors import ImageError
from eap.ids import NetId
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec
from eap.pd.words import StationWord

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

    Attributes:
        by_station: The devices.
        desks: Who answers AMS packets to them, by station.
    """

    def __init__(
        self,
        plant: str,
        stations: Sequence[StationSpec],
        states: Mapping[str, DeviceState],
        images: Mapping[str, StationImage],
        engine: StationEngine,
        release: str,
    ) -> None:
        store = Store(plant)
        self.by_station: dict[str, StationDevice] = {}
        self.desks: dict[str, AoeDesk] = {}
        self._players: list[SourcePlayer] = []
        self._images = images
        self._has_restarted = asyncio.Event()
        for station in stations:
            name, image = station.name, images[station.name]
            keeper = StationKeeper(station, states.get(name, DeviceState.OP), store, engine)
            if _runs(image):
                self._has_restarted.set()  # services before this one, in the middle of a change
            player = SourcePlayer(station, image)
            keeper.on_change = player.change
            self._players.append(player)
            identity = Identity(
                device_name=f"EAP station {name}",
                hardware_version=platform.machine(),
                software_version=release,
            )
            device = StationDevice(keeper, ImageValues(image), identity)
            self.by_station[name] = device
            self.desks[name] = _desk(station, device, image, release)

    async def serve(self) -> None:
        """Serve all of them until cancelled.

        Raises:
            ExceptionGroup: a source cannot be played, as ``play_sources`` says.
        """
        async with asyncio.TaskGroup() as group:
            for device in self.by_station.values():
                group.create_task(device.serve())
            for desk in self.desks.values():
                group.create_task(desk.serve())
            for player in self._players:
                group.create_task(player.serve())
            group.create_task(self._follow_restarts())

    def engine_has_restarted(self) -> None:
        """Tell the new engine, soon, what it may have missed."""
        self._has_restarted.set()

    async def _follow_restarts(self) -> None:
        while True:
            await self._has_restarted.wait()
            self._has_restarted.clear()
            for image in self._images.values():
                with suppress(ImageError):  # whoever reads it is told
                    image.catch_up()  # an engine that died may have retired nothing
            for device in self.by_station.values():
                await device.tell_again()


def _runs(image: StationImage) -> bool:
    """Tell whether an engine has run a cycle of the station just now."""
    ran_at_ns = image.image.words[StationWord.CYCLE_AT_NS]
    return bool(ran_at_ns) and monotonic_ns() - ran_at_ns < _LATELY_NS


def _desk(
    station: StationSpec, device: StationDevice, image: StationImage, release: str
) -> AoeDesk:
    net_ids = {port.name: NetId.parse(port.net_id) for port in station.ports}
    symbols = StationSymbols(image)
    answering = {}
    for port in device.dictionaries:
        info = device_info(f"{station.name}/{port}", release)
        ads = EapAds(device, port, symbols, info)
        answering[net_ids[port]] = partial(_answer, ads)
    return AoeDesk(answering, {NetId.parse(station.net_id), *net_ids.values()})


_ANYBODY = Client(Way("", ""), NetId(bytes(6)), 0)


async def _answer(ads: EapAds, command: int, body: bytes) -> AmsAnswer:
    return await ads.answer(command, body, _ANYBODY, judge=_without_notifications)


def _without_notifications(operation: Operation) -> AdsError:
    is_told = isinstance(operation, AddNotification | DeleteNotification)
    return AdsError.SERVICE if is_told else AdsError.NONE
