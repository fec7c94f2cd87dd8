"""VoE of a slave behind an index group: messages with their VoE headers.

Ads.h of the TwinCAT SDK names the group, and that a Write is a message to the mailbox; ReadWrite
for one that is answered is our own.
"""

from __future__ import annotations

from collections.abc import Collection

from devicebus.mailbox import voe_client
from devicebus.wire.sii import SiiProtocol
from eap.aoe.ads_operation import AdsRefusedError
from eap.appliance.services.bus_ads.slave_space import Asked, SlaveSpace
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.voe import VoeHeader
from eap.errors import TruncatedError


class SlaveVendor(SlaveSpace):
    """Messages of a vendor's own protocol."""

    groups: Collection[int] = frozenset((IndexGroup.VOE,))
    protocol = SiiProtocol.VOE

    async def write(self, asked: Asked, group: int, offset: int, data: bytes) -> None:
        """Send a message that is not answered."""
        del group, offset
        head = _head(data)
        message = voe_client.send(head.vendor_id, head.vendor_type, data[VoeHeader.SIZE :])
        await self.converse(asked, message)

    async def read_write(
        self, asked: Asked, group: int, offset: int, length: int, data: bytes
    ) -> bytes:
        """Send a message and return the one that answers it, both with their headers."""
        del group, offset, length
        head = _head(data)
        message = voe_client.exchange(head.vendor_id, head.vendor_type, data[VoeHeader.SIZE :])
        return head.encode() + await self.converse(asked, message)


def _head(data: bytes) -> VoeHeader:
    try:
        return VoeHeader.decode(data)
    except TruncatedError as exc:
        raise AdsRefusedError(AdsError.SIZE, str(exc)) from None
