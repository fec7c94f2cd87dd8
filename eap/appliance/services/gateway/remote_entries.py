"""The entries of a slave elsewhere, for the SDO server of a session: read before, written after."""

from __future__ import annotations

import msgspec

from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState


class Written(msgspec.Struct, frozen=True):
    """What a download brought, from a client that waits for its answer."""

    index: int
    subindex: int
    data: bytes
    complete: bool = False


class RemoteEntries(ObjectDictionary):
    """Has what was read of one entry, and takes what is to be written.

    Attributes:
        octets: What the next upload gives.
        written: The last download, to be passed on; None if there is none.
    """

    def __init__(self) -> None:
        super().__init__()
        self.octets = b""
        self.written: Written | None = None

    def upload(self, index: int, subindex: int, state: OdState) -> bytes:
        """Return what was read."""
        del index, subindex, state
        return self.octets

    def upload_complete(self, index: int, first: int, state: OdState) -> bytes:
        """Return what was read; by ADS an object comes from subindex 0 on, 16 bits wide."""
        del index, state
        return self.octets[2:] if first else self.octets

    def check_download(
        self, index: int, subindex: int, size: int, state: OdState, *, complete: bool = False
    ) -> None:
        """Refuse nothing that the slave itself may take."""
        del size, state
        if complete and subindex:
            detail = "elsewhere an object is written from subindex 0 on"
            raise SdoAbortError(AbortCode.NO_COMPLETE_ACCESS, index, subindex, detail)

    def download(self, index: int, subindex: int, data: bytes, state: OdState) -> None:
        """Keep what is to be written."""
        del state
        self.written = Written(index, subindex, data)

    def download_complete(self, index: int, first: int, data: bytes, state: OdState) -> None:
        """Keep what is to be written."""
        del state
        self.written = Written(index, first, data, complete=True)
