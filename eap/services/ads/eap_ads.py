"""The ADS services of an EAP port: its dictionary, its states, the variables of its station.

What changes a dictionary or a state waits for its turn, for the engine has to agree; everything
else is answered at once.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import partial
from time import monotonic_ns

from eap.ads.endpoint import AmsAnswer
from eap.ads.io import NoSegmentSpace
from eap.ads.notifications import Client
from eap.ads.objects import ObjectSpace
from eap.ads.operation import (
    AdsRefusedError,
    Operation,
    OperationOutcome,
    ReadWrite,
    Write,
    WriteControl,
)
from eap.codec.ads import (
    AdsDeviceInfo,
    AdsError,
    AdsRange,
    IndexGroup,
    device_name,
    encode_result,
)
from eap.codec.ams import DEVICE_PORT, AmsCommand, AmsHeader
from eap.errors import ControlError
from eap.gateway.error_table import ads_result
from eap.od.abort import SdoAbortError
from eap.services.ads.ads_service import AdsService
from eap.services.ads.image_variables import StationSymbols
from eap.services.device.station_device import StationDevice

_READ, _DONE = AmsCommand.READ.value, AdsError.NONE.value  # members of enums are slow
_BUSY_PAUSE_S = 0.005
_BUSY_PAUSES = 20
"""Before a client is told that a writer has stopped in the middle of writing."""


class EapAds(AdsService):
    """What clients reach at the NetID of one EAP port.

    Args:
        device: Of the station.
        port: Name of the port.
        symbols: The station's variables.
        info: What ReadDeviceInfo tells.
    """

    def __init__(
        self, device: StationDevice, port: str, symbols: StationSymbols, info: AdsDeviceInfo
    ) -> None:
        objects = ObjectSpace(device.dictionaries[port], device.od_state, ads_result)
        super().__init__(device, info, {DEVICE_PORT: [objects, symbols, NoSegmentSpace()]})
        self._port = port
        self._ads = self.devices[DEVICE_PORT]

    def answer_now(self, header: AmsHeader, body: bytes) -> AmsAnswer | None:
        """Answer a Read that nothing speaks against; None for all else, which :meth:`answer` does.

        Most requests are such.
        """
        if header.command != _READ or len(body) != AdsRange.SIZE:
            return None
        asked = AdsRange.decode(body)
        try:
            data = self._ads.read(asked.group, asked.offset, asked.length)
        except AdsRefusedError:
            return None
        return AmsAnswer(encode_result(_DONE, data))

    def perform(
        self, port: int, client: Client, operation: Operation
    ) -> OperationOutcome | Awaitable[OperationOutcome]:
        """Do one operation; what changes objects or the state, or finds a writer, takes time."""
        if isinstance(operation, WriteControl):
            return super().perform(port, client, operation)
        perform = partial(self._ads.perform, operation, client, monotonic_ns())
        if _changes_objects(operation):
            return self._change(perform)
        outcome = perform()
        if outcome.result == AdsError.BUSY and not isinstance(operation, Write):
            return _try_again(perform)
        return outcome

    async def _change(self, perform: Callable[[], OperationOutcome]) -> OperationOutcome:
        try:
            return await self.device.change(self._port, perform)
        except SdoAbortError as exc:
            return OperationOutcome(ads_result(exc), why=str(exc))
        except ControlError as exc:
            return OperationOutcome(AdsError.BUSY, why=str(exc))


async def _try_again(perform: Callable[[], OperationOutcome]) -> OperationOutcome:
    """Wait for a writer in the middle of writing; one that died there is told."""
    for _ in range(_BUSY_PAUSES):
        await asyncio.sleep(_BUSY_PAUSE_S)
        outcome = perform()
        if outcome.result != AdsError.BUSY:
            break
    return outcome


def device_info(name: str, release: str) -> AdsDeviceInfo:
    """Return what a device of this software tells of itself; *release* is such as ``0.1.0``."""
    numbers = [int(part) if part.isdecimal() else 0 for part in release.split(".")]
    major, minor, build = (*numbers, 0, 0, 0)[:3]
    return AdsDeviceInfo(major & 0xFF, minor & 0xFF, build & 0xFFFF, device_name(name))


def _changes_objects(operation: Operation) -> bool:
    if isinstance(operation, ReadWrite):
        return operation.group == IndexGroup.SDO and bool(operation.data)
    return isinstance(operation, Write) and operation.group == IndexGroup.SDO
