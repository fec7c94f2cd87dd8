"""All ADS services of a station, but those of its buses: given to its router, and kept going."""

from __future__ import annotations

from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import RouterDictionary
from eap.ids import NetId
from eap.pd.spec import StationSpec
from eap.runtime.station_image import StationImage
from eap.services.ads.ads_service import AdsService
from eap.services.ads.eap_ads import EapAds, device_info
from eap.services.ads.image_variables import StationSymbols
from eap.services.ads.notification_pump import NotificationPump
from eap.services.ads.router_ads import RouterAds
from eap.services.ads.router_values import LiveRouter
from eap.services.ads.system_ads import SystemAds
from eap.services.device.station_device import StationDevice
from eap.services.routing.station_router import StationRouter
from eap.services.routing.tracing import RouteQuery


class StationAds:
    """The services behind the NetIDs of one station's router and EAP ports.

    Args:
        station: As it was handed over.
        device: Its EAP device.
        image: Its process image.
        router: Where requests come from, and which sends notifications.
        identity: Of the station's devices.

    Attributes:
        dictionary: Of the router.
        pump: Tells whom notifications are for; devices of buses may be added.
    """

    def __init__(
        self,
        station: StationSpec,
        device: StationDevice,
        image: StationImage,
        router: StationRouter,
        identity: DeviceIdentity,
    ) -> None:
        symbols = StationSymbols(image)
        self.pump = NotificationPump(symbols, router.send_notification)
        values = LiveRouter(router, device, image, station.ports)
        self.dictionary = RouterDictionary(station, values, identity)
        release = identity.software_version
        info = device_info(station.name, release)
        own = RouterAds(station, device, self.dictionary, info)
        router.add_service(router.net_id, own)
        self._drive(own, router.net_id)
        system = SystemAds(device, info)
        router.add_service(router.net_id, RouteQuery(router, system))
        self._drive(system, router.net_id)
        net_ids = {port.name: NetId.parse(port.net_id) for port in station.ports}
        for port in device.dictionaries:
            net_id, name = net_ids[port], f"{station.name}/{port}"
            of_port = EapAds(device, port, symbols, device_info(name, release))
            for service in (of_port, SystemAds(device, info)):
                router.add_service(net_id, service)
                self._drive(service, net_id)

    async def serve(self) -> None:
        """Tell whom notifications are for, until cancelled."""
        await self.pump.serve()

    def _drive(self, service: AdsService, net_id: NetId) -> None:
        for ams_port, table in service.notifications.items():
            self.pump.add(table, net_id, ams_port)
