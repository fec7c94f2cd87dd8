"""The system service of a station: what ADS clients look at before they talk to anybody else.

It is at the NetID of the router and at those of EAP ports, for a TwinCAT system has one NetID for
all, and clients ask the one that they were given.
"""

from __future__ import annotations

from collections.abc import Awaitable
from secrets import randbelow

from eap.ads.notifications import Client
from eap.ads.operation import Operation, OperationOutcome, WriteControl
from eap.ads.space import SystemSpace
from eap.codec.ads import AdsDeviceInfo, AdsState, AdsSystemState
from eap.codec.ams import SYSTEM_PORT
from eap.services.ads.ads_service import AdsService
from eap.services.device.station_device import StationDevice

_RESTART_INDEX = randbelow(0xFFFF) + 1
"""Another one at each start of this process, by which others know that subscriptions are gone."""


class SystemAds(AdsService):
    """The system service behind one NetID.

    Args:
        device: The EAP device of the station, whose state is that of the whole.
        info: What ReadDeviceInfo tells.
    """

    def __init__(self, device: StationDevice, info: AdsDeviceInfo) -> None:
        super().__init__(device, info, {SYSTEM_PORT: [SystemSpace(self._system_state)]})
        self._info = info

    def perform(
        self, port: int, client: Client, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Do one operation; another state is waited for."""
        if isinstance(operation, WriteControl) and operation.ads_state == AdsState.RESET:
            # TwinCAT's system service goes to RUN by it; ads-client knows no other way.
            operation = operation._replace(ads_state=AdsState.RUN)
        return super().perform(port, client, operation)

    def _system_state(self) -> AdsSystemState:
        states, info = self.states(), self._info
        return AdsSystemState(
            states.ads_state,
            states.device_state,
            restart_index=_RESTART_INDEX,
            version=info.major,
            revision=info.minor,
            build=info.build,
        )
