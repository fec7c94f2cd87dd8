"""An object dictionary behind index groups, as slaves and EAP devices show theirs (ETG.1020, AoE).

The answers of object lists and descriptions are those of SDO information without its headers.
"""

from __future__ import annotations

from collections.abc import Callable, Collection

from eap.ads.request import AdsRefusedError
from eap.ads.space import AdsSpace, Source, fixed_size_source
from eap.codec.ads import AdsError, IndexGroup
from eap.od import info
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

_SDO = IndexGroup.SDO.value  # a plain number: members of enums are slow
_COMPLETE = 0x100
_RESULTS: dict[int, AdsError] = {
    AbortCode.NO_OBJECT: AdsError.NOT_FOUND,
    AbortCode.NO_SUBINDEX: AdsError.NOT_FOUND,
}


def slave_result(abort: SdoAbortError) -> AdsError:
    """Return a slave's ADS result for a refused SDO (as Beckhoff's stack code does)."""
    return _RESULTS.get(abort.code, AdsError.GENERAL)


class ObjectSpace(AdsSpace):
    """The objects of one dictionary.

    Args:
        dictionary: What is read and written.
        state: Says in which state the device is now.
        result_of: Returns the ADS result for a refused SDO.
    """

    groups: Collection[int] = frozenset(
        (
            IndexGroup.SDO,
            IndexGroup.OBJECT_LIST,
            IndexGroup.OBJECT_DESCRIPTION,
            IndexGroup.ENTRY_DESCRIPTION,
        )
    )

    def __init__(
        self,
        dictionary: ObjectDictionary,
        state: Callable[[], OdState],
        result_of: Callable[[SdoAbortError], AdsError] = slave_result,
    ) -> None:
        self._dictionary = dictionary
        self._state = state
        self._result_of = result_of

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return an entry, an object, a list or a description, whole or not at all."""
        try:
            octets = self._read(group, offset)
        except SdoAbortError as exc:
            raise AdsRefusedError(self._result_of(exc), str(exc)) from None
        if len(octets) > length:
            raise AdsRefusedError(AdsError.SIZE)
        return octets

    def write(self, group: int, offset: int, data: bytes) -> None:
        """Write an entry or an object."""
        if group != IndexGroup.SDO:
            raise AdsRefusedError(AdsError.INDEX_GROUP)
        index, low = offset >> 16, offset & 0xFFFF
        try:
            if _is_complete(low):
                self._dictionary.download_complete(index, 0, data, self._state())
            else:
                self._dictionary.download(index, low & 0xFF, data, self._state())
        except SdoAbortError as exc:
            raise AdsRefusedError(self._result_of(exc), str(exc)) from None

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Write *data*, if there is any, then read the same place."""
        if data:
            self.write(group, offset, data)
        return self.read(group, offset, length)

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return a source of an entry or an object; another length ends it."""
        if group != IndexGroup.SDO:
            raise AdsRefusedError(AdsError.ACCESS)
        return fixed_size_source(lambda: self.read(group, offset, length), length)

    def _read(self, group: int, offset: int) -> bytes:
        index, low = offset >> 16, offset & 0xFFFF
        subindex = low & 0xFF
        if group == _SDO:
            if _is_complete(low):
                return self._dictionary.upload_complete(index, 0, self._state())
            return self._dictionary.upload(index, subindex, self._state())
        if group == IndexGroup.OBJECT_LIST:
            return info.object_list(self._dictionary, index)
        if group == IndexGroup.OBJECT_DESCRIPTION:
            return info.object_description(self._dictionary, index)
        return info.entry_description(self._dictionary, index, subindex, low >> 8)


def _is_complete(low: int) -> bool:
    # Bits from 9 on, such as TwinCAT's long time-out, mean nothing to a dictionary.
    if low >> 9:
        raise AdsRefusedError(AdsError.INDEX_OFFSET)
    return bool(low & _COMPLETE)
