"""An object dictionary that can be told to refuse."""

from __future__ import annotations

from collections.abc import Iterable

from eap.od.abort import SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdObject, OdState


class FaultyDictionary(ObjectDictionary):
    """Refuses every access to the objects in *aborts* with the code beside them."""

    def __init__(self, objects: Iterable[OdObject] = ()) -> None:
        super().__init__(objects)
        self.aborts: dict[int, int] = {}

    def upload(self, index: int, subindex: int, state: OdState) -> bytes:
        """Return the octets of one entry."""
        self._check(index, subindex)
        return super().upload(index, subindex, state)

    def download(self, index: int, subindex: int, data: bytes, state: OdState) -> None:
        """Write the octets of one entry."""
        self._check(index, subindex)
        super().download(index, subindex, data, state)

    def upload_complete(self, index: int, first: int, state: OdState) -> bytes:
        """Return a whole object."""
        self._check(index, first)
        return super().upload_complete(index, first, state)

    def download_complete(self, index: int, first: int, data: bytes, state: OdState) -> None:
        """Write a whole object."""
        self._check(index, first)
        super().download_complete(index, first, data, state)

    def _check(self, index: int, subindex: int) -> None:
        if index in self.aborts:
            raise SdoAbortError(self.aborts[index], index, subindex, "a fault was asked for")
