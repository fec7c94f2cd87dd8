"""The ADS services of a station's router beside the system service: I/O server and dictionary."""

from __future__ import annotations

from collections.abc import Awaitable, Iterator, Mapping
from functools import partial
from time import monotonic_ns

from eap.aoe.ads_device import AdsDevice
from eap.aoe.ads_io import IoDevice, IoDeviceType, IoSpace
from eap.aoe.ads_notifications import Client, NotificationTable
from eap.aoe.ads_objects import ObjectSpace
from eap.aoe.ads_operation import Operation, OperationOutcome, WriteControl
from eap.aoe.ads_space import AdsSpace
from eap.aoe.ads_state import states_of
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.ads.ads_requests import begin_answer
from eap.appliance.services.ads.ads_result import ads_result
from eap.appliance.services.ads.state_control import control_state
from eap.appliance.services.device.station_device import StationDevice
from eap.appliance.services.routing.service import LocalRequest
from eap.codec.ads import AdsDeviceInfo, AdsStates
from eap.codec.ams import DEVICE_PORT, IO_PORT
from eap.device.router_dictionary import RouterDictionary
from eap.ids import NetId
from eap.od.model import OdState
from eap.pd.spec import PortKind, StationSpec

_TYPES = {PortKind.EAP: IoDeviceType.EAP, PortKind.BUS: IoDeviceType.MASTER}


class RouterAds:
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
        self._device = device
        self._info = info
        objects = ObjectSpace(dictionary, lambda: OdState.OP, ads_result)
        self._devices = {
            IO_PORT: self._make(IoSpace(_io_devices(station))),
            DEVICE_PORT: self._make(objects),
        }
        self.ports = frozenset(self._devices)

    @property
    def notifications(self) -> Mapping[int, NotificationTable]:
        """By AMS port: whom it tells of what."""
        return {port: device.notifications for port, device in self._devices.items()}

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request, at once unless it is for another state."""
        header = request.header
        client = Client(request.came_by, header.source, header.source_port)
        perform = partial(self._perform, header.target_port, client)
        return begin_answer(header.command, request.body, perform)

    def client_gone(self, way: Way) -> None:
        """End the notifications of a connection."""
        for table in self.notifications.values():
            table.forget(way)

    def _perform(
        self, port: int, client: Client, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        if isinstance(operation, WriteControl) and port != IO_PORT:
            return control_state(self._device, operation)
        return self._devices[port].perform(operation, client, monotonic_ns())

    def _make(self, space: AdsSpace) -> AdsDevice:
        return AdsDevice(self._info, self._states, [space])

    def _states(self) -> AdsStates:
        return states_of(self._device.status.state)


def _io_devices(station: StationSpec) -> Iterator[IoDevice]:
    for number, port in enumerate(station.ports, start=1):
        yield IoDevice(number, port.name, _TYPES[port.kind], NetId.parse(port.net_id))
