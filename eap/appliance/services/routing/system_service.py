"""The system service of a router: behind its NetID and AMS port 10000, which probes ask."""

from __future__ import annotations

from time import monotonic_ns

from eap.aoe.ads_device import AdsDevice
from eap.aoe.ads_notifications import Client
from eap.aoe.ads_system import SYSTEM_PORT
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.appliance.services.routing.service import LocalRequest
from eap.codec.ads import AdsDeviceInfo, AdsError, AdsState, AdsStates, device_name
from eap.codec.ams import AmsCommand

_SERVICES = frozenset((AmsCommand.READ_DEVICE_INFO, AmsCommand.READ_STATE))


class SystemService:
    """Says that the router runs; *name* is that of its station."""

    ports = frozenset((SYSTEM_PORT,))

    def __init__(self, name: str) -> None:
        info = AdsDeviceInfo(1, 0, 0, device_name(name))
        self._device = AdsDevice(info, lambda: AdsStates(AdsState.RUN, 0), [])

    def answer(self, request: LocalRequest) -> AmsAnswer:
        """Tell states and name."""
        header = request.header
        if header.command not in _SERVICES:
            return AmsAnswer(error_code=AdsError.SERVICE)
        client = Client(request.came_by, header.source, header.source_port)
        return self._device.answer(header.command, request.body, client, monotonic_ns())

    def client_gone(self, way: Way) -> None:
        """Nothing: its states never change, so nobody is told."""
