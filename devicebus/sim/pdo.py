"""Process data of a slave: the PDOs that its object dictionary assigns, packed and unpacked.

0x1C12 and 0x1C13 name the PDOs, each PDO the entries with their bits (ETG.1000.6).  The plan is
made when the slave leaves PreOp; from then on the dictionary refuses to change it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry

OUTPUTS = 0x1C12
INPUTS = 0x1C13
_OCTETS = tuple(bytes((value,)) for value in range(0x100))


class MappedEntry(NamedTuple):
    """An entry and the bits of the process data that it has; None is padding."""

    entry: Entry | None
    start: int
    bits: int


class _ByteRun(NamedTuple):
    """An entry on whole bytes, *first* to *end*."""

    entry: Entry
    first: int
    end: int


class _BitRun(NamedTuple):
    """What shares the bytes from *first* to *end*: entries, and the shift and mask of each."""

    places: tuple[tuple[Entry, int, int], ...]
    first: int
    end: int
    is_small: bool
    """Whether every entry is one byte, as those of digital inputs and outputs are."""


class PdoMapping:
    """All outputs or all inputs, or one PDO.

    Attributes:
        parts: What is mapped, in order.
        size: Bytes.
    """

    def __init__(self, parts: Iterable[MappedEntry] = ()) -> None:
        self.parts = tuple(parts)
        self.size = (sum(part.bits for part in self.parts) + 7) // 8
        self._runs = tuple(_runs(self.parts))

    def unpack(self, data: bytes) -> None:
        """Give the bytes of *data* to the entries."""
        for run in self._runs:
            if isinstance(run, _ByteRun):
                run.entry.octets = data[run.first : run.end]
                continue
            word = int.from_bytes(data[run.first : run.end], "little")
            if run.is_small:
                for entry, shift, mask in run.places:
                    entry.octets = _OCTETS[word >> shift & mask]
                continue
            for entry, shift, mask in run.places:
                entry.octets = (word >> shift & mask).to_bytes(entry.kind.size, "little")

    def pack(self) -> bytes:
        """Return the bytes of all entries."""
        pieces = []
        for run in self._runs:
            size = run.end - run.first
            if isinstance(run, _ByteRun):
                octets = run.entry.octets
                pieces.append(octets if len(octets) == size else octets[:size].ljust(size, b"\0"))
                continue
            word = 0
            if run.is_small:
                for entry, shift, mask in run.places:
                    word |= (entry.octets[0] & mask) << shift
            else:
                for entry, shift, mask in run.places:
                    word |= (int.from_bytes(entry.octets, "little") & mask) << shift
            pieces.append(word.to_bytes(size, "little"))
        return b"".join(pieces)


class ProcessData:
    """Outputs and inputs of one slave, as its dictionary maps them now.

    Attributes:
        outputs, inputs: The plans; :meth:`configure` makes them.
    """

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self.outputs = PdoMapping()
        self.inputs = PdoMapping()

    def configure(self) -> None:
        """Read assignment and mapping; what maps an entry that does not exist counts as padding."""
        self.outputs = self._plan(self._numbers(OUTPUTS))
        self.inputs = self._plan(self._numbers(INPUTS))

    def read_pdo(self, index: int) -> bytes | None:
        """Return the bytes of one PDO, assigned or not; None if it is not there."""
        return self._plan([index]).pack() if index in self._dictionary else None

    def write_pdo(self, index: int, data: bytes) -> bool:
        """Give the bytes of one PDO to its entries; return False if it has not this size."""
        plan = self._plan([index])
        if index not in self._dictionary or len(data) != plan.size:
            return False
        plan.unpack(data)
        return True

    def _plan(self, pdos: Iterable[int]) -> PdoMapping:
        parts = []
        end = 0
        for pdo in pdos:
            for mapping in self._numbers(pdo):
                bits = mapping & 0xFF
                parts.append(
                    MappedEntry(self._entry(mapping >> 16, mapping >> 8 & 0xFF), end, bits)
                )
                end += bits
        return PdoMapping(parts)

    def _numbers(self, index: int) -> list[int]:
        if index not in self._dictionary:
            return []
        item = self._dictionary[index]
        return [
            int.from_bytes(item.entries[sub].octets, "little")
            for sub in range(1, item.max_subindex + 1)
            if sub in item.entries
        ]

    def _entry(self, index: int, subindex: int) -> Entry | None:
        if index not in self._dictionary:
            return None
        return self._dictionary[index].entries.get(subindex)


def _runs(parts: Iterable[MappedEntry]) -> Iterator[_ByteRun | _BitRun]:
    """Take together what shares bytes; what has bytes of its own is copied as a whole."""
    places: list[tuple[Entry, int, int]] = []
    first = end = 0
    for part in parts:
        aligned = end == 8 * first
        end = part.start + part.bits
        if aligned and part.entry is not None and part.bits == 8 * part.entry.kind.size:
            yield _ByteRun(part.entry, first, end // 8)
            first = end // 8
            continue
        if part.entry is not None:
            mask = min((1 << part.bits) - 1, (1 << 8 * part.entry.kind.size) - 1)
            places.append((part.entry, part.start - 8 * first, mask))
        if not end % 8:
            yield _bits(places, first, end // 8)
            places, first = [], end // 8
    if end > 8 * first:
        yield _bits(places, first, (end + 7) // 8)


def _bits(places: list[tuple[Entry, int, int]], first: int, end: int) -> _BitRun:
    is_small = all(entry.kind.size == 1 and not entry.is_text for entry, _, _ in places)
    return _BitRun(tuple(places), first, end, is_small)
