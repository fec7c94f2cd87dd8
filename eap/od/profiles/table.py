"""The records of which a profile's table consists, and short ways to write them.

Every entry gets its content from one of four places, and its row says from which: it is *config*
(written in PreOp, kept), *fixed* (given at the start, read only), *live* (what the running device
is asked for under a key) or *derived* (computed from other entries of the dictionary).
"""

from __future__ import annotations

from enum import Enum
from typing import Any, NamedTuple

from eap.od.model import RO, RW_PREOP, Access, ObjectCode
from eap.od.profiles.forms import Form

CONFIG = RW_PREOP | Access.BACKUP
"""Rights of configuration: read always, written in PreOp, listed among what is to be saved."""

UNITS = {"": None, "us": 0xFA030000, "100 us": 0xFC030000, "ms": 0xFD030000}
"""Units of entry descriptions: exponent of ten, second as numerator (ETG.1004)."""

OWN_TYPE = ""
"""Type of an entry that holds a value of the variable that its object describes."""


class EntryRow(NamedTuple):
    """One sub-index, or a list of equal ones from *subindex* to *last*."""

    subindex: int
    name: str
    kind: str
    """Data type as ``eap.codec.datatypes.parse`` reads it, or OWN_TYPE."""
    access: Access
    description: str
    default: Any = None
    """Content of a new object; None is all zero."""
    minimum: int | None = None
    maximum: int | None = None
    unit: str = ""
    """Key of UNITS."""
    last: int = 0
    """Last sub-index of a list; 0 for a single entry."""
    live: str = ""
    """What the device is asked for, with the object's name."""
    derived: str = ""
    """What the dictionary computes."""
    form: Form = Form.PLAIN
    """How people read and write it."""
    changeable: bool = False
    """Whether it can be written in SafeOp and Op too once its object says so."""

    def numbered(self, subindex: int) -> str:
        """Return the name of the entry at *subindex*."""
        return self.name.format(n=subindex - self.subindex) if self.last else self.name


class ObjectRange(NamedTuple):
    """Objects of one kind: one object, or as many as were made from *first* to *last*.

    *name* holds ``{n}`` where the number of the object within its range goes.
    """

    first: int
    last: int
    name: str
    code: ObjectCode
    entries: tuple[EntryRow, ...]
    description: str
    dynamic: bool = False
    """Whether a download to a free index makes an object and 0 in sub-index 0 deletes it."""
    mapping: bool = False
    """Whether it lists the variables of a PDO."""
    companion: int = 0
    """First index of the range whose objects come and go with these."""

    @property
    def list_row(self) -> EntryRow | None:
        """The row of the list at the object's end, None if there is none."""
        row = self.entries[-1]
        return row if row.last else None

    @property
    def fixed_count(self) -> int:
        """Highest sub-index in front of the list."""
        row = self.entries[-1]
        return row.subindex - 1 if row.last else row.subindex

    @property
    def last_subindex(self) -> int:
        """Highest sub-index of an object that is as long as it can be."""
        row = self.entries[-1]
        return row.last or row.subindex

    def row(self, subindex: int) -> EntryRow | None:
        """Return the row of a sub-index, None if no object of this kind has it."""
        for row in self.entries:
            if row.subindex == subindex or row.subindex <= subindex <= row.last:
                return row
        return None

    def title(self, index: int) -> str:
        """Return the name of the object at *index*."""
        return self.name.format(n=index - self.first)


def config(subindex: int, name: str, kind: str, description: str, **more: Any) -> EntryRow:
    """Write a row of configuration; *more* as :class:`EntryRow` has it."""
    return EntryRow(subindex, name, kind, CONFIG, description, **more)


def fixed(subindex: int, name: str, kind: str, description: str, **more: Any) -> EntryRow:
    """Write a row that is given at the start."""
    return EntryRow(subindex, name, kind, RO, description, **more)


def live(subindex: int, name: str, kind: str, key: Enum, description: str, **more: Any) -> EntryRow:
    """Write a row that shows what *key* stands for while the device runs."""
    return EntryRow(subindex, name, kind, RO, description, live=key.value, **more)


def derived(
    subindex: int, name: str, kind: str, key: Enum, description: str, **more: Any
) -> EntryRow:
    """Write a row that is computed from other entries."""
    return EntryRow(subindex, name, kind, RO, description, derived=key.value, **more)
