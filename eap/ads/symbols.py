"""ADS symbols: the variables of one configuration, their types, handles and values.

Numbers of odd widths are widened to the next type that IEC 61131-3 has, so that every client can
read them; texts get the NUL at their end that a PLC's strings have.

A handle is made of the version of the table and the index of the symbol in it.  So nothing is kept
for a client, a handle outlives its connection, and one of an older table is refused as such.  Case
does not matter in a name, unless it makes two names of one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Collection, Iterable
from functools import cached_property, partial
from typing import NamedTuple, Protocol

from eap.ads.request import AdsRefusedError
from eap.ads.space import AdsSpace, Source
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adssymbol import (
    AdsType,
    DataTypeEntry,
    HandleInfo,
    SymbolAddress,
    SymbolEntry,
    SymbolFlag,
    UploadInfo,
    decode_name,
    encode_data_type,
    encode_entry,
    encode_text,
)
from eap.codec.datatypes import Array, Boolean, DataType, Integer, Real, String

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


class SymbolType(NamedTuple):
    """ADS form of one of our types, with conversion of values both ways."""

    kind: DataType
    id: AdsType
    name: str
    """As IEC 61131-3 writes it."""
    size: int
    """Bytes for a client."""

    def describe(self) -> list[DataTypeEntry]:
        """Return the data type entries of this type and of its elements."""
        if _is_bytes(self.kind):
            of = DataTypeEntry("BYTE", AdsType.UINT8, 1)
        elif isinstance(self.kind, Array):
            (of,) = symbol_type(self.kind.element).describe()
        else:
            return [DataTypeEntry(self.name, self.id, self.size)]
        return [of, DataTypeEntry(self.name, self.id, self.size, of.name, self.size // of.size)]

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
        if isinstance(self.kind, String):
            return self._from_text(data)
        if len(data) != self.size:
            raise AdsRefusedError(AdsError.SIZE)
        if isinstance(self.kind, Boolean):
            return bytes((any(data),))
        element = _element(self.kind)
        if self.size != self.kind.size:
            return self._resized(data, self.size // self.kind.count, element.size)
        if element.is_bits and data[0] >> element.bit_length:
            raise AdsRefusedError(AdsError.VALUE)
        return data

    def _from_text(self, data: bytes) -> bytes:
        if len(data) > self.size:
            raise AdsRefusedError(AdsError.SIZE)
        text, _, _ = data.partition(b"\0")
        if len(text) > self.kind.size:
            raise AdsRefusedError(AdsError.SIZE)
        return text.ljust(self.kind.size, b"\0")

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


def symbol_type(kind: DataType) -> SymbolType:
    """Return how clients know *kind*."""
    if isinstance(kind, String):
        return SymbolType(kind, AdsType.STRING, f"STRING({kind.size})", kind.size + 1)
    if _is_bytes(kind):
        return SymbolType(kind, AdsType.UINT8, f"ARRAY [0..{kind.size - 1}] OF BYTE", kind.size)
    element = _element(kind)
    type_id, name, size = _scalar(element)
    if isinstance(kind, Array):
        name = f"ARRAY [0..{kind.count - 1}] OF {name}"
    return SymbolType(kind, type_id, name, size * kind.count)


def _is_bytes(kind: DataType) -> bool:
    """Return whether clients know *kind* as bytes: it is neither a text nor made of numbers."""
    return not isinstance(kind, String) and not isinstance(_element(kind), Boolean | Integer | Real)


def _element(kind: DataType) -> DataType:
    return kind.element if isinstance(kind, Array) else kind


def _scalar(kind: DataType) -> tuple[AdsType, str, int]:
    if isinstance(kind, Boolean):
        return AdsType.BIT, "BOOL", 1
    if isinstance(kind, Real):
        return *_REALS[kind.size], kind.size
    signed = isinstance(kind, Integer) and kind.signed
    size = next(size for size in (1, 2, 4, 8) if size >= kind.size)
    type_id, name = _INTEGERS[signed, size]
    # BYTE, WORD and DWORD keep their names; only their ids are those of numbers.
    own = kind.text if kind.text in {"BYTE", "WORD", "DWORD"} else name
    return type_id, own, size


_INDEX_BITS = 24
# Clients take texts without it for texts in the code page of TwinCAT.
_UTF_8 = (("TcEncoding", "UTF-8"),)
"""Attribute of texts."""
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
    """One variable, how clients know its type, and where they find it."""

    variable: SymbolVariable
    type: SymbolType
    address: SymbolAddress

    def describe(self) -> bytes:
        """Return its entry."""
        flags = SymbolFlag.READ_ONLY if self.variable.read_only else 0
        return encode_entry(
            SymbolEntry(
                self.address,
                self.type.id,
                flags,
                self.variable.name,
                self.type.name,
                self.variable.comment,
                _UTF_8 if self.type.id == AdsType.STRING else (),
            )
        )

    def describe_handle(self, handle: int) -> bytes:
        """Return *handle* with size and name of its type."""
        name = encode_text(self.type.name)
        return HandleInfo(handle, self.type.size, 0, len(name)).encode() + name + b"\0"


class SymbolTable:
    """All symbols of one configuration.

    Args:
        variables: In the order of the upload.
        version: Counts configurations; clients see 8 bits of it.
    """

    def __init__(self, variables: Iterable[SymbolVariable], version: int) -> None:
        self.version = version & 0xFF
        self._symbols: list[Symbol] = []
        offset = 0
        for variable in variables:
            kind = symbol_type(variable.type)
            address = SymbolAddress(IndexGroup.DATA, offset, kind.size)
            self._symbols.append(Symbol(variable, kind, address))
            offset += kind.size + -kind.size % _ALIGNMENT
        self._offsets = [symbol.address.offset for symbol in self._symbols]
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
        # Plus 1: no handle is 0, even with version 0.
        return self.version << _INDEX_BITS | index + 1

    def by_handle(self, handle: int) -> Symbol:
        """Return a symbol; refuse handles of other tables, and those that never were any."""
        if handle >> _INDEX_BITS != self.version:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION)
        index = (handle & (1 << _INDEX_BITS) - 1) - 1
        if not 0 <= index < len(self._symbols):
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND)
        return self._symbols[index]

    def successor_of(self, symbol: Symbol) -> Symbol:
        """Return the symbol here for *symbol* of an older table; refuse with SYMBOL_VERSION."""
        index = self._indexes.get(symbol.variable.name)
        if index is None or self._symbols[index].type != symbol.type:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION)
        return self._symbols[index]

    def at(self, offset: int) -> tuple[Symbol, int]:
        """Return the symbol that *offset* lies in, and how far; refuse with INDEX_OFFSET."""
        index = bisect_right(self._offsets, offset) - 1
        if index < 0 or offset >= self._offsets[index] + self._symbols[index].address.size:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return self._symbols[index], offset - self._offsets[index]


class VariableStore(Protocol):
    """Store of the values; both methods raise AdsRefusedError, BUSY for a passing reason."""

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
        symbol, start = self._find(group, offset)
        if start:
            raise AdsRefusedError(AdsError.SIZE)
        if symbol.variable.read_only:
            why = f"{symbol.variable.name} {symbol.variable.read_only}"
            raise AdsRefusedError(AdsError.ACCESS, why)
        self._store.write(symbol.variable.name, symbol.type.from_client(data))

    def read_write(self, group: int, offset: int, length: int, data: bytes) -> bytes:
        """Return value, handle or description of the name in *data*."""
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
