"""ADS on the side of a slave: which requests are for it (ETG.1020, AoE).

A master tells a slave its address first, by writing a NetID; a slave that was never told takes the
one of the first request for its own.
"""

from __future__ import annotations

from collections.abc import Callable

from eap.ads.answer import AmsAnswer
from eap.ads.device import AdsDevice
from eap.ads.endpoint import Endpoint
from eap.ads.notifications import Client
from eap.ads.objects import ObjectSpace
from eap.codec.ads import (
    AdsDeviceInfo,
    AdsError,
    AdsRange,
    AdsState,
    AdsStates,
    IndexGroup,
    device_name,
    encode_result,
)
from eap.codec.ams import AmsCommand, AmsHeader
from eap.ids import NetId
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

_NET_ID_OFFSET = 3
_NET_ID_SIZE = 6
_SERVICES = frozenset((AmsCommand.READ_DEVICE_INFO, AmsCommand.READ_STATE, AmsCommand.READ,
                       AmsCommand.WRITE, AmsCommand.READ_WRITE))  # fmt: skip
_MASTER = Client(Endpoint("", ""), NetId(bytes(_NET_ID_SIZE)), 0)
"""Without notifications nothing belongs to a client."""


class AdsServer:
    """The services of one slave, its dictionary without notifications; the handler of an AoeServer.

    Args:
        dictionary: What is read and written.
        state: Says in which state the slave is now.
        name: Of the device; 15 octets of it are told.

    Attributes:
        address: NetID and port of the slave; None until a request has told them.
    """

    def __init__(
        self, dictionary: ObjectDictionary, state: Callable[[], OdState], name: str
    ) -> None:
        self.address: tuple[NetId, int] | None = None
        self._device = AdsDevice(
            AdsDeviceInfo(1, 0, 0, device_name(name)),
            lambda: AdsStates(AdsState.RUN, 0),
            [ObjectSpace(dictionary, state)],
        )

    def forget(self) -> None:
        """Take any address next: the mailbox starts again."""
        self.address = None

    def __call__(self, header: AmsHeader, data: bytes) -> AmsAnswer:
        """Answer one request."""
        if header.command == AmsCommand.WRITE and self._take_address(header, data):
            return AmsAnswer(encode_result(AdsError.NONE))
        if self.address is None:
            self.address = header.target, header.target_port
        if header.target != self.address[0]:
            return AmsAnswer(error_code=AdsError.TARGET_MACHINE)
        if header.target_port != self.address[1]:
            return AmsAnswer(error_code=AdsError.TARGET_PORT)
        if header.command not in _SERVICES:
            return AmsAnswer(error_code=AdsError.SERVICE)
        return self._device.answer(header.command, data, _MASTER, 0)

    def _take_address(self, header: AmsHeader, data: bytes) -> bool:
        if len(data) < AdsRange.SIZE + _NET_ID_SIZE:
            return False
        asked = AdsRange.decode(data)
        place = IndexGroup.ADDRESS, _NET_ID_OFFSET, _NET_ID_SIZE
        if (asked.group, asked.offset, asked.length) != place:
            return False
        octets = data[AdsRange.SIZE : AdsRange.SIZE + _NET_ID_SIZE]
        if not any(octets[:4]):
            octets = bytes(header.target)[:4] + octets[4:]
        self.address = NetId(octets), header.target_port
        return True
