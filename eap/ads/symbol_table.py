"""The variables of one configuration as ADS symbols: names, places, types and handles.

A handle is made of the version of the table and the place of the symbol in it.  So nothing is kept
for a client, a handle outlives its connection, and one of an older table is refused as such.  Case
does not matter in a name, unless it makes two names of one.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable
from functools import cached_property
from typing import NamedTuple

from eap.ads.operation import AdsRefusedError
from eap.ads.types import SymbolType, symbol_type
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsdatatype import encode_data_type
from eap.codec.adssymbol import (
    AdsType,
    HandleInfo,
    SymbolEntry,
    SymbolFlag,
    SymbolPlace,
    UploadInfo,
    encode_entry,
    encode_text,
)
from eap.codec.values import DataType

_INDEX_BITS = 24
_UTF_8 = (("TcEncoding", "UTF-8"),)
"""Attribute of texts; clients take those without for texts in the code page of TwinCAT."""
_ALIGNMENT = 8
"""Octets: no value of a client's lies across what its processor reads at once."""


class Variable(NamedTuple):
    """What is known of one variable."""

    name: str
    type: DataType
    comment: str = ""
    read_only: str = ""
    """Why clients do not write it, as what follows its name; empty if they do."""


class Symbol(NamedTuple):
    """One variable, how clients know its type, and where they find it."""

    variable: Variable
    type: SymbolType
    place: SymbolPlace

    def describe(self) -> bytes:
        """Return its entry."""
        flags = SymbolFlag.READ_ONLY if self.variable.read_only else 0
        return encode_entry(
            SymbolEntry(
                self.place,
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
        variables: In the order in which they are told.
        version: Counts configurations; 8 bits of it are told.
    """

    def __init__(self, variables: Iterable[Variable], version: int) -> None:
        self.version = version & 0xFF
        self._symbols: list[Symbol] = []
        offset = 0
        for variable in variables:
            kind = symbol_type(variable.type)
            place = SymbolPlace(IndexGroup.DATA, offset, kind.size)
            self._symbols.append(Symbol(variable, kind, place))
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
        self.type_upload = b"".join(self._types.values())

    @cached_property
    def upload(self) -> bytes:
        """All entries; made when the first client asks, for a large table takes its time."""
        return b"".join(symbol.describe() for symbol in self._symbols)

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

    def by_handle(self, handle: int) -> Symbol:
        """Return a symbol; refuse handles of other tables, and those that never were any."""
        if handle >> _INDEX_BITS != self.version:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION)
        index = (handle & (1 << _INDEX_BITS) - 1) - 1
        if not 0 <= index < len(self._symbols):
            raise AdsRefusedError(AdsError.SYMBOL_NOT_FOUND)
        return self._symbols[index]

    def successor_of(self, symbol: Symbol) -> Symbol:
        """Return what *symbol* of an older table is here; refuse with SYMBOL_VERSION."""
        index = self._indexes.get(symbol.variable.name)
        if index is None or self._symbols[index].type != symbol.type:
            raise AdsRefusedError(AdsError.SYMBOL_VERSION)
        return self._symbols[index]

    def at(self, offset: int) -> tuple[Symbol, int]:
        """Return the symbol that *offset* lies in, and how far; refuse with INDEX_OFFSET."""
        index = bisect_right(self._offsets, offset) - 1
        if index < 0 or offset >= self._offsets[index] + self._symbols[index].place.size:
            raise AdsRefusedError(AdsError.INDEX_OFFSET)
        return self._symbols[index], offset - self._offsets[index]
