"""Variables of a station as ADS symbols: by name, by handle, by index group and offset.

A handle is made of the version of the table and the place of the symbol in it.  So nothing is kept
for a client, a handle outlives its connection, and one of an older table is refused as such.  Case
does not matter in a name, unless it makes two names of one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Iterable
from functools import partial
from typing import NamedTuple, Protocol

from eap.aoe.ads_operation import AdsRefusedError
from eap.aoe.ads_space import AdsSpace, Source
from eap.aoe.ads_types import SymbolType, symbol_type
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsdatatype import encode_data_type
from eap.codec.adssymbol import (
    HandleInfo,
    SymbolEntry,
    SymbolFlag,
    SymbolPlace,
    UploadInfo,
    decode_name,
    encode_entry,
    encode_text,
)
from eap.codec.values import DataType

_INDEX_BITS = 24
_ALIGNMENT = 8
"""Octets: no value of a client's lies across what its processor reads at once."""


class Variable(NamedTuple):
    """What is known of one variable."""

    name: str
    type: DataType
    comment: str = ""
    is_writable: bool = False


class VariableStore(Protocol):
    """Where the values are; both methods raise AdsRefusedError, BUSY if it is only for now."""

    def read(self, name: str) -> bytes:
        """Return the octets of a value, as its type has them."""

    def write(self, name: str, octets: bytes) -> None:
        """Store the octets of a value."""


class _Symbol(NamedTuple):
    variable: Variable
    type: SymbolType
    place: SymbolPlace

    def describe(self) -> bytes:
        flags = 0 if self.variable.is_writable else SymbolFlag.READ_ONLY
        return encode_entry(
            SymbolEntry(
                self.place,
                self.type.id,
                flags,
                self.variable.name,
                self.type.name,
                self.variable.comment,
            )
        )

    def describe_handle(self, handle: int) -> bytes:
        name = encode_text(self.type.name)
        return HandleInfo(handle, self.type.size, 0, len(name)).encode() + name + b"\0"


class SymbolTable:
    """All symbols of one configuration.

    Args:
        variables: In the order in which they are told.
        version: Counts configurations; 8 bits of it are told.
    """

    def __init__(self, variables: Iterable[Variable], version: int) -> None:
        self.version = version & 0xFF
        self._symbols: list[_Symbol] = []
        offset = 0
        for variable in variables:
            kind = symbol_type(variable.type)
            place = SymbolPlace(IndexGroup.DATA, offset, kind.size)
            self._symbols.append(_Symbol(variable, kind, place))
            offset += kind.size + -kind.size % _ALIGNMENT
        self._offsets = [symbol.place.offset for symbol in self._symbols]
        self._indexes = {symbol.variable.name: n for n, symbol in enumerate(self._symbols)}
        self._folded: dict[str, int | None] = {}
        for name, index in self._indexes.items():
            key = name.casefold()
            self._folded[key] = None if key in self._folded else index
        self._types = {
            entry.name: encode_data_type(entry)
            for symbol in self._symbols
            for entry in symbol.type.describe()
        }
        self.upload = b"".join(symbol.describe() for symbol in self._symbols)
        self.type_upload = b"".join(self._types.values())

    @property
    def info(self) -> UploadInfo:
        """How much there is to upload."""
        return UploadInfo(
            len(self._symbols), len(self.upload), len(self._types), len(self.type_upload)
        )

    def data_type(self, name: str) -> bytes:
        """Return the entry of a type that symbols have; refuse with SYMBOL_NOT_FOUND."""
        try:
            return self._types[name.upper()]
        except KeyError:
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND) from None

    def handle_of(self, name: str) -> int:
        """Return the handle of a symbol; refuse with SYMBOL_NOT_FOUND."""
        index = self._indexes.get(name)
        if index is None:
            index = self._folded.get(name.casefold())
        if index is None:
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND)
        return self.version << _INDEX_BITS | index + 1

    def by_handle(self, handle: int) -> _Symbol:
        """Return a symbol; refuse handles of other tables, and those that never were any."""
        if handle >> _INDEX_BITS != self.version:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION)
        index = (handle & (1 << _INDEX_BITS) - 1) - 1
        if not 0 <= index < len(self._symbols):
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND)
        return self._symbols[index]

    def at(self, offset: int) -> tuple[_Symbol, int]:
        """Return the symbol that *offset* lies in, and how far; refuse with INDEX_OFFSET."""
        index = bisect_right(self._offsets, offset) - 1
        if index < 0 or offset >= self._offsets[index] + self._symbols[index].place.size:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return self._symbols[index], offset - self._offsets[index]


class SymbolSpace(AdsSpace):
    """The index groups of symbols.

    Args:
        table: Of the configuration that runs.
        store: The values of that configuration.
    """

    groups: Collection[int] = frozenset(
        (
            IndexGroup.DATA,
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
        """Go over to another configuration; what watches the old one ends."""
        self._table = table
        self._store = store

    def read(self, group: int, offset: int, length: int) -> bytes:
        """Return a value, or as much as fits; of a list, only the whole."""
        if group == IndexGroup.SYMBOL_VERSION:
            return bytes((self._table.version,))[:length]
        if group == IndexGroup.SYMBOL_UPLOAD_INFO:
            return self._table.info.encode()[: min(length, 8)]
        if group == IndexGroup.SYMBOL_UPLOAD_INFO_2:
            return self._table.info.encode()[:length]
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
        symbol, start = self._find(group, offset)
        if start:
            raise AdsRefusedError(AdsError.SIZE)
        if not symbol.variable.is_writable:
            raise AdsRefusedError(AdsError.ACCESS)
        self._store.write(symbol.variable.name, symbol.type.from_client(data))

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Return what belongs to the name in *data*."""
        if group not in _BY_NAME:
            return super().read_write(group, offset, length, data)
        name = decode_name(data)
        if group == IndexGroup.DATA_TYPE_BY_NAME:
            return _whole(self._table.data_type(name), length)
        handle = self._table.handle_of(name)
        symbol = self._table.by_handle(handle)
        if group == IndexGroup.VALUE_BY_NAME:
            return self._value(symbol)[:length]
        if group == IndexGroup.SYMBOL_HANDLE:
            info = symbol.describe_handle(handle)
            return _whole(info if len(info) <= length else info[:4], length)
        if group == IndexGroup.SYMBOL_BY_NAME:
            return _whole(symbol.place.encode(), length)
        return _whole(symbol.describe(), length)

    def watch(self, group: int, offset: int, length: int) -> Source:
        """Return what gives a value, the first *length* octets of it, or the version."""
        if group == IndexGroup.SYMBOL_VERSION:
            if length != 1:
                raise AdsRefusedError(AdsError.SIZE)
            return partial(self.read, group, 0, length)
        symbol, start = self._find(group, offset)
        if start + length > symbol.place.size:
            raise AdsRefusedError(AdsError.SIZE)
        table = self._table

        def source() -> bytes:
            if table is not self._table:
                raise AdsRefusedError(AdsError.SYMBOL_VERSION)
            return self._value(symbol)[start : start + length]

        return source

    def _find(self, group: int, offset: int) -> tuple[_Symbol, int]:
        if group == IndexGroup.DATA:
            return self._table.at(offset)
        if group in _BY_HANDLE:
            return self._table.by_handle(offset), 0
        raise AdsRefusedError(AdsError.ACCESS)

    def _value(self, symbol: _Symbol) -> bytes:
        return symbol.type.to_client(self._store.read(symbol.variable.name))


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
