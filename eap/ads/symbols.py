"""The values of ADS symbols, by name, by handle and by place; and the lists of the symbols."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from typing import Protocol

from eap.ads.operation import AdsRefusedError
from eap.ads.space import AdsSpace, Source
from eap.ads.symbol_table import Symbol, SymbolTable
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adssymbol import decode_name


class VariableStore(Protocol):
    """Where the values are; both methods raise AdsRefusedError, BUSY if it is only for now."""

    def read(self, name: str) -> bytes:
        """Return the octets of a value, as its type has them."""

    def write(self, name: str, octets: bytes) -> None:
        """Store the octets of a value."""


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
        """Go over to another configuration.

        Who watches what is in both, with one type, goes on watching; what is gone ends.
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
        symbol, start = self._find(group, offset)
        if start:
            raise AdsRefusedError(AdsError.SIZE)
        if symbol.variable.read_only:
            why = f"{symbol.variable.name} {symbol.variable.read_only}"
            raise AdsRefusedError(AdsError.ACCESS, why)
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
            nonlocal symbol, table
            if table is not self._table:
                symbol, table = self._table.successor_of(symbol), self._table
            return self._value(symbol)[start : start + length]

        return source

    def _find(self, group: int, offset: int) -> tuple[Symbol, int]:
        if group == IndexGroup.DATA:
            return self._table.at(offset)
        if group in _BY_HANDLE:
            return self._table.by_handle(offset), 0
        raise AdsRefusedError(AdsError.ACCESS)

    def _value(self, symbol: Symbol) -> bytes:
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
