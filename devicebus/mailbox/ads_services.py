"""ADS services of whoever has an object dictionary: by index group and offset (ETG.1020, AoE)."""

from __future__ import annotations

from collections.abc import Callable

from eap.aoe.ads_device import AdsDevice
from eap.aoe.ads_notifications import Client
from eap.aoe.ads_objects import ObjectSpace
from eap.aoe.answer import AmsAnswer
from eap.aoe.way import Way
from eap.codec.ads import AdsDeviceInfo, AdsError, AdsState, AdsStates, device_name
from eap.codec.ams import AmsCommand
from eap.ids import NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

_SERVICES = frozenset((AmsCommand.READ_DEVICE_INFO, AmsCommand.READ_STATE, AmsCommand.READ,
                       AmsCommand.WRITE, AmsCommand.READ_WRITE))  # fmt: skip
_ANYBODY = Client(Way("", ""), NetId(bytes(6)), 0)
"""Without notifications nothing belongs to a client."""


class AdsServices:
    """What can be asked of one dictionary, without notifications.

    Args:
        dictionary: What is read and written.
        state: Says in which state the device is now.
        name: Of the device; 15 octets of it are told.
    """

    def __init__(
        self, dictionary: ObjectDictionary, state: Callable[[], OdState], name: str
    ) -> None:
        self._device = AdsDevice(
            AdsDeviceInfo(1, 0, 0, device_name(name)),
            lambda: AdsStates(AdsState.RUN, 0),
            [ObjectSpace(dictionary, state)],
        )

    def answer(self, command: int, data: bytes) -> AmsAnswer:
        """Do what *command* asks for with the *data* behind its header."""
        if command not in _SERVICES:
            return AmsAnswer(error_code=AdsError.SERVICE)
        return self._device.answer(command, data, _ANYBODY, 0)
