"""Mapping entries: which variable lies where in a PDO, and what cannot be mapped.

An entry is index, sub-index and bit length in 16, 8 and 8 bits.  Bits pack, everything else starts
on a whole octet, so a mapping has padding (index 0) exactly where bits end in the middle of an
octet and something else follows; at the end it may be left out.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from eap.codec.datatypes import DataType
from eap.ids import ObjectId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import Access, OdObject
from eap.od.profiles.eap1000 import MAX_ENTRIES, WHOLE


class MappingEntry(NamedTuple):
    """One mapping entry."""

    target: int
    """Index of the object; 0 is padding."""
    subindex: int
    bits: int

    @classmethod
    def decode(cls, word: int) -> MappingEntry:
        """Take an entry's 32 bits apart."""
        return cls(word >> 16, word >> 8 & 0xFF, word & 0xFF)

    def encode(self) -> int:
        """Return the 32 bits."""
        return self.target << 16 | self.subindex << 8 | self.bits


class MappingLayout(NamedTuple):
    """What a whole mapping amounts to."""

    indexes: tuple[int, ...]
    """Objects of the variables, in order."""
    octets: int


def encode_mapping(variables: Iterable[tuple[int, DataType]]) -> list[int]:
    """Return the entries that map *variables* (index of the object, type), padding included.

    Raises:
        ValueError: there are more entries than a mapping has.
    """
    words: list[int] = []
    end = 0
    for index, kind in variables:
        if not kind.is_bits and end % 8:
            gap = -end % 8
            words.append(MappingEntry(0, 0, gap).encode())
            end += gap
        words.append(MappingEntry(index, 1, min(kind.bit_length, WHOLE)).encode())
        end += kind.bit_length
    if len(words) > MAX_ENTRIES:
        raise ValueError(
            f"a mapping has at most {MAX_ENTRIES} entries, this PD needs {len(words)} "
            f"(padding included)"
        )
    return words


def check_mapped(
    dictionary: ObjectDictionary, word: int, right: Access, index: int, subindex: int
) -> None:
    """Refuse an entry that maps what is not there, not mappable with *right*, or of another size.

    Raises:
        SdoAbortError: NO_OBJECT, NO_SUBINDEX, NOT_STORED, NOT_MAPPABLE or LENGTH.
    """
    mapped = MappingEntry.decode(word)
    if not mapped.target:
        if mapped.subindex or not 0 < mapped.bits < 8:
            detail = f"padding of sub-index {mapped.subindex} and {mapped.bits} bits"
            raise SdoAbortError(AbortCode.NOT_MAPPABLE, index, subindex, f"{detail}: 1 to 7 bits")
        return
    try:
        entry = dictionary.entry(mapped.target, mapped.subindex)
    except SdoAbortError as exc:
        raise SdoAbortError(exc.code, index, subindex, f"maps {exc}") from None
    what = f"{ObjectId(mapped.target, mapped.subindex)} ({entry.name})"
    if not entry.access & right:
        raise SdoAbortError(AbortCode.NOT_MAPPABLE, index, subindex, what)
    expected = min(entry.kind.bit_length, WHOLE)
    if mapped.bits != expected:
        detail = (
            f"{what} is {entry.kind.text}, mapped with {mapped.bits} bits instead of {expected}"
        )
        raise SdoAbortError(AbortCode.LENGTH, index, subindex, detail)


def lay_out_mapping(
    dictionary: ObjectDictionary, index: int, count: int, limit: int
) -> MappingLayout:
    """Return what the first *count* entries of the mapping at *index* amount to.

    Raises:
        SdoAbortError: PARAMETER for padding that is missing or too much, PDO_LENGTH for more than
            *limit* octets, and what :meth:`ObjectDictionary.entry` raises for what is gone.
    """
    entries = dictionary[index].entries
    indexes = []
    end = 0
    for subindex in range(1, count + 1):
        mapped = MappingEntry.decode(entries[subindex].value)
        if not mapped.target:
            follows = subindex < count and _is_whole(dictionary, entries[subindex + 1].value)
            if end % 8 + mapped.bits != 8 or not (follows or subindex == count):
                detail = f"{mapped.bits} bits of padding behind {end} bits are not needed"
                raise SdoAbortError(AbortCode.PARAMETER, index, subindex, detail)
            end += mapped.bits
            continue
        kind = dictionary.entry(mapped.target, mapped.subindex).kind
        if not kind.is_bits and end % 8:
            detail = f"{kind.text} behind {end} bits: {-end % 8} bits of padding are missing"
            raise SdoAbortError(AbortCode.PARAMETER, index, subindex, detail)
        indexes.append(mapped.target)
        end += kind.bit_length
    octets = -(-end // 8)
    if octets > limit:
        detail = f"{octets} octets, the largest frame of this port has room for {limit}"
        raise SdoAbortError(AbortCode.PDO_LENGTH, index, 0, detail)
    return MappingLayout(tuple(indexes), octets)


def mapped_bits(dictionary: ObjectDictionary, item: OdObject) -> int:
    """Return the bits of the entries in force of a mapping, as far as what they map exists."""
    bits = 0
    for subindex in range(1, item.max_subindex + 1):
        mapped = MappingEntry.decode(item.entries[subindex].value)
        if mapped.target in dictionary:
            bits += dictionary[mapped.target].entries[mapped.subindex].kind.bit_length
        elif not mapped.target:
            bits += mapped.bits
    return bits


def _is_whole(dictionary: ObjectDictionary, word: int) -> bool:
    mapped = MappingEntry.decode(word)
    return bool(mapped.target) and not dictionary.entry(mapped.target, mapped.subindex).kind.is_bits
