"""Our data types as ADS clients know them: type id, name, size, and octets back and forth.

Numbers of odd widths are widened to the next type that IEC 61131-3 has, so that every client can
read them; texts get the NUL at their end that a PLC's strings have.
"""

from __future__ import annotations

from typing import NamedTuple

from eap.ads.operation import AdsRefusedError
from eap.codec.ads import AdsError
from eap.codec.adsdatatype import DataTypeEntry
from eap.codec.adssymbol import AdsType
from eap.codec.values import Array, Block, Boolean, DataType, Integer, Real, String

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
    """How values of one of our types go to ADS clients and come from them."""

    kind: DataType
    id: AdsType
    name: str
    """As IEC 61131-3 writes it."""
    size: int
    """Octets for a client."""

    def describe(self) -> list[DataTypeEntry]:
        """Return what clients may want to know of this type, and of its elements."""
        if isinstance(self.kind, Array):
            (of,) = symbol_type(self.kind.element).describe()
        elif isinstance(self.kind, Block):
            of = DataTypeEntry("BYTE", AdsType.UINT8, 1)
        else:
            return [DataTypeEntry(self.name, self.id, self.size)]
        return [of, DataTypeEntry(self.name, self.id, self.size, of.name, self.size // of.size)]

    def to_client(self, octets: bytes) -> bytes:
        """Return what a client reads of a value; *octets* are those of our type."""
        if self.size == self.kind.size:
            return octets
        if isinstance(self.kind, String):
            return octets + b"\0"
        return self._resized(octets, _element(self.kind).size, self.size // self.kind.count)

    def from_client(self, data: bytes) -> bytes:
        """Return the octets of our type for what a client writes.

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
    if isinstance(kind, Block):
        return SymbolType(kind, AdsType.UINT8, f"ARRAY [0..{kind.size - 1}] OF BYTE", kind.size)
    element = _element(kind)
    type_id, name, size = _scalar(element)
    if isinstance(kind, Array):
        name = f"ARRAY [0..{kind.count - 1}] OF {name}"
    return SymbolType(kind, type_id, name, size * kind.count)


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
