"""The ADS services of a station's router beside the system service: I/O server and dictionary."""

from __future__ import annotations

from collections.abc import Awaitable, Iterator
from time import monotonic_ns

from eap.ads.io import IoDevice, IoDeviceType, IoSpace
from eap.ads.notifications import Client
from eap.ads.objects import ObjectSpace
from eap.ads.operation import Operation, OperationOutcome
from eap.codec.ads import AdsDeviceInfo
from eap.codec.ams import DEVICE_PORT, IO_PORT
from eap.device.live_dictionaries import RouterDictionary
from eap.gateway.error_table import ads_result
from eap.ids import NetId
from eap.od.model import OdState
from eap.pd.spec import PortKind, StationSpec
from eap.services.ads.ads_service import AdsService
from eap.services.device.station_device import StationDevice

_TYPES = {PortKind.EAP: IoDeviceType.EAP, PortKind.BUS: IoDeviceType.MASTER}


class RouterAds(AdsService):
    """What clients reach at the NetID of a station.

    Args:
        station: Whose router it is.
        device: The EAP device of the station, whose state is that of the whole.
        dictionary: Of the router.
        info: What ReadDeviceInfo tells.
    """

    def __init__(
        self,
        station: StationSpec,
        device: StationDevice,
        dictionary: RouterDictionary,
        info: AdsDeviceInfo,
    ) -> None:
        io = IoSpace(_io_devices(station))
        objects = ObjectSpace(dictionary, lambda: OdState.OP, ads_result)
        super().__init__(device, info, {IO_PORT: [io], DEVICE_PORT: [objects]})

    def perform(
        self, port: int, client: Client, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Do one operation at an AMS port; the I/O server has no state to go to."""
        if port == IO_PORT:
            return self.devices[port].perform(operation, client, monotonic_ns())
        return super().perform(port, client, operation)


def _io_devices(station: StationSpec) -> Iterator[IoDevice]:
    for number, port in enumerate(station.ports, start=1):
        yield IoDevice(number, port.name, _TYPES[port.kind], NetId.parse(port.net_id))
