"""The object dictionary of a slave behind index groups, by CoE (ETG.1020, AoE)."""

from __future__ import annotations

from collections.abc import Collection

from devicebus.mailbox import coe_client, coeinfo_client
from devicebus.wire.sii import SiiProtocol
from eap.aoe.ads_operation import AdsRefusedError
from eap.appliance.services.bus_ads.slave_space import Asked, SlaveSpace
from eap.codec.ads import AdsError, IndexGroup, SdoPlace


class SlaveObjects(SlaveSpace):
    """Entries, whole objects, and what SDO information says of them."""

    groups: Collection[int] = frozenset(
        (
            IndexGroup.SDO,
            IndexGroup.OBJECT_LIST,
            IndexGroup.OBJECT_DESCRIPTION,
            IndexGroup.ENTRY_DESCRIPTION,
        )
    )
    protocol = SiiProtocol.COE

    async def read(self, asked: Asked, group: int, offset: int, length: int) -> bytes:
        """Return an entry, an object, a list or a description."""
        del length
        index, low = offset >> 16, offset & 0xFFFF
        match group:
            case IndexGroup.SDO:
                place = _place(offset)
                return await self.converse(
                    asked,
                    coe_client.upload(index, place.subindex, complete=bool(place.is_complete)),
                )
            case IndexGroup.OBJECT_LIST:
                return await self.converse(asked, coeinfo_client.read_list(index))
            case IndexGroup.OBJECT_DESCRIPTION:
                return await self.converse(asked, coeinfo_client.read_object(index))
        asked_for = coeinfo_client.read_entry(index, low & 0xFF, low >> 8)
        return await self.converse(asked, asked_for)

    async def write(self, asked: Asked, group: int, offset: int, data: bytes) -> None:
        """Write an entry or an object."""
        if group != IndexGroup.SDO:
            raise AdsRefusedError(AdsError.INDEX_GROUP)
        place = _place(offset)
        await self.converse(
            asked,
            coe_client.download(
                place.index, place.subindex, data, asked.sizes, complete=bool(place.is_complete)
            ),
        )


def _place(offset: int) -> SdoPlace:
    """Take the offset apart; the subindex means nothing with complete access."""
    place = SdoPlace.decode(offset.to_bytes(4, "little"))
    if place.reserved:
        raise AdsRefusedError(AdsError.INDEX_OFFSET)
    if place.is_complete:
        return SdoPlace(0, 1, index=place.index)
    return place
