"""Object dictionary of an EtherCAT master: slaves configured, slaves detected, and diagnosis.

Objects of slaves and lists are made on each access, for slaves come and go.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Protocol

from eap.device.eap_objects import DeviceIdentity
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdObject, OdState
from eap.od.profiles import master1100 as profile
from eap.od.profiles.master1100 import MasterLive
from eap.od.profiles.table import ProfileObject, live_source, make_object

_DETECT = 0xF002


class MasterValues(Protocol):
    """The running master; values are numbers, octets or texts, as the profile's types say."""

    def configured(self) -> Sequence[int]:
        """Return the station addresses of the configuration, in the order of the bus."""

    def detected(self) -> Sequence[int]:
        """Return those that the last scan has found."""

    def of_configured(self, station: int, key: MasterLive) -> Any:
        """Return what *key* stands for, of a configured slave."""

    def of_detected(self, station: int, key: MasterLive) -> Any:
        """Return what *key* stands for, of a slave that was found."""

    def of_diagnosis(self, station: int, key: MasterLive) -> Any:
        """Return what *key* stands for, of how a configured slave is."""

    def of_master(self, key: MasterLive) -> Any:
        """Return what *key* stands for, of the master itself."""

    def write_slave(self, station: int, key: MasterLive, value: int) -> None:
        """Do what a download asks for, or raise SdoAbortError."""

    def write_master(self, key: MasterLive, data: bytes) -> None:
        """Do what a download asks for, or raise SdoAbortError."""


class MasterDictionary(ObjectDictionary):
    """Dictionary of a master.

    Args:
        values: Where live entries get theirs.
        identity: What 0x1008 to 0x1018 show.
        full: Whether objects of slaves reach as far as any master's, or as far as TwinCAT's.
        padded: Whether in complete access an entry of an even size begins at an even octet.
    """

    # ETG.1510 clients ask for all there is, and take whatever stands behind the rights for a name.
    tells_values = False

    def __init__(
        self,
        values: MasterValues,
        identity: DeviceIdentity,
        *,
        full: bool = False,
        padded: bool = False,
    ) -> None:
        super().__init__()
        self._values = values
        self._full = full
        self._padded = padded
        for row in profile.FIXED:
            self.add(make_object(row, row.first, live_source(self._read), write=self._write))
        for (index, subindex), value in identity.entries().items():
            self[index].entries[subindex].value = value

    def __contains__(self, index: int) -> bool:
        return index in self._objects or index in self._moving()

    def __getitem__(self, index: int) -> OdObject:
        """Return the object at *index*; refuse with NO_OBJECT."""
        for row in (*profile.SLAVES, *profile.LISTS):
            if row.first <= index <= row.last:
                return self._make(row, index)
        return super().__getitem__(index)

    def __iter__(self) -> Iterator[OdObject]:
        """Yield the objects in the order of their indexes."""
        return (self[index] for index in sorted({*self._objects, *self._moving()}))

    def __len__(self) -> int:
        return len(self._objects) + len(self._moving())

    def upload_complete(self, index: int, first: int, state: OdState) -> bytes:
        """Return a whole object as :class:`ObjectDictionary` does, padded where that is wanted."""
        if index == _DETECT and not self._padded:
            raise SdoAbortError(AbortCode.PARAMETER, index, first, "no complete access, as TwinCAT")
        octets = super().upload_complete(index, first, state)
        return self._pad(self[index], octets, first) if self._padded else octets

    def _pad(self, item: OdObject, octets: bytes, first: int) -> bytes:
        """Put an octet in front of each entry of an even size that begins at an odd one."""
        start = 2 if first == 0 else 0
        padded = bytearray(octets[:start])
        for subindex, entry in item.entries.items():
            if not subindex:
                continue
            size = (entry.kind.bit_length + 7) // 8
            if len(padded) % 2 and size % 2 == 0:
                padded.append(0)
            padded += octets[start : start + size]
            start += size
        return bytes(padded)

    def _moving(self) -> set[int]:
        found: set[int] = set()
        for row in profile.SLAVES:
            found.update(range(row.first, row.first + len(self._stations(row))))
        for row in profile.LISTS:
            lists = max(1, -(-len(self._stations(row)) // profile.PER_LIST))
            found.update(range(row.first, row.first + lists))
        return found

    def _stations(self, row: ProfileObject) -> Sequence[int]:
        is_found = row in {profile.DETECTED, profile.DETECTED_LIST}
        stations = self._values.detected() if is_found else self._values.configured()
        return stations[: profile.MAX_SLAVES]

    def _make(self, row: ProfileObject, index: int) -> OdObject:
        stations, number = self._stations(row), index - row.first
        if row in profile.LISTS:
            return self._make_list(row, index, stations)
        if number >= len(stations):
            raise SdoAbortError(AbortCode.NO_OBJECT, index, 0)
        station = stations[number]
        extent = row.last_subindex if self._full else profile.USUAL_EXTENT[row.first]
        read = {
            profile.CONFIGURED.first: self._values.of_configured,
            profile.DETECTED.first: self._values.of_detected,
            profile.DIAGNOSIS.first: self._values.of_diagnosis,
        }[row.first]

        def write(key: str, data: bytes) -> None:
            self._values.write_slave(station, MasterLive(key), int.from_bytes(data, "little"))

        source = live_source(lambda key: read(station, MasterLive(key)))
        return make_object(row, index, source, write=write, extent=extent)

    def _make_list(self, row: ProfileObject, index: int, stations: Sequence[int]) -> OdObject:
        start = (index - row.first) * profile.PER_LIST
        part = stations[start : start + profile.PER_LIST]
        if start and not part:
            raise SdoAbortError(AbortCode.NO_OBJECT, index, 0)
        item = make_object(row, index, live_source(self._read), last=len(part))
        for subindex, station in enumerate(part, 1):
            item.entries[subindex].value = station
        return item

    def _read(self, key: str) -> Any:
        return self._values.of_master(MasterLive(key))

    def _write(self, key: str, data: bytes) -> None:
        self._values.write_master(MasterLive(key), data)
