"""Changes to the dictionaries of a station as a transaction: tried on copies, then taken or not.

Rule 1: the copies can be written in any state of the device.
Rule 2: they are checked whole before they are taken; until then nothing changes.
Rule 3: afterwards the transaction is over.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from eap.device.difference import Change, compare
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_read import read_back
from eap.device.stored import configuration, copy, restore
from eap.errors import LocalProtocolError
from eap.od.model import OdState
from eap.pd.spec import StationSpec


class Staged:
    """Copies of the dictionaries of a station, to be committed or dropped.

    Args:
        station: What the copies are checked with: its ports, buses, sources and links.
        dictionaries: Those in force, by name of the port.

    Attributes:
        dictionaries: The copies.
    """

    def __init__(self, station: StationSpec, dictionaries: Mapping[str, EapDictionary]) -> None:
        self._station = station
        self._originals: dict[str, EapDictionary] | None = dict(dictionaries)
        self.dictionaries = {name: copy(each) for name, each in dictionaries.items()}

    def download(self, port: str, index: int, subindex: int, data: bytes) -> None:
        """Write one entry of a copy; raise SdoAbortError if it is refused."""
        self.dictionaries[port].download(index, subindex, data, OdState.PREOP)

    def write(self, port: str, changes: Iterable[Change]) -> None:
        """Write what :func:`compare` found; raise SdoAbortError at the first that is refused."""
        for change in changes:
            self.download(port, change.index, change.subindex, change.data)

    def changes(self) -> dict[str, list[Change]]:
        """Return what differs from what is in force, by port."""
        originals = self._open()
        return {name: compare(originals[name], each) for name, each in self.dictionaries.items()}

    def check(self) -> StationSpec:
        """Return what would run; raise DeviceFault if it cannot."""
        return read_back(self._station, self.dictionaries)

    def commit(self) -> StationSpec:
        """Put the copies in force and return what is to run; raise DeviceFault and do nothing."""
        originals = self._open()
        spec = self.check()
        for name, each in self.dictionaries.items():
            restore(originals[name], configuration(each))
        self._originals = None
        return spec

    def drop(self) -> None:
        """Forget the copies."""
        self._originals = None

    def _open(self) -> dict[str, EapDictionary]:
        if self._originals is None:
            raise LocalProtocolError("the change is over: it was committed or dropped")
        return self._originals
