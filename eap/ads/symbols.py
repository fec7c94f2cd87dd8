"""ADS symbols: the variables of one configuration, their parts, types, handles and values.

A member or an element is a symbol too, by its path (``axis.position``, ``table[2].x``); the upload
lists variables only, and their types, as TwinCAT does.

A handle is made of the version of the table and the number of the symbol in it: first those of the
variables, then those of their parts.  So nothing is kept for a client, a handle outlives its
connection, and one of an older table is refused as such.  Case does not matter in a name, unless it
makes two names of one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Iterable
from contextlib import suppress
from functools import cached_property, lru_cache, partial
from itertools import accumulate, islice
from typing import NamedTuple, Protocol

from eap.ads.request import AdsRefusedError
from eap.ads.space import AdsSpace, Source
from eap.ads.symbolparts import (
    SymbolPart,
    count_parts,
    find_by_number,
    find_by_path,
    find_path_at,
)
from eap.ads.symboltypes import SymbolType, TypeEntries, memory_type, symbol_type, type_key
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adssymbol import (
    HandleInfo,
    SymbolAddress,
    SymbolEntry,
    SymbolFlag,
    UploadInfo,
    decode_name,
    encode_entry,
    encode_text,
)
from eap.codec.datatypes import DataType, split_paths
from eap.codec.structures import MAX_DEPTH

_INDEX_BITS = 24
_MAX_PARTS = 4096
"""Parts with handles that a table remembers."""
_MAX_NAME = 2048
"""Characters of the longest name that is looked up."""
_ALIGNMENT = 8
"""Bytes: no value of a client's lies across what its processor reads at once."""


class SymbolVariable(NamedTuple):
    """Description of one variable."""

    name: str
    type: DataType
    comment: str = ""
    read_only: str = ""
    """Reason clients may not write it, as text behind its name; empty if they may."""


class Symbol(NamedTuple):
    """A variable or a part of one, how clients know its type, and where they find it."""

    name: str
    variable: SymbolVariable
    type: SymbolType
    address: SymbolAddress

    def describe(self) -> bytes:
        """Return its entry."""
        flags = SymbolFlag.READ_ONLY if self.variable.read_only else 0
        if self.address.group == IndexGroup.DATA_BITS:
            flags |= SymbolFlag.BIT_VALUE
        return encode_entry(
            SymbolEntry(
                self.address,
                self.type.id,
                flags,
                self.name,
                self.type.name,
                self.variable.comment if self.name == self.variable.name else "",
                self.type.dimensions,
                self.type.guid,
                self.type.attributes,
            )
        )

    def describe_handle(self, handle: int) -> bytes:
        """Return *handle* with size and name of its type."""
        name = encode_text(self.type.name)
        return HandleInfo(handle, self.type.size, 0, len(name)).encode() + name + b"\0"

    def part(self, part: SymbolPart) -> Symbol:
        """Return the symbol of a part of this variable."""
        if not part.path:
            return self
        group, offset = self.address.group, self.address.offset
        if part.kind.is_bits:
            kind = memory_type(part.kind)
            group, offset = IndexGroup.DATA_BITS, 8 * offset + part.bit_offset
        elif self.type.size == self.type.kind.size:
            kind = memory_type(part.kind)
            offset += part.bit_offset // 8
        else:  # an element of an array that is widened
            kind = symbol_type(part.kind)
            offset += part.bit_offset // part.kind.bit_length * kind.size
        address = SymbolAddress(group, offset, kind.size)
        return Symbol(self.name + part.path, self.variable, kind, address)


class SymbolTable:
    """All symbols of one configuration.

    Args:
        variables: In the order of the upload.
        version: Counts configurations; clients see 8 bits of it.
    """

    def __init__(self, variables: Iterable[SymbolVariable], version: int) -> None:
        self.version = version & 0xFF
        self._symbols: list[Symbol] = []
        types = TypeEntries()
        offset = 0
        for variable in variables:
            kind = symbol_type(variable.type)
            address = SymbolAddress(IndexGroup.DATA, offset, kind.size)
            self._symbols.append(Symbol(variable.name, variable, kind, address))
            types.add(kind)
            offset += kind.size + -kind.size % _ALIGNMENT
        self._offsets = [symbol.address.offset for symbol in self._symbols]
        self._indexes = {symbol.name: n for n, symbol in enumerate(self._symbols)}
        self._folded: dict[str, int | None] = {}
        for name, index in self._indexes.items():
            key = name.casefold()
            self._folded[key] = None if key in self._folded else index
        parts = (count_parts(symbol.variable.type) - 1 for symbol in self._symbols)
        # Numbers of the variables are 1 and on: no handle is 0, even with version 0.
        self._numbers = list(accumulate(parts, initial=len(self._symbols) + 1))
        """First number of the parts of each variable, and behind those of the last one."""
        self._part = lru_cache(maxsize=_MAX_PARTS)(self._part_by_number)
        self._types = types.encode()
        self.type_upload = b"".join(self._types.values())

    @cached_property
    def upload(self) -> bytes:
        """All entries; encoded at the first upload, because a large table takes time."""
        return b"".join(symbol.describe() for symbol in self._symbols)

    @property
    def info(self) -> UploadInfo:
        """Numbers and sizes of entries to upload."""
        return UploadInfo(
            len(self._symbols), len(self.upload), len(self._types), len(self.type_upload)
        )

    def data_type(self, name: str) -> bytes:
        """Return the entry of a type that symbols have; refuse with SYMBOL_NOT_FOUND."""
        try:
            return self._types[type_key(name)]
        except KeyError:
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND) from None

    def find(self, name: str) -> tuple[Symbol, int]:
        """Return a symbol and its handle.

        Raises:
            AdsRefusedError: SYMBOL_NOT_FOUND; NO_MORE_HANDLES, if the variables have too many
                parts.
        """
        index, path = self._index_of(name), ""
        if index is None and len(name) <= _MAX_NAME:
            # A longer path than types are deep leads nowhere.
            for variable, rest in islice(split_paths(name), 2 * MAX_DEPTH):
                index, path = self._index_of(variable), rest
                if index is not None:
                    break
        if index is None:
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND)
        symbol, number = self._symbols[index], index + 1
        if path:
            try:
                part = find_by_path(symbol.variable.type, path)
            except ValueError as exc:
                raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND, f"{name[:60]}: {exc}") from None
            symbol, number = symbol.part(part), self._numbers[index] + part.number - 1
        if number >> _INDEX_BITS:
            raise AdsRefusedError(AdsError.NO_MORE_HANDLES)
        return symbol, self.version << _INDEX_BITS | number

    def _index_of(self, variable: str) -> int | None:
        index = self._indexes.get(variable)
        return self._folded.get(variable.casefold()) if index is None else index

    def by_handle(self, handle: int) -> Symbol:
        """Return a symbol; refuse handles of other tables, and those that never were any."""
        if handle >> _INDEX_BITS != self.version:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION)
        number = handle & (1 << _INDEX_BITS) - 1
        if 0 < number <= len(self._symbols):
            return self._symbols[number - 1]
        if not 0 < number < self._numbers[-1]:
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND)
        return self._part(number)

    def _part_by_number(self, number: int) -> Symbol:
        index = bisect_right(self._numbers, number) - 1
        symbol = self._symbols[index]
        part = find_by_number(symbol.variable.type, number - self._numbers[index] + 1)
        return symbol.part(part)

    def successor_of(self, symbol: Symbol) -> Symbol:
        """Return the symbol here for *symbol* of an older table; refuse with SYMBOL_VERSION."""
        try:
            successor, _ = self.find(symbol.name)
        except AdsRefusedError:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION) from None
        if successor.name != symbol.name or successor.type != symbol.type:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION)
        return successor

    def at(self, offset: int) -> tuple[Symbol, int]:
        """Return the variable that *offset* lies in, and how far; refuse with INDEX_OFFSET."""
        index = bisect_right(self._offsets, offset) - 1
        if index < 0 or offset >= self._offsets[index] + self._symbols[index].address.size:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return self._symbols[index], offset - self._offsets[index]

    def part_at(self, offset: int, size: int) -> Symbol:
        """Return the variable or part of *size* bytes at *offset*; a text may be longer.

        Raises:
            AdsRefusedError: INDEX_OFFSET, if there is no variable; SIZE, if none has this size.
        """
        symbol, start = self.at(offset)
        is_memory = symbol.type.size == symbol.type.kind.size
        if not start and (size == symbol.type.size or not is_memory):
            return symbol
        if not is_memory:
            raise AdsRefusedError(AdsError.SIZE)
        path = find_path_at(symbol.variable.type, 8 * start, 8 * size) if size else None
        if path is None:
            raise AdsRefusedError(AdsError.SIZE)
        return symbol.part(find_by_path(symbol.variable.type, path))

    def bits_at(self, offset: int) -> Symbol:
        """Return the bit field at an offset in bits; refuse with INDEX_OFFSET."""
        symbol, start = self.at(offset // 8)
        path = find_path_at(symbol.variable.type, 8 * start + offset % 8, 0)
        if not path:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return symbol.part(find_by_path(symbol.variable.type, path))


class VariableStore(Protocol):
    """Store of the values by name or path; raises AdsRefusedError, BUSY for a passing reason."""

    def read(self, name: str) -> bytes:
        """Return the bytes of a value, as its type has them."""

    def write(self, name: str, octets: bytes) -> None:
        """Store the bytes of a value."""


class SymbolSpace(AdsSpace):
    """The index groups of symbols.

    Args:
        table: Of the configuration that runs.
        store: The values of that configuration.
    """

    groups: Collection[int] = frozenset(
        (
            IndexGroup.DATA,
            IndexGroup.DATA_BITS,
            IndexGroup.SYMBOL_HANDLE,
            IndexGroup.VALUE_BY_NAME,
            IndexGroup.VALUE_BY_HANDLE,
            IndexGroup.RELEASE_HANDLE,
            IndexGroup.SYMBOL_BY_NAME,
            IndexGroup.SYMBOL_VERSION,
            IndexGroup.SYMBOL_ENTRY_BY_NAME,
            IndexGroup.SYMBOL_UPLOAD,
            IndexGroup.SYMBOL_UPLOAD_INFO,
            IndexGroup.DATA_TYPE_UPLOAD,
            IndexGroup.SYMBOL_UPLOAD_INFO_2,
            IndexGroup.SYMBOL_NOTIFICATION,
            IndexGroup.DATA_TYPE_BY_NAME,
        )
    )

    def __init__(self, table: SymbolTable, store: VariableStore) -> None:
        self._table = table
        self._store = store

    def replace(self, table: SymbolTable, store: VariableStore) -> None:
        """Go over to another configuration.

        Notifications of symbols that are in both, with one type, go on; the others end.
        """
        self._table = table
        self._store = store

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return a value, or as much as fits; of a list, only the whole."""
        if group == IndexGroup.SYMBOL_VERSION:
            return bytes((self._table.version,))[:length]
        if group == IndexGroup.SYMBOL_UPLOAD_INFO:
            return self._table.info.encode()[: min(length, 8)]
        if group == IndexGroup.SYMBOL_UPLOAD_INFO_2:
            return self._table.info.encode_for(length)
        if group == IndexGroup.SYMBOL_UPLOAD:
            return _whole(self._table.upload, length)
        if group == IndexGroup.DATA_TYPE_UPLOAD:
            return _whole(self._table.type_upload, length)
        symbol, start = self._find(group, offset)
        return self._value(symbol)[start : start + length]

    def write(self, group: int, offset: int, data: bytes) -> None:
        """Store a value, which must be whole, or give a handle back."""
        if group == IndexGroup.RELEASE_HANDLE:
            # One of an older table is gone anyhow; its client gives it back in good faith.
            if len(data) != 4:
                raise AdsRefusedError(AdsError.SIZE)
            return
        if group == IndexGroup.DATA:
            symbol = self._table.part_at(offset, len(data))
        else:
            symbol, _ = self._find(group, offset)
        if symbol.variable.read_only:
            why = f"{symbol.name} {symbol.variable.read_only}"
            raise AdsRefusedError(AdsError.ACCESS, why)
        self._store.write(symbol.name, symbol.type.from_client(data))

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Return value, handle or description of the name in *data*."""
        if group not in _BY_NAME:
            return super().read_write(group, offset, length, data)
        name = decode_name(data)
        if group == IndexGroup.DATA_TYPE_BY_NAME:
            return _whole(self._table.data_type(name), length)
        symbol, handle = self._table.find(name)
        if group == IndexGroup.VALUE_BY_NAME:
            return self._value(symbol)[:length]
        if group == IndexGroup.SYMBOL_HANDLE:
            info = symbol.describe_handle(handle)
            return _whole(info if len(info) <= length else info[:4], length)
        if group == IndexGroup.SYMBOL_BY_NAME:
            return _whole(symbol.address.encode(), length)
        return _whole(symbol.describe(), length)

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return a source of the first *length* bytes of a value, or of the version."""
        if group == IndexGroup.SYMBOL_VERSION:
            if length != 1:
                raise AdsRefusedError(AdsError.SIZE)
            return partial(self.read, group, 0, length)
        symbol, start = self._find(group, offset)
        if start + length > symbol.address.size:
            raise AdsRefusedError(AdsError.SIZE)
        if group == IndexGroup.DATA:
            # A member is watched by itself: its struct may change, and be large.
            with suppress(AdsRefusedError):
                symbol, start = self._table.part_at(offset, length), 0
        table = self._table

        def source() -> bytes:
            nonlocal symbol, table
            if table is not self._table:
                symbol, table = self._table.successor_of(symbol), self._table
            return self._value(symbol)[start : start + length]

        return source

    def _find(self, group: int, offset: int) -> tuple[Symbol, int]:
        if group == IndexGroup.DATA:
            return self._table.at(offset)
        if group == IndexGroup.DATA_BITS:
            return self._table.bits_at(offset), 0
        if group in _BY_HANDLE:
            return self._table.by_handle(offset), 0
        raise AdsRefusedError(AdsError.ACCESS)

    def _value(self, symbol: Symbol) -> bytes:
        return symbol.type.to_client(self._store.read(symbol.name))


_BY_HANDLE = frozenset((IndexGroup.VALUE_BY_HANDLE, IndexGroup.SYMBOL_NOTIFICATION))
_BY_NAME = frozenset(
    (
        IndexGroup.SYMBOL_HANDLE,
        IndexGroup.VALUE_BY_NAME,
        IndexGroup.SYMBOL_BY_NAME,
        IndexGroup.SYMBOL_ENTRY_BY_NAME,
        IndexGroup.DATA_TYPE_BY_NAME,
    )
)


def _whole(octets: bytes, length: int) -> bytes:
    if len(octets) > length:
        raise AdsRefusedError(AdsError.SIZE)
    return octets
