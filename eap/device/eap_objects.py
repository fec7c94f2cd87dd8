"""Objects of an EAP port: what it is and does, names, references, and what is computed from them.

Rights of access are no concern of this module; ``eap_dictionary`` decides who may write.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import NamedTuple, Protocol

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.codec.pd import FIRST_PD, PdHeader
from eap.device.eap_rules import MappingEntry, mapped_bits
from eap.ids import InterfaceUri, NetId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import WO, OdObject, ReadHook
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import Configured, FrameSub, PortSub, Rx, Tx, Var
from eap.od.profiles.table import (
    DEFAULT_TYPE,
    OWN_TYPE,
    ProfileEntry,
    ProfileObject,
    make_entry,
    make_object,
)
from eap.pd.spec import PortSpec, StationSpec

TRANSPORTS = ("udp", "ethernet", "tcp", "loop")
"""By the number that 0xF810:02 shows."""
NAME_AT = {
    0x6: (0x6000, Var.NAME),
    0x7: (0x7000, Var.NAME),
    0x8: (0x8000, FrameSub.NAME),
    0xA: (0x8000, FrameSub.NAME),
    0xB: (0xD000, Tx.NAME),
    0xC: (0xE000, Rx.NAME),
    0xD: (0xD000, Tx.NAME),
    0xE: (0xE000, Rx.NAME),
}
"""By the high digit of an index: where the name of what it is about stands."""
_STEMS = {0x6: "tx-variable", 0x7: "rx-variable", 0x8: "frame", 0xD: "txpd", 0xE: "rxpd"}
"""Names of new objects, without their number."""
_CHANGEABLE = {
    profile.TX_FRAME.first: FrameSub.CHANGEABLE,
    profile.TX_PD.first: Tx.CHANGEABLE,
    profile.RX_PD.first: Rx.CHANGEABLE,
}
"""Entry that allows writing in Op those entries that the profile calls changeable."""


class LiveValues(Protocol):
    """The process image of a station, or nothing while there is none."""

    def octets(self, key: str, name: str) -> bytes | None:
        """Return what *key* (of the profile's live entries) shows of the object called *name*.

        None, or octets of another length than the entry has, reads as zero: the object is not yet,
        or no longer, part of what runs.
        """

    def at_one_moment(self) -> AbstractContextManager[None]:
        """Show counters of one moment for the length of a block."""


class NothingRuns:
    """The live values of a device whose engine does not run."""

    def octets(self, key: str, name: str) -> bytes | None:
        """Return None for everything."""
        return None

    def at_one_moment(self) -> AbstractContextManager[None]:
        """Do nothing."""
        return nullcontext()


class DeviceIdentity(NamedTuple):
    """Identity of a device."""

    module_profile: int = profile.MODULE_PROFILE
    device_name: str = "EAP appliance"
    hardware_version: str = ""
    software_version: str = ""
    vendor: int = 0
    product: int = 0
    revision: int = 0
    serial: int = 0

    def entries(self) -> dict[tuple[int, int], str | int]:
        """Return what devices of any profile show: values by index and subindex."""
        return {
            (0x1008, 0): self.device_name,
            (0x1009, 0): self.hardware_version,
            (0x100A, 0): self.software_version,
            (0x1018, 1): self.vendor,
            (0x1018, 2): self.product,
            (0x1018, 3): self.revision,
            (0x1018, 4): self.serial,
        }


class EapObjects(ObjectDictionary):
    """The objects of one EAP port of a station.

    Args:
        station: The station as it was started: its port is taken from it, nothing else is.
        port: Name of the port.
        live: Where live entries get their values.
        identity: What 0x1000 to 0x1018 show.
    """

    def __init__(
        self,
        station: StationSpec,
        port: str,
        live: LiveValues | None = None,
        identity: DeviceIdentity = DeviceIdentity(),  # noqa: B008  immutable
    ) -> None:
        super().__init__()
        self.station = station
        self.port: PortSpec = next(each for each in station.ports if each.name == port)
        self.uri = InterfaceUri.parse(self.port.interface)
        self.live: LiveValues = live or NothingRuns()
        self.identity = identity
        self._net_id = NetId.parse(self.port.net_id)
        self._members: dict[int, dict[int, OdObject]] = {row.first: {} for row in profile.ALL}
        for row in profile.STATIC:
            self.add(self.make_object(row, row.first))
        self._set_fixed()

    def _set_fixed(self) -> None:
        identity, uri = self.identity, self.uri
        fixed = {
            (0x1000, 0): identity.module_profile << 16 | (self.port.profile or profile.PROFILE),
            **identity.entries(),
            (profile.PORT, PortSub.NAME): self.port.name,
            (profile.PORT, PortSub.TRANSPORT): TRANSPORTS.index(uri.scheme),
            (profile.PORT, PortSub.INTERFACE): self.port.interface,
            (profile.PORT, PortSub.PORT_NUMBER): uri.port,
            (profile.NET_ID, 1): self._net_id,
        }
        for (index, subindex), value in fixed.items():
            self[index].entries[subindex].value = value

    def add(self, item: OdObject) -> None:
        """Add an object of the profile."""
        row = profile.find(item.index)
        if row is None:
            raise SdoAbortError(AbortCode.NO_OBJECT, item.index, 0, "the profile has none there")
        super().add(item)
        self._members[row.first][item.index] = item

    def remove(self, index: int) -> None:
        """Remove an object, and the one that shows what became of it."""
        super().remove(index)
        row = profile.find(index)
        if row is not None:
            self._members[row.first].pop(index, None)
            if row.companion:
                self.remove(index - row.first + row.companion)

    def members(self, *rows: ProfileObject) -> list[int]:
        """Return the indexes of the objects that *rows* describe, in order."""
        return [index for row in rows for index in sorted(self._members[row.first])]

    def make(self, row: ProfileObject, index: int) -> OdObject:
        """Add an object of a dynamic range, and the one that shows what becomes of it."""
        item = self.make_object(row, index)
        self.add(item)
        number = index - row.first
        companion = profile.find(row.companion) if row.companion else None
        if companion is not None:
            self.add(self.make_object(companion, companion.first + number))
        if not row.mapping:
            item.entries[NAME_AT[index >> 12][1]].value = f"{_STEMS[index >> 12]}{number}"
        if row is profile.TX_PD:
            item.entries[Tx.PUBLISHER].octets = self._net_id
        return item

    def make_object(
        self, row: ProfileObject, index: int, kind: DataType = DEFAULT_TYPE, last: int = 0
    ) -> OdObject:
        """Return an object with its defaults, not added yet; arguments as for ``make_object``."""
        return make_object(row, index, partial(self._source, index), kind=kind, last=last)

    def _source(
        self, index: int, row: ProfileEntry, subindex: int, kind: DataType
    ) -> ReadHook | None:
        if row.live:
            return partial(self._live, index, row.live, kind.size)
        return partial(self._derived, index, subindex) if row.derived else None

    def grow(self, index: int, last: int) -> None:
        """Give the list of the object at *index* entries up to *last*, not counted yet."""
        item, row = self[index], profile.row_of(index)
        list_row, source = row.list_row, partial(self._source, index)
        if list_row is not None:
            for subindex in range(max(max(item.entries) + 1, list_row.subindex), last + 1):
                item.entries[subindex] = make_entry(list_row, subindex, source)

    def resize(self, index: int, count: int) -> None:
        """Give the object at *index* as many entries as sub-index 0 = *count* says."""
        item = self[index]
        self.grow(index, count)
        for subindex in [sub for sub in item.entries if sub > count]:
            del item.entries[subindex]
        item.entries[0].value = count

    def put(self, index: int, subindex: int, octets: bytes) -> None:
        """Store the octets of an entry and what follows: a variable's type, rights of access."""
        item, row = self[index], profile.row_of(index)
        if row in profile.VARIABLES and subindex == Var.TYPE_NAME:
            self._retype(item, row, datatypes.parse(octets.decode()))
        item.entries[subindex].octets = octets
        if subindex == _CHANGEABLE.get(row.first):
            for each in row.entries:
                if each.changeable:
                    more = WO if any(octets) else each.access
                    item.entries[each.subindex].access = each.access | more

    def _retype(self, item: OdObject, row: ProfileObject, kind: DataType) -> None:
        """Give a variable another type; its default is forgotten."""
        if item.entries[Var.DEFAULT].kind == kind:
            return
        source = partial(self._source, item.index)
        for each in row.entries:
            if each.kind == OWN_TYPE:
                item.entries[each.subindex] = make_entry(each, each.subindex, source, kind=kind)
        item.entries[Var.DEFAULT_GIVEN].value = False

    def name_of(self, index: int) -> str:
        """Return the name of what the object at *index* is about, empty for the device itself."""
        where = NAME_AT.get(index >> 12)
        if where is None:
            return ""
        return self._objects[where[0] | index & 0xFFF].entries[where[1]].octets.decode()

    def pdo_length(self, pd_index: int) -> int:
        """Return the octets of data of a PD; 0 as long as it has no whole PDO."""
        mapping = self._objects.get(self[pd_index].entries[Tx.PDO_INDEX].value)
        return 0 if mapping is None else -(-mapped_bits(self, mapping) // 8)

    def frame_length(self, index: int) -> int:
        """Return the octets of the frame at *index* with all PDs that it lists and that exist."""
        listed = [pd for _, pd in self.listed_pds(index) if pd in self]
        return FIRST_PD + sum(PdHeader.SIZE + self.pdo_length(pd) for pd in listed)

    def listed_pds(self, index: int) -> Iterator[tuple[int, int]]:
        """Yield sub-index and TxPD of the list of the frame at *index*, without its blanks."""
        for subindex, entry in self[index].entries.items():
            if subindex >= FrameSub.TXPD and (pd := int.from_bytes(entry.octets, "little")):
                yield subindex, pd

    def next_free(self, rows: tuple[ProfileObject, ...]) -> int:
        """Return the first index of *rows* that is free, 0 if none is."""
        for row in rows:
            taken = self._members[row.first]
            for index in range(row.first, row.last + 1):
                if index not in taken:
                    return index
        return 0

    def user_of(self, index: int) -> tuple[int, int] | None:
        """Return the entry (object, sub-index) that refers to the object at *index*, if any."""
        row = profile.row_of(index)
        if row in profile.VARIABLES:
            return next(self._mappings_of(index), None)
        if row is profile.TX_PD:
            for frame in self._members[profile.TX_FRAME.first]:
                for subindex, pd in self.listed_pds(frame):
                    if pd == index:
                        return frame, subindex
            return self._poll_of(index, profile.RX_PD, Rx.POLL_REQUEST_TXPD)
        if row is profile.RX_PD:
            return self._poll_of(index, profile.TX_PD, Tx.POLL_REQUEST_RXPD)
        return None

    def _mappings_of(self, index: int) -> Iterator[tuple[int, int]]:
        for row in profile.MAPPINGS:
            for item in self._members[row.first].values():
                for subindex, entry in item.entries.items():
                    if subindex and MappingEntry.decode(entry.value).target == index:
                        yield item.index, subindex

    def _poll_of(self, index: int, row: ProfileObject, subindex: int) -> tuple[int, int] | None:
        for item in self._members[row.first].values():
            if item.entries[subindex].value == index:
                return item.index, subindex
        return None

    def at_one_moment(self) -> AbstractContextManager[None]:
        """Show live counters of one moment for the length of a block."""
        return self.live.at_one_moment()

    def _live(self, index: int, key: str, size: int) -> bytes:
        """Return what *key* shows of what the object is about; zero if that does not run."""
        octets = self.live.octets(key, self.name_of(index))
        return octets if octets is not None and len(octets) == size else bytes(size)

    def _derived(self, index: int, subindex: int) -> bytes:
        """Return a length, a count, a type or a free index."""
        entry = self[index].entries[subindex]
        return entry.kind.encode(self._compute(profile.row_of(index), index, subindex))

    def _compute(self, row: ProfileObject, index: int, subindex: int) -> int:
        if row is profile.TX_FRAME:
            return self.frame_length(index)
        if row in {profile.TX_PD, profile.RX_PD}:
            return self.pdo_length(index)
        if index in {profile.OBJECT_COUNTS, profile.FREE_INDEXES}:
            rows = profile.COUNTED[subindex - Configured.TXFRAMES]
            is_count = index == profile.OBJECT_COUNTS
            return len(self.members(*rows)) if is_count else self.next_free(rows)
        kind = self[index].entries[Var.DEFAULT].kind
        return kind.bit_length if subindex == Var.BIT_LENGTH else kind.code
