"""Types of ADS symbols: names, ids and sizes for clients, conversion of values, and their entries.

A lone variable is widened where clients have no such type: a number of an odd width is one of the
next width that IEC 61131-3 has, and a text gets the NUL at its end that a PLC's strings have.
Structs and arrays of structs, texts or named types are memory, byte by byte as on the wire: a
STRING(n) in them is the STRING(n-1) of a PLC, whose NUL is in the memory.

Subranges bear the name of their base, which all clients know.  Texts are UTF-8, and say so by an
attribute.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple
from uuid import UUID
from zlib import crc32

from eap.ads.request import AdsRefusedError
from eap.codec import datatypes
from eap.codec.ads import AdsError
from eap.codec.adssymbol import (
    MAX_TEXT,
    AdsType,
    ArrayDimension,
    DataTypeEntry,
    DataTypeFlag,
    encode_data_type,
)
from eap.codec.arrays import Dimension
from eap.codec.basetypes import Text, WideChar, WideString
from eap.codec.datatypes import Array, Block, Boolean, DataType, Integer, Real, String
from eap.codec.enumerations import Enumeration
from eap.codec.structures import Member, Structure
from eap.codec.times import Timed

_INTEGERS = {
    (True, 1): (AdsType.INT8, "SINT"),
    (True, 2): (AdsType.INT16, "INT"),
    (True, 4): (AdsType.INT32, "DINT"),
    (True, 8): (AdsType.INT64, "LINT"),
    (False, 1): (AdsType.UINT8, "USINT"),
    (False, 2): (AdsType.UINT16, "UINT"),
    (False, 4): (AdsType.UINT32, "UDINT"),
    (False, 8): (AdsType.UINT64, "ULINT"),
}
_REALS = {4: (AdsType.REAL32, "REAL"), 8: (AdsType.REAL64, "LREAL")}
_OWN_NAMES = frozenset(("BYTE", "WORD", "DWORD", "LWORD"))
"""Names that are kept; the ids are those of numbers."""
# Clients take texts without it for texts in the code page of TwinCAT.
UTF_8 = (("TcEncoding", "UTF-8"),)
"""Attribute of texts."""


class SymbolType(NamedTuple):
    """ADS form of one of our types, with conversion of values both ways."""

    kind: DataType
    id: AdsType
    name: str
    """As TwinCAT writes it."""
    size: int
    """Bytes for a client; a bit field has one."""

    @property
    def dimensions(self) -> tuple[ArrayDimension, ...]:
        """Of an array, those of its elements not included."""
        if isinstance(self.kind, Array):
            return tuple(ArrayDimension(*each) for each in self.kind.dimensions)
        is_memory = self.size == self.kind.size
        return (ArrayDimension(0, self.size),) if is_memory and _is_bytes(self.kind) else ()

    @property
    def attributes(self) -> tuple[tuple[str, str], ...]:
        """Names and values of attributes."""
        return UTF_8 if self.id == AdsType.STRING else ()

    @property
    def guid(self) -> bytes:
        """GUID of a base type of TwinCAT, 16 bytes; empty for all others."""
        number = _GUIDS.get(self.name)
        if number is None and isinstance(self.kind, String) and self.kind.alias_of is None:
            number = f"{0x0001 << 32 | self.size - 1:012x}"
        return UUID(f"18071995-0000-0000-0000-{number:0>12}").bytes_le if number else b""

    def to_client(self, octets: bytes) -> bytes:
        """Convert the bytes of our type to those that a client reads."""
        if self.size == self.kind.size:
            return octets
        if isinstance(self.kind, String):
            return octets + b"\0"
        return self._resized(octets, _element(self.kind).size, self.size // self.kind.count)

    def from_client(self, data: bytes) -> bytes:
        """Return the bytes of our type for what a client writes.

        Raises:
            AdsRefusedError: SIZE or VALUE.
        """
        if isinstance(self.kind, Text):
            return self._from_text(data, self.kind.unit)
        if len(data) != self.size:
            raise AdsRefusedError(AdsError.SIZE)
        if isinstance(self.kind, Boolean):
            return bytes((any(data),))
        if self.size != self.kind.size:
            return self._resized(data, self.size // self.kind.count, _element(self.kind).size)
        if self.kind.is_bits and data[0] >> self.kind.bit_length:
            raise AdsRefusedError(AdsError.VALUE)
        mask = _mask(self.kind)
        if mask == (1 << self.kind.bit_length) - 1:
            return data
        # The padding of a struct is never a client's: it goes to other stations.
        return (int.from_bytes(data, "little") & mask).to_bytes(self.size, "little")

    def _from_text(self, data: bytes, unit: int) -> bytes:
        if len(data) > self.size or len(data) % unit:
            raise AdsRefusedError(AdsError.SIZE)
        end = next((n for n in range(0, len(data), unit) if not any(data[n : n + unit])), len(data))
        if end > self.kind.size:
            raise AdsRefusedError(AdsError.SIZE)
        return data[:end].ljust(self.kind.size, b"\0")

    def _resized(self, data: bytes, before: int, after: int) -> bytes:
        element = _element(self.kind)
        signed = isinstance(element, Integer) and element.signed
        octets = bytearray()
        for at in range(0, len(data), before):
            number = int.from_bytes(data[at : at + before], "little", signed=signed)
            try:
                octets += number.to_bytes(after, "little", signed=signed)
            except OverflowError:
                raise AdsRefusedError(AdsError.VALUE) from None
        return bytes(octets)


@lru_cache(maxsize=4096)
def _mask(kind: DataType) -> int:
    """Return the bits of *kind* that are no padding."""
    if isinstance(kind, Structure):
        mask = 0
        for member in kind.members:
            mask |= _mask(member.kind) << member.bit_offset
        return mask
    if isinstance(kind, Array):
        element = _mask(kind.element).to_bytes(kind.element.size, "little")
        return int.from_bytes(element * kind.count, "little")
    return (1 << kind.bit_length) - 1


def symbol_type(kind: DataType) -> SymbolType:
    """Return how clients know a lone variable of *kind*."""
    if kind.alias_of is None and type(kind) is String:
        return SymbolType(kind, AdsType.STRING, f"STRING({kind.size})", kind.size + 1)
    element = _element(kind)
    if type(element) is not Integer or kind.alias_of or element.alias_of:
        return memory_type(kind)
    type_id, name, size = _number(element)
    if isinstance(kind, Array):
        name = f"ARRAY [{_shape(kind.dimensions)}] OF {name}"
    return SymbolType(kind, type_id, name, size * kind.count)


@lru_cache(maxsize=4096)
def memory_type(kind: DataType) -> SymbolType:
    """Return how clients know *kind* within a struct or an array."""
    if kind.alias_of is not None:
        return memory_type(kind.alias_of)._replace(kind=kind, name=kind.name)
    match kind:
        case Array():
            element = memory_type(kind.element)
            found = element.id, f"ARRAY [{_shape(kind.dimensions)}] OF {element.name}"
        case Structure():
            found = AdsType.BIG, kind.name
        case String():
            found = AdsType.STRING, f"STRING({kind.size - 1})"
        case WideString():
            found = AdsType.WSTRING, f"WSTRING({kind.size // 2 - 1})"
        case Boolean():
            found = AdsType.BIT, "BOOL"
        case Integer() if kind.is_bits:
            found = AdsType.BIT, "BIT" if kind.bit_length == 1 else kind.text
        case _ if _is_bytes(kind):
            found = AdsType.UINT8, f"ARRAY [0..{kind.size - 1}] OF BYTE"
        case Enumeration() | Timed() | WideChar():
            found = _number(kind)[0], kind.name
        case _:
            found = _number(kind)[:2]
    return SymbolType(kind, *found, kind.size)


def _shape(dimensions: tuple[Dimension, ...]) -> str:
    return ",".join(f"{low}..{low + count - 1}" for low, count in dimensions)


def _is_bytes(kind: DataType) -> bool:
    """Return whether clients know *kind* as bytes, because they have no such type in memory."""
    is_odd = isinstance(kind, Integer) and not kind.is_bits and kind.size not in {1, 2, 4, 8}
    return isinstance(kind, Block) or is_odd


def _element(kind: DataType) -> DataType:
    return kind.element if isinstance(kind, Array) else kind


def _number(kind: DataType) -> tuple[AdsType, str, int]:
    """Return id, name and size of the number that holds *kind*."""
    if isinstance(kind, Real):
        return *_REALS[kind.size], kind.size
    signed = isinstance(kind, Integer) and kind.signed
    size = next(size for size in (1, 2, 4, 8) if size >= kind.size)
    type_id, name = _INTEGERS[signed, size]
    own = kind.range_of or kind.text if isinstance(kind, Integer) else ""
    return type_id, own if own in _OWN_NAMES else name, size


_GUIDS = {
    "BYTE": "01", "USINT": "02", "SINT": "03", "WORD": "04", "UINT": "05", "INT": "06",
    "DWORD": "07", "UDINT": "08", "DINT": "09", "LWORD": "0a", "ULINT": "0b", "LINT": "0c",
    "REAL": "0d", "LREAL": "0e", "BIT": "10", "BOOL": "30", "TIME": "48", "DT": "4c", "LTIME": "4e",
}  # fmt: skip
"""Last digits of the GUIDs of TwinCAT's base types, as its TMC files have them."""


class TypeEntries:
    """Data type entries of symbols, each behind those that it refers to."""

    def __init__(self) -> None:
        self._entries: dict[str, DataTypeEntry] = {}

    def __len__(self) -> int:
        return len(self._entries)

    def encode(self) -> dict[str, bytes]:
        """Return the encoded entries by :func:`type_key` of their names."""
        return {key: encode_data_type(entry) for key, entry in self._entries.items()}

    def add(self, of: SymbolType) -> DataTypeEntry:
        """Add a type and those that it refers to, unless they are there; return its entry."""
        key = type_key(of.name)
        entry = self._entries.get(key)
        if entry is None:
            entry = self._describe(of)
            # A change of a type is one of all that refer to it, because they have its hash.
            entry = entry._replace(hash=crc32(encode_data_type(entry)))
            self._entries[key] = entry
        return entry

    def _describe(self, of: SymbolType) -> DataTypeEntry:
        kind = of.kind
        entry = DataTypeEntry(of.name, of.id, of.size, guid=of.guid, attributes=of.attributes)
        if kind.alias_of is None and isinstance(kind, Structure):
            return entry._replace(items=tuple(map(self._item, kind.members)))
        if kind.alias_of is None and kind.is_bits and of.id == AdsType.BIT and of.name != "BOOL":
            flags = DataTypeFlag.DATA_TYPE | DataTypeFlag.BIT_VALUES
            return entry._replace(size=kind.bit_length, flags=flags)
        if kind.alias_of is None:
            entry = entry._replace(dimensions=of.dimensions)
            if isinstance(kind, Enumeration) and not of.dimensions:
                entry = entry._replace(values=tuple(kind.numbers.items()))
        base = _base_of(of)
        if base is None:
            return entry
        based_on = self.add(base)
        return entry._replace(type_name=based_on.name, type_hash=based_on.hash)

    def _item(self, member: Member) -> DataTypeEntry:
        of = memory_type(member.kind)
        base = self.add(of)
        flags, offset = DataTypeFlag.DATA_ITEM, member.bit_offset
        if member.kind.is_bits:
            flags |= DataTypeFlag.BIT_VALUES
        else:
            offset //= 8
        return DataTypeEntry(
            member.name, of.id, base.size, of.name, flags=flags, offset=offset, hash=base.hash,
            type_hash=base.type_hash, dimensions=base.dimensions, guid=base.guid,
            attributes=base.attributes,
        )  # fmt: skip


def _base_of(of: SymbolType) -> SymbolType | None:
    """Return the type that a type is another name of, is based on, or has elements of."""
    kind = of.kind
    if kind.alias_of is not None:
        return memory_type(kind.alias_of)
    if isinstance(kind, Array):
        # Widened numbers are elements of their own size.
        is_memory = of.size == kind.size
        return memory_type(kind.element) if is_memory else symbol_type(kind.element)
    if of.dimensions:
        return memory_type(datatypes.parse("BYTE"))
    if isinstance(kind, Enumeration):
        return memory_type(datatypes.parse(kind.base))
    if isinstance(kind, Timed | WideChar):  # clients that do not know the name read the number
        return memory_type(datatypes.parse(f"UINT{kind.bit_length}"))
    return None


def type_key(name: str) -> str:
    """Return the key of a type: names are cut in entries, and have no case."""
    return name[:MAX_TEXT].casefold()
