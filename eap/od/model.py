"""Objects and entries of a dictionary.

An entry either stores its bytes or shows the bytes of another source (*read*); a hook (*write*)
may check and act on a download before it is stored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from enum import Enum, IntEnum, IntFlag
from typing import Any, TypeAlias

from eap.codec import datatypes
from eap.codec.datatypes import DataType

ReadHook: TypeAlias = Callable[[], bytes]
WriteHook: TypeAlias = Callable[[bytes], None]
"""Called with the bytes before they are stored; raises SdoAbortError to refuse them."""


class ObjectCode(IntEnum):
    """ETG.1000.6, object code definitions."""

    DOMAIN = 2
    DEFTYPE = 5
    DEFSTRUCT = 6
    VAR = 7
    ARRAY = 8
    RECORD = 9


class Access(IntFlag):
    """Object access of an entry description (ETG.1000.6)."""

    READ_PREOP = 0x0001
    READ_SAFEOP = 0x0002
    READ_OP = 0x0004
    WRITE_PREOP = 0x0008
    WRITE_SAFEOP = 0x0010
    WRITE_OP = 0x0020
    RX_MAPPABLE = 0x0040
    TX_MAPPABLE = 0x0080
    BACKUP = 0x0100
    SETTINGS = 0x0200
    READ_ANY = READ_PREOP | READ_SAFEOP | READ_OP
    WRITE_ANY = WRITE_PREOP | WRITE_SAFEOP | WRITE_OP


RO = Access.READ_ANY
WO = Access.WRITE_ANY
RW = RO | WO
RW_PREOP = RO | Access.WRITE_PREOP
"""Read always, written in PreOp only: configuration."""


class OdState(Enum):
    """The states in which a dictionary can be reached, and the rights that count in each."""

    PREOP = (Access.READ_PREOP, Access.WRITE_PREOP)
    SAFEOP = (Access.READ_SAFEOP, Access.WRITE_SAFEOP)
    OP = (Access.READ_OP, Access.WRITE_OP)

    def __init__(self, read_right: Access, write_right: Access) -> None:
        self.read_right = read_right
        self.write_right = write_right


class Entry:
    """One subindex of an object.

    Args:
        name: As SDO information gives it.
        kind: Its data type.
        access: Rights per state and flags.
        value: What it starts with, and its default; None is all zero.
        read: Where the bytes come from instead of being stored.
        write: What a download must pass first.
        unit, minimum, maximum: For SDO information; the limits are checked too.
    """

    __slots__ = ("_octets", "access", "default", "kind", "maximum", "minimum", "name", "read",
                 "unit", "write")  # fmt: skip

    def __init__(
        self,
        name: str,
        kind: DataType | str,
        access: Access = RO,
        value: Any = None,
        *,
        read: ReadHook | None = None,
        write: WriteHook | None = None,
        unit: int | None = None,
        minimum: float | None = None,
        maximum: float | None = None,
    ) -> None:
        self.name = name
        self.kind = datatypes.parse(kind) if isinstance(kind, str) else kind
        self.access = access
        self.default = bytes(self.kind.size) if value is None else self.kind.encode(value)
        if self.is_text:
            self.default = self.default.rstrip(b"\0")
        self.read = read
        self.write = write
        self.unit = unit
        self.minimum = minimum
        self.maximum = maximum
        self._octets = self.default

    @property
    def is_text(self) -> bool:
        """True if it may be shorter than its type (VISIBLE_STRING)."""
        return self.kind.is_text

    @property
    def octets(self) -> bytes:
        """The value as it is transferred."""
        return self._octets if self.read is None else self.read()

    @octets.setter
    def octets(self, octets: bytes) -> None:
        self._octets = octets

    @property
    def value(self) -> Any:
        """The value in Python."""
        octets = self.octets
        return self.kind.decode(octets.ljust(self.kind.size, b"\0"), 0)

    @value.setter
    def value(self, value: Any) -> None:
        octets = self.kind.encode(value)
        self._octets = octets.rstrip(b"\0") if self.is_text else octets


class OdObject:
    """One object; subindex 0 of ARRAY and RECORD is made here unless given.

    Args:
        index: 16 bits.
        name: As SDO information gives it.
        code: VAR, ARRAY or RECORD.
        entries: By subindex; what is missing below the highest is a gap.
        data_type: Index of the object's own type in SDO information; of its entry if left out.
        complete_access: Whether it can be transferred as a whole.
    """

    __slots__ = ("code", "complete_access", "data_type", "entries", "index", "name")

    def __init__(
        self,
        index: int,
        name: str,
        code: ObjectCode,
        entries: Mapping[int, Entry],
        *,
        data_type: int | None = None,
        complete_access: bool = True,
    ) -> None:
        self.index = index
        self.name = name
        self.code = code
        self.entries = dict(sorted(entries.items()))
        self.complete_access = complete_access and code is not ObjectCode.VAR
        if code is not ObjectCode.VAR and 0 not in self.entries:
            count = Entry("SubIndex 000", "USINT", RO, max(self.entries, default=0))
            self.entries = {0: count, **self.entries}
        if data_type is None:
            data_type = next(reversed(self.entries.values())).kind.code
        self.data_type = data_type

    @property
    def max_subindex(self) -> int:
        """Value of subindex 0, or 0 for a VAR."""
        return 0 if self.code is ObjectCode.VAR else self.entries[0].octets[0]


def variable(index: int, name: str, kind: DataType | str, access: Access = RO, value: Any = None,
             **more: Any) -> OdObject:  # fmt: skip
    """Make a VAR; *more* as :class:`Entry` takes it."""
    return OdObject(index, name, ObjectCode.VAR, {0: Entry(name, kind, access, value, **more)})


def record(
    index: int, name: str, entries: Mapping[int, Entry], *, data_type: int | None = None
) -> OdObject:
    """Make a RECORD."""
    return OdObject(index, name, ObjectCode.RECORD, entries, data_type=data_type)


def array(
    index: int,
    name: str,
    kind: DataType | str,
    values: Iterable[Any],
    access: Access = RO,
) -> OdObject:
    """Make an ARRAY of stored values."""
    entries = {
        sub: Entry(f"SubIndex {sub:03}", kind, access, value)
        for sub, value in enumerate(values, start=1)
    }
    kind = datatypes.parse(kind) if isinstance(kind, str) else kind
    return OdObject(index, name, ObjectCode.ARRAY, entries, data_type=kind.code)
