"""All ADS services of a station, but those of its buses: given to its router, and kept going."""

from __future__ import annotations

from eap.appliance.services.eap_ads import DEVICE_PORT, EapAds, device_info
from eap.appliance.services.image_variables import StationSymbols
from eap.appliance.services.notification_pump import NotificationPump
from eap.appliance.services.router_ads import RouterAds
from eap.appliance.services.router_values import LiveRouter
from eap.appliance.services.routing.station_router import StationRouter
from eap.appliance.services.routing.whereabouts import Whereabouts
from eap.appliance.services.station_device import StationDevice
from eap.appliance.station_image import StationImage
from eap.device.eap_content import Identity
from eap.device.router_dictionary import RouterDictionary
from eap.ids import NetId
from eap.pd.spec import StationSpec


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
        identity: Identity,
    ) -> None:
        release = identity.software_version
        symbols = StationSymbols(image)
        self.pump = NotificationPump(symbols, router.send_notification)
        values = LiveRouter(router, device, image, station.ports)
        self.dictionary = RouterDictionary(station, values, identity)
        own = RouterAds(station, device, self.dictionary, release)
        router.add_service(router.net_id, Whereabouts(router, own))
        for ams_port, table in own.notifications.items():
            self.pump.add(table, router.net_id, ams_port)
        net_ids = {port.name: NetId.parse(port.net_id) for port in station.ports}
        for port in device.dictionaries:
            info = device_info(f"{station.name}/{port}", release)
            service = EapAds(device, port, symbols, info)
            router.add_service(net_ids[port], service)
            self.pump.add(service.notifications, net_ids[port], DEVICE_PORT)

    async def serve(self) -> None:
        """Tell whom notifications are for, until cancelled."""
        await self.pump.serve()
