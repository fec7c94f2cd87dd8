"""What the ADS services of a station have in common: ports, whom they tell, one state for all."""

from __future__ import annotations

from collections.abc import Awaitable, Mapping, Sequence
from functools import partial
from secrets import randbelow
from time import monotonic_ns

from eap.ads.device import AdsDevice
from eap.ads.endpoint import AmsAnswer, Endpoint
from eap.ads.notifications import Client, NotificationTable
from eap.ads.operation import Operation, OperationOutcome, WriteControl
from eap.ads.space import AdsSpace, states_of
from eap.codec.ads import AdsDeviceInfo, AdsStates
from eap.services.ads.ads_requests import begin_answer
from eap.services.ads.state_control import control_state
from eap.services.device.station_device import StationDevice
from eap.services.routing.service import LocalRequest


def first_handle() -> int:
    """Return a handle to begin with: another one at each start, see ``NotificationTable``."""
    return randbelow(1 << 31) + 1


class AdsService:
    """What clients reach at some AMS ports of one NetID (Service).

    Args:
        device: The EAP device of the station, whose state is that of the whole.
        info: What ReadDeviceInfo tells.
        spaces: By AMS port: what reads and writes there.

    Attributes:
        device: The EAP device of the station.
        devices: By AMS port: who answers there.
        ports: AMS ports that it has.
    """

    def __init__(
        self, device: StationDevice, info: AdsDeviceInfo, spaces: Mapping[int, Sequence[AdsSpace]]
    ) -> None:
        self.device = device
        self.devices = {
            port: AdsDevice(info, self.states, each, first_handle=first_handle())
            for port, each in spaces.items()
        }
        self.ports = frozenset(self.devices)

    @property
    def notifications(self) -> Mapping[int, NotificationTable]:
        """By AMS port: whom it tells of what."""
        return {port: device.notifications for port, device in self.devices.items()}

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request, at once where nobody has to be waited for."""
        header = request.header
        client = Client(request.came_by, header.source, header.source_port)
        perform = partial(self.perform, header.target_port, client)
        return begin_answer(header.command, request.body, perform)

    def client_gone(self, endpoint: Endpoint) -> None:
        """End the notifications of a connection."""
        for device in self.devices.values():
            device.notifications.forget(endpoint)

    def perform(
        self, port: int, client: Client, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Do one operation at an AMS port; another state is waited for."""
        if isinstance(operation, WriteControl):
            return control_state(self.device, operation)
        return self.devices[port].perform(operation, client, monotonic_ns())

    def states(self) -> AdsStates:
        """Return what ReadState tells."""
        return states_of(self.device.status.state)
