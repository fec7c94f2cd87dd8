"""Rows of a profile's table, forms and rules of its entries, and objects made from rows.

The row of an entry names the source of its content: *config* (written in PreOp, kept), *fixed*
(given at the start, read only), *live* (read from the running device under a key) or *derived*
(computed from other entries of the dictionary).

A row of configuration is the one description of a field of a station: its key in the plant file,
its path in the specification, its sub-index, type, limits and rule, and its text in the docs.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import Enum, IntEnum, StrEnum
from functools import partial
from ipaddress import IPv4Address
from typing import Any, NamedTuple, TypeAlias

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.codec.literals import write_literal
from eap.ids import MacAddr, NetId, ObjectId
from eap.od.model import RO, RW_PREOP, Access, Entry, ObjectCode, OdObject, ReadHook


class Rule(StrEnum):
    """Rules for the content of an entry, beyond its type and limits."""

    NONE = ""
    NAME = "name"
    """A name of a station's parts: no spaces, no slashes."""
    TYPE = "type"
    """A data type."""
    DEFAULT = "default"
    """A value of the variable's type; numbers are finite."""
    FLAGS = "flags"
    """Known flags of an RxPD."""
    GROUP = "group"
    """A multicast address, MAC or IPv4, or empty."""
    SOURCE = "source"
    """A MAC or IPv4 address, or empty."""
    STATE = "state"
    """A state that can be requested."""


class Form(StrEnum):
    """Form of an entry as text."""

    PLAIN = "plain"
    """As its type is written."""
    HEX = "hex"
    INDEX = "index"
    """Of another object; 0 is none."""
    MAPPING = "mapping"
    """Entry and bit length, as ``0x6000:01/16``."""
    MAC = "mac"
    NET_ID = "net_id"
    IP = "ip"

    @property
    def is_address(self) -> bool:
        """True if it is a block of bytes that has a text of its own."""
        return self in _BLOCKS

    def text_of(self, octets: bytes) -> str:
        """Return an address as text."""
        return _BLOCKS[self][0](octets)

    def octets_of(self, text: str) -> bytes:
        """Return the bytes of an address; raise ValueError if *text* is none."""
        return _BLOCKS[self][1](text)


def to_text(form: Form, kind: DataType, octets: bytes) -> str:
    """Return the *octets* of an entry as text; :func:`from_text` reads it again."""
    if form.is_address:
        return form.text_of(octets)
    value = kind.decode(octets.ljust(kind.size, b"\0"), 0)
    if form is Form.MAPPING and isinstance(value, int):
        return f"{ObjectId(value >> 16, value >> 8 & 0xFF)}/{value & 0xFF}"
    if form in {Form.HEX, Form.INDEX} and isinstance(value, int):
        return f"0x{value:0{2 * kind.size}X}"
    if isinstance(value, bytes):
        return value.hex(" ")
    if isinstance(value, tuple | dict):
        return write_literal(kind.to_plain(value)).removeprefix("[").removesuffix("]")
    return str(value).lower() if isinstance(value, bool) else str(kind.to_plain(value))


def from_text(form: Form, kind: DataType, text: str) -> bytes:
    """Return the bytes that *text* stands for.

    Raises:
        ValueError: it is nothing of the form, or no value of the type.
    """
    if form.is_address:
        return form.octets_of(text)
    if form is Form.MAPPING and "/" in text:
        entry, _, bits = text.strip().partition("/")
        if ":" not in entry or not _BITS.fullmatch(bits):
            raise ValueError(f"{text!r} is no mapping such as 0x6000:01/16")
        index, subindex = ObjectId.parse(entry)
        return kind.encode(index << 16 | subindex << 8 | int(bits))
    octets = kind.encode(kind.parse_text(text))
    return octets.rstrip(b"\0") if kind.is_text else octets


_BITS = re.compile(r"\d{1,2}|1\d\d|2[0-4]\d|25[0-5]", re.ASCII)
_BLOCKS: dict[Form, tuple[Callable[[bytes], str], Callable[[str], bytes]]] = {
    Form.MAC: (lambda octets: str(MacAddr(octets)), lambda text: bytes(MacAddr.parse(text))),
    Form.NET_ID: (lambda octets: str(NetId(octets)), lambda text: bytes(NetId.parse(text))),
    Form.IP: (lambda octets: str(IPv4Address(octets)), lambda text: IPv4Address(text).packed),
}


CONFIG = RW_PREOP | Access.BACKUP
"""Rights of configuration: read always, written in PreOp, listed among what is to be saved."""

UNITS = {"": None, "us": 0xFA030000, "100 us": 0xFC030000, "ms": 0xFD030000}
"""Units of entry descriptions: exponent of ten, second as numerator (ETG.1004)."""

OWN_TYPE = ""
"""Type of an entry that holds a value of the variable that its object describes."""


class ProfileEntry(NamedTuple):
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
    """Key of a live value, with the object's name."""
    derived: str = ""
    """Key of a computed value."""
    form: Form = Form.PLAIN
    """Its form as text."""
    changeable: bool = False
    """True if it can be written in SafeOp and Op too once its object says so."""
    key: str = ""
    """Key of the plant file, below the section of the object."""
    field: str = ""
    """Path of the same in the specification, for what is converted entry by entry."""
    words: type[IntEnum] | None = None
    """Numbers of an entry for which the specification has the names, in lower case."""
    rule: Rule = Rule.NONE
    """Content that is allowed beyond type and limits."""
    refers: tuple[int, ...] = ()
    """First indexes of the ranges to which an index in this entry may refer."""
    schemes: tuple[str, ...] = ()
    """Interfaces on which it may be other than 0; empty for all."""

    def to_plain(self, value: Any) -> Any:
        """Return the *value* of an entry as the specification has it."""
        if self.words is not None:
            return self.words(value).name.lower()
        if isinstance(value, bytes):
            return self.form.text_of(value) if any(value) else ""
        return value

    def from_plain(self, plain: Any) -> Any:
        """Return the value of an entry for which the specification has *plain*."""
        if self.words is not None:
            return self.words[plain.upper()]
        if self.form.is_address:
            return self.form.octets_of(plain) if plain else None
        return plain

    def numbered(self, subindex: int) -> str:
        """Return the name of the entry at *subindex*."""
        return self.name.format(n=subindex - self.subindex) if self.last else self.name


class ProfileObject(NamedTuple):
    """Objects of one kind: one object, or as many as were made from *first* to *last*.

    *name* holds ``{n}`` where the number of the object within its range goes.
    """

    first: int
    last: int
    name: str
    code: ObjectCode
    entries: tuple[ProfileEntry, ...]
    description: str
    dynamic: bool = False
    """True if a download to a free index makes an object and 0 in sub-index 0 deletes it."""
    mapping: bool = False
    """True if it lists the variables of a PDO."""
    companion: int = 0
    """First index of the range whose objects come and go with these."""
    section: str = ""
    """Section of the plant file that an object stands for."""

    @property
    def list_row(self) -> ProfileEntry | None:
        """The row of the list at the object's end, None if there is none."""
        row = self.entries[-1]
        return row if row.last else None

    @property
    def fixed_count(self) -> int:
        """Highest sub-index in front of the list."""
        row = self.entries[-1]
        return row.subindex - 1 if row.last else row.subindex

    @property
    def count_access(self) -> Access:
        """Access of sub-index 0: written where it deletes the object or cuts its list."""
        is_kept = self.list_row is not None and self.list_row.access & CONFIG == CONFIG
        return CONFIG if self.dynamic or is_kept else RO

    @property
    def last_subindex(self) -> int:
        """Highest sub-index of an object that is as long as it can be."""
        row = self.entries[-1]
        return row.last or row.subindex

    def row(self, subindex: int) -> ProfileEntry | None:
        """Return the row of a sub-index, None if no object of this kind has it."""
        for row in self.entries:
            if row.subindex == subindex or row.subindex <= subindex <= row.last:
                return row
        return None

    def subindex_of(self, key: str) -> int:
        """Return the sub-index of the entry that has *key* in the plant file."""
        return next(row.subindex for row in self.entries if row.key == key)

    def title(self, index: int) -> str:
        """Return the name of the object at *index*."""
        return self.name.format(n=index - self.first)


class FieldRow(NamedTuple):
    """Row of an entry that is one field of the specification."""

    subindex: int
    path: tuple[str, ...]
    """Names of the records around the field, and its own."""
    row: ProfileEntry
    is_plain: bool
    """True if the specification has the value as it is in the entry."""


def field_rows(described: ProfileObject) -> tuple[FieldRow, ...]:
    """Return the entries of an object that are one field of the specification each."""
    return tuple(
        FieldRow(
            row.subindex,
            tuple(row.field.split(".")),
            row,
            is_plain=row.words is None and not row.refers and not row.form.is_address,
        )
        for row in described.entries
        if row.field
    )


def single(
    index: int, name: str, description: str, *entries: ProfileEntry, section: str = ""
) -> ProfileObject:
    """Write the row of one object; an entry without a description has that of the object."""
    first = entries[0]
    code = ObjectCode.ARRAY if first.last else ObjectCode.RECORD
    described = tuple(
        each._replace(description=each.description or description) for each in entries
    )
    return ProfileObject(
        index, index, name, code if first.subindex else ObjectCode.VAR, described, description,
        section=section,
    )  # fmt: skip


def config(
    subindex: int, name: str, kind: str, description: str, *, key: str = "", **more: Any
) -> ProfileEntry:
    """Write a row of configuration; *more* as :class:`ProfileEntry` has it."""
    return ProfileEntry(int(subindex), name, kind, CONFIG, description, key=key, **more)


def setting(
    subindex: int, name: str, kind: str, description: str, *, key: str, field: str = "", **more: Any
) -> ProfileEntry:
    """Write a row of configuration that the specification has as one field, *key* by default."""
    return config(subindex, name, kind, description, key=key, field=field or key, **more)


def fixed(subindex: int, name: str, kind: str, description: str, **more: Any) -> ProfileEntry:
    """Write a row that is given at the start."""
    return ProfileEntry(int(subindex), name, kind, RO, description, **more)


def live(
    subindex: int, name: str, kind: str, key: Enum, description: str, **more: Any
) -> ProfileEntry:
    """Write a row that shows what *key* stands for while the device runs."""
    return ProfileEntry(int(subindex), name, kind, RO, description, live=key.value, **more)


def derived(
    subindex: int, name: str, kind: str, key: Enum, description: str, **more: Any
) -> ProfileEntry:
    """Write a row that is computed from other entries."""
    return ProfileEntry(int(subindex), name, kind, RO, description, derived=key.value, **more)


DEFAULT_TYPE = datatypes.parse("UINT")

Source: TypeAlias = Callable[[ProfileEntry, int, DataType], ReadHook | None]
"""Source of entries that store nothing: called with row, sub-index and type of each entry."""
LiveRead: TypeAlias = Callable[[str], Any]
"""Returns the value of a live key: a number, bytes or a text, as the type of its entry says."""
LiveWrite: TypeAlias = Callable[[str, bytes], None]
"""Carries out a download to a live key, or raises SdoAbortError."""


def make_object(
    row: ProfileObject,
    index: int,
    source: Source,
    *,
    kind: DataType = DEFAULT_TYPE,
    last: int = 0,
    extent: int = 0xFF,
    write: LiveWrite | None = None,
) -> OdObject:
    """Return an object with its defaults.

    Args:
        row: What the profile says of objects of its kind.
        index: Its own.
        source: For entries that store nothing.
        kind: Type of entries that hold a value of the object's variable.
        last: The last sub-index of the list at its end; 0 leaves the list empty.
        extent: The last sub-index that it may have.
        write: For live entries that can be written.
    """
    entries = {
        each.subindex: make_entry(each, each.subindex, source, kind=kind, write=write)
        for each in row.entries
        if not each.last and each.subindex <= extent
    }
    if row.list_row is not None:
        for subindex in range(row.list_row.subindex, last + 1):
            entries[subindex] = make_entry(row.list_row, subindex, source)
    if row.code is not ObjectCode.VAR:
        entries[0] = Entry("SubIndex 000", "USINT", row.count_access, max(entries, default=0))
    code = datatypes.parse(row.entries[-1].kind).code if row.code is ObjectCode.ARRAY else None
    return OdObject(index, row.title(index), row.code, entries, data_type=code)


def make_entry(
    row: ProfileEntry,
    subindex: int,
    source: Source,
    *,
    kind: DataType = DEFAULT_TYPE,
    write: LiveWrite | None = None,
) -> Entry:
    """Return one entry with its default; arguments as for :func:`make_object`."""
    own = kind if row.kind == OWN_TYPE else datatypes.parse(row.kind)
    return Entry(
        row.numbered(subindex), own, row.access, row.default,
        read=source(row, subindex, own),
        write=partial(write, row.live) if write and row.live and row.access != RO else None,
        unit=UNITS[row.unit], minimum=row.minimum, maximum=row.maximum,
    )  # fmt: skip


def live_source(read: LiveRead) -> Source:
    """Return a source whose live entries show what *read* returns for their keys."""

    def source(row: ProfileEntry, _subindex: int, kind: DataType) -> ReadHook | None:
        return (lambda: live_octets(kind, read(row.live))) if row.live else None

    return source


def live_octets(kind: DataType, value: Any) -> bytes:
    """Return a live value as it is transferred; a number beyond its type is the largest one."""
    if kind.is_text:
        return str(value).encode()[: kind.size]
    if kind.scalar_range is not None:
        value = min(value, int(kind.scalar_range[1]))
    return kind.encode(value)
