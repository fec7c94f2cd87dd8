"""Objects of an EAP port made from the rows of its profile, and entries that change their form.

Nothing in here asks who may write what; that is decided in ``eap_dictionary``.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, WO, Entry, ObjectCode, OdObject
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000keys import Frame, Rx, Tx, Var
from eap.od.profiles.table import CONFIG, OWN_TYPE, UNITS, EntryRow, ObjectRange

DEFAULT_TYPE = datatypes.parse("UINT")
NAME_AT = {
    0x6: (0x6000, Var.NAME),
    0x7: (0x7000, Var.NAME),
    0x8: (0x8000, Frame.NAME),
    0xA: (0x8000, Frame.NAME),
    0xB: (0xD000, Tx.NAME),
    0xC: (0xE000, Rx.NAME),
    0xD: (0xD000, Tx.NAME),
    0xE: (0xE000, Rx.NAME),
}
"""By the high digit of an index: where the name of what it is about stands."""
_STEMS = {0x6: "tx-variable", 0x7: "rx-variable", 0x8: "frame", 0xD: "txpd", 0xE: "rxpd"}
"""What new objects are called, with their number."""
_CHANGEABLE = {
    profile.TX_FRAME.first: Frame.CHANGEABLE,
    profile.TX_PD.first: Tx.CHANGEABLE,
    profile.RX_PD.first: Rx.CHANGEABLE,
}
"""Which entry says that those that the profile calls changeable may be written in Op."""


class Views(NamedTuple):
    """What entries show that is not stored in them."""

    live: Callable[[int, str, int], bytes]
    """Called with the index of the object, the key of the entry and its size in octets."""
    derived: Callable[[int, int], bytes]
    """Called with index and sub-index."""


class EapObjects(ObjectDictionary):
    """The objects of an EAP port, by index and by kind.

    Args:
        publisher: NetID of the port.
        views: Where entries get their values that store none.
    """

    def __init__(self, publisher: bytes, views: Views) -> None:
        self._views = views
        self._members: dict[int, dict[int, OdObject]] = {row.first: {} for row in profile.ALL}
        self._publisher = publisher
        super().__init__()
        for row in profile.STATIC:
            self.add(self.make_object(row, row.first))

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

    def members(self, *rows: ObjectRange) -> list[int]:
        """Return the indexes of the objects that *rows* describe, in order."""
        return [index for row in rows for index in sorted(self._members[row.first])]

    def make(self, row: ObjectRange, index: int) -> OdObject:
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
            item.entries[Tx.PUBLISHER].octets = self._publisher
        return item

    def make_object(
        self, row: ObjectRange, index: int, kind: DataType = DEFAULT_TYPE, last: int = 0
    ) -> OdObject:
        """Return an object with its defaults; not added yet.

        Args:
            row: What the profile says of it.
            index: Where it is to be.
            kind: A variable's type.
            last: The last sub-index of its list; 0 leaves the list empty.
        """
        entries = {
            each.subindex: self._make_entry(each, index, each.subindex, kind)
            for each in row.entries
            if not each.last
        }
        if row.code is not ObjectCode.VAR:
            access = CONFIG if row.dynamic or row.list_row else RO
            entries[0] = Entry("SubIndex 000", "USINT", access, max(row.fixed_count, last))
        if row.list_row is not None:
            for subindex in range(row.list_row.subindex, last + 1):
                entries[subindex] = self._make_entry(row.list_row, index, subindex, kind)
        is_array = row.code is ObjectCode.ARRAY
        code = datatypes.parse(row.entries[-1].kind).code if is_array else None
        return OdObject(index, row.title(index), row.code, entries, data_type=code)

    def _make_entry(self, row: EntryRow, index: int, subindex: int, kind: DataType) -> Entry:
        own = kind if row.kind == OWN_TYPE else datatypes.parse(row.kind)
        read = None
        if row.live:
            read = partial(self._views.live, index, row.live, own.size)
        elif row.derived:
            read = partial(self._views.derived, index, subindex)
        return Entry(
            row.numbered(subindex), own, row.access, row.default, read=read,
            unit=UNITS[row.unit], minimum=row.minimum, maximum=row.maximum,
        )  # fmt: skip

    def grow(self, index: int, last: int) -> None:
        """Give the list of the object at *index* entries up to *last*, not counted yet."""
        item, row = self[index], profile.row_of(index)
        list_row = row.list_row
        if list_row is not None:
            for subindex in range(max(max(item.entries) + 1, list_row.subindex), last + 1):
                item.entries[subindex] = self._make_entry(list_row, index, subindex, DEFAULT_TYPE)

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

    def _retype(self, item: OdObject, row: ObjectRange, kind: DataType) -> None:
        """Give a variable another type; its default is forgotten."""
        if item.entries[Var.DEFAULT].kind == kind:
            return
        for each in row.entries:
            if each.kind == OWN_TYPE:
                entry = self._make_entry(each, item.index, each.subindex, kind)
                item.entries[each.subindex] = entry
        item.entries[Var.DEFAULT_GIVEN].value = False
