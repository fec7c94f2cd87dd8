"""Symbol and data type entries as an ADS client reads them, in the order of ads-client's parser."""

from __future__ import annotations

import struct
from typing import NamedTuple

from eap.codec.adssymbol import (
    ArrayDimension,
    DataTypeEntry,
    DataTypeFlag,
    SymbolAddress,
    SymbolEntry,
    SymbolFlag,
)


class Cursor:
    """Position in the bytes of an entry."""

    def __init__(self, data: bytes, at: int = 0) -> None:
        self.data, self.at = data, at

    def take(self, form: str) -> tuple[int, ...]:
        values = struct.unpack_from(f"<{form}", self.data, self.at)
        self.at += struct.calcsize(f"<{form}")
        return values

    def bytes(self, size: int) -> bytes:
        self.at += size
        assert self.at <= len(self.data)
        return self.data[self.at - size : self.at]

    def text(self, length: int) -> str:
        octets = self.bytes(length + 1)
        assert octets[-1] == 0
        assert 0 not in octets[:-1]
        return octets[:-1].decode("cp1252")

    def dimensions(self, count: int) -> tuple[ArrayDimension, ...]:
        return tuple(ArrayDimension(*self.take("iI")) for _ in range(count))

    def attributes(self) -> tuple[tuple[str, str], ...]:
        (count,) = self.take("H")
        pairs = []
        for _ in range(count):
            name, value = self.take("BB")
            pairs.append((self.text(name), self.text(value)))
        return tuple(pairs)


def decode_entry(data: bytes, offset: int = 0) -> tuple[SymbolEntry, int]:
    """Return the symbol at *offset*, and where the next one begins."""
    cursor = Cursor(data, offset)
    length, group, at, size, kind, flags, dims, *lengths = cursor.take("5I5H")
    name, type_name, comment = map(cursor.text, lengths)
    entry = SymbolEntry(
        SymbolAddress(group, at, size),
        kind,
        flags,
        name,
        type_name,
        comment,
        cursor.dimensions(dims),
        cursor.bytes(16) if flags & SymbolFlag.TYPE_GUID else b"",
        cursor.attributes() if flags & SymbolFlag.ATTRIBUTES else (),
    )
    assert cursor.at == offset + length
    return entry, cursor.at


def decode_entries(data: bytes) -> dict[str, SymbolEntry]:
    """Return all symbols of an upload by their names."""
    entries, at = {}, 0
    while at < len(data):
        entry, at = decode_entry(data, at)
        entries[entry.name] = entry
    return entries


class TypeHead(NamedTuple):
    """Fixed part of the entry of a type."""

    length: int
    version: int
    hash: int
    type_hash: int
    size: int
    offset: int
    type: int
    flags: int


def decode_type(data: bytes, offset: int = 0) -> tuple[DataTypeEntry, int]:
    """Return the data type at *offset*, and where the next one begins."""
    cursor = Cursor(data, offset)
    head = TypeHead(*cursor.take("8I"))
    assert head.version == 1
    *lengths, dims, items = cursor.take("5H")
    name, type_name, comment = map(cursor.text, lengths)
    dimensions = cursor.dimensions(dims)
    members = []
    for _ in range(items):
        member, cursor.at = decode_type(data, cursor.at)
        members.append(member)
    entry = DataTypeEntry(
        name,
        head.type,
        head.size,
        type_name,
        comment,
        head.flags,
        head.offset,
        head.hash,
        head.type_hash,
        dimensions,
        tuple(members),
        cursor.bytes(16) if head.flags & DataTypeFlag.TYPE_GUID else b"",
        cursor.attributes() if head.flags & DataTypeFlag.ATTRIBUTES else (),
        _values(cursor, head.size) if head.flags & DataTypeFlag.ENUM_INFOS else (),
    )
    assert cursor.at == offset + head.length
    return entry, cursor.at


def _values(cursor: Cursor, size: int) -> tuple[tuple[str, int], ...]:
    (count,) = cursor.take("H")
    values = []
    for _ in range(count):
        (length,) = cursor.take("B")
        name = cursor.text(length)
        values.append((name, int.from_bytes(cursor.bytes(size), "little", signed=True)))
    return tuple(values)


def decode_types(data: bytes) -> dict[str, DataTypeEntry]:
    """Return all data types of an upload by their names."""
    entries, at = {}, 0
    while at < len(data):
        entry, at = decode_type(data, at)
        assert entry.name not in entries
        entries[entry.name] = entry
    return entries
