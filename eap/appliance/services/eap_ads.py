"""The ADS services of an EAP port: its dictionary, its states, the variables of its station.

What changes a dictionary or a state waits for its turn, for the engine has to agree; everything
else is answered at once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from time import monotonic_ns

from eap.aoe.ads_device import AdsDevice, Judge, allow
from eap.aoe.ads_notifications import Client, NotificationTable
from eap.aoe.ads_objects import ObjectSpace
from eap.aoe.ads_operation import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    Read,
    ReadDeviceInfo,
    ReadState,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.aoe.ads_request import encode_outcome, take_request
from eap.aoe.ads_state import al_state_for, states_of
from eap.aoe.answer import AmsAnswer
from eap.appliance.services.ads_requests import answer_in_steps
from eap.appliance.services.ads_result import ads_result
from eap.appliance.services.image_variables import StationSymbols
from eap.appliance.services.station_device import StationDevice
from eap.codec.ads import AdsDeviceInfo, AdsError, AdsStates, IndexGroup, device_name
from eap.codec.adsnotification import AddNotification
from eap.errors import ControlError
from eap.od.abort import SdoAbortError

DEVICE_PORT = 0xFFFF
"""AMS port of an EAP device."""
_READS = (Read, ReadState, ReadDeviceInfo)
_BUSY_PAUSE_S = 0.005
_BUSY_PAUSES = 20
"""Before a client is told that a writer has stopped in the middle of writing."""


class EapAds:
    """What clients reach at the NetID of one EAP port.

    Args:
        device: Of the station.
        port: Name of the port.
        symbols: The station's variables.
        info: What ReadDeviceInfo tells.

    Attributes:
        on_watch: Called when a notification was added.
    """

    def __init__(
        self, device: StationDevice, port: str, symbols: StationSymbols, info: AdsDeviceInfo
    ) -> None:
        self.on_watch: Callable[[], None] | None = None
        self._device = device
        self._port = port
        objects = ObjectSpace(device.dictionaries[port], device.od_state, ads_result)
        self._ads = AdsDevice(info, self._states, [objects, symbols])

    @property
    def notifications(self) -> NotificationTable:
        """Whom it tells of what."""
        return self._ads.notifications

    def answer(
        self, command: int, body: bytes, client: Client, *, judge: Judge = allow
    ) -> AmsAnswer | Awaitable[AmsAnswer]:
        """Answer a request: at once if it reads one thing, as most do.

        The arguments are those of :meth:`AdsDevice.answer`.
        """
        request = take_request(command, body)
        if isinstance(request, AmsAnswer):
            return request
        operation = request.operations[0] if len(request.operations) == 1 else None
        if isinstance(operation, _READS) and not request.sum_group:
            reason = judge(operation)
            outcome = (
                OperationOutcome(reason)
                if reason
                else self._ads.perform(operation, client, monotonic_ns())
            )
            if outcome.result != AdsError.BUSY:
                return AmsAnswer(encode_outcome(command, outcome), why=outcome.why)
        return answer_in_steps(request, partial(self._perform, client), judge)

    async def _perform(self, client: Client, operation: Operation) -> OperationOutcome:
        perform = partial(self._ads.perform, operation, client, monotonic_ns())
        if isinstance(operation, WriteControl):
            return await self._control(operation)
        if _changes_objects(operation):
            return await self._change(perform)
        outcome = perform()
        if isinstance(operation, AddNotification) and self.on_watch is not None:
            self.on_watch()
        if isinstance(operation, Read | ReadWrite):
            for _ in range(_BUSY_PAUSES):
                if outcome.result != AdsError.BUSY:
                    break
                await asyncio.sleep(_BUSY_PAUSE_S)
                outcome = perform()
        return outcome

    async def _change(self, perform: partial[OperationOutcome]) -> OperationOutcome:
        try:
            return await self._device.change(self._port, perform)
        except SdoAbortError as exc:
            return OperationOutcome(ads_result(exc), why=str(exc))
        except ControlError as exc:
            return OperationOutcome(AdsError.BUSY, why=str(exc))

    async def _control(self, request: WriteControl) -> OperationOutcome:
        try:
            wanted = al_state_for(request.ads_state)
            fault = (await self._device.request_state(wanted)).fault
        except AdsRefusedError as exc:
            return OperationOutcome(exc.result, why=f"no way to ADS state {request.ads_state}")
        except ControlError as exc:
            return OperationOutcome(AdsError.BUSY, why=str(exc))
        return (
            OperationOutcome()
            if fault is None
            else OperationOutcome(AdsError.STATE, why=str(fault))
        )

    def _states(self) -> AdsStates:
        return states_of(self._device.status.state)


def device_info(name: str, release: str) -> AdsDeviceInfo:
    """Return what a device of this software tells of itself; *release* is such as ``0.1.0``."""
    numbers = [int(part) if part.isdecimal() else 0 for part in release.split(".")]
    major, minor, build = (*numbers, 0, 0, 0)[:3]
    return AdsDeviceInfo(major & 0xFF, minor & 0xFF, build & 0xFFFF, device_name(name))


def _changes_objects(operation: Operation) -> bool:
    if isinstance(operation, ReadWrite):
        return operation.group == IndexGroup.SDO and bool(operation.data)
    return isinstance(operation, Write) and operation.group == IndexGroup.SDO
