"""The system service of a station: what ADS clients look at before they talk to anybody else.

It is at the NetID of the router and at those of EAP ports, for a TwinCAT system has one NetID for
all, and clients ask the one that they were given.
"""

from __future__ import annotations

from collections.abc import Awaitable
from functools import partial
from time import monotonic_ns

from eap.aoe.ads_device import AdsDevice
from eap.aoe.ads_notifications import Client, NotificationTable
from eap.aoe.ads_operation import Operation, OperationOutcome, WriteControl
from eap.aoe.ads_state import states_of
from eap.aoe.ads_system import SystemSpace
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.ads.ads_requests import begin_answer
from eap.appliance.services.ads.state_control import control_state
from eap.appliance.services.device.station_device import StationDevice
from eap.appliance.services.routing.service import LocalRequest
from eap.codec.ads import AdsDeviceInfo, AdsState, AdsStates, AdsSystemState
from eap.codec.ams import SYSTEM_PORT


class SystemAds:
    """The system service behind one NetID.

    Args:
        device: The EAP device of the station, whose state is that of the whole.
        info: What ReadDeviceInfo tells.
    """

    ports = frozenset((SYSTEM_PORT,))

    def __init__(self, device: StationDevice, info: AdsDeviceInfo) -> None:
        self._device = device
        self._info = info
        self._ads = AdsDevice(info, self._states, [SystemSpace(self._system_state)])

    @property
    def notifications(self) -> NotificationTable:
        """Whom it tells of what."""
        return self._ads.notifications

    def answer(self, request: LocalRequest) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request, at once unless it is for another state."""
        header = request.header
        client = Client(request.came_by, header.source, header.source_port)
        return begin_answer(header.command, request.body, partial(self._perform, client))

    def client_gone(self, way: Way) -> None:
        """End the notifications of a connection."""
        self._ads.notifications.forget(way)

    def _perform(
        self, client: Client, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        if isinstance(operation, WriteControl):
            if operation.ads_state == AdsState.RESET:
                # TwinCAT's system service goes to RUN by it; ads-client knows no other way.
                operation = operation._replace(ads_state=AdsState.RUN)
            return control_state(self._device, operation)
        return self._ads.perform(operation, client, monotonic_ns())

    def _states(self) -> AdsStates:
        return states_of(self._device.status.state)

    def _system_state(self) -> AdsSystemState:
        states, info = self._states(), self._info
        return AdsSystemState(
            states.ads_state,
            states.device_state,
            version=info.major,
            revision=info.minor,
            build=info.build,
        )
