"""Process data of a slave by PDO assignment and mapping of its dictionary (ETG.1000.6).

0x1C12 and 0x1C13 assign the PDOs, each PDO maps entries with their bit lengths.  The mapping is
evaluated when the slave leaves PREOP; from then on the dictionary refuses changes.
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
    """Mapped entry with its bits in the process data; None is padding."""

    entry: Entry | None
    start: int
    bits: int


class _ByteRun(NamedTuple):
    """Entry on whole bytes, *first* to *end*."""

    entry: Entry
    first: int
    end: int


class _BitRun(NamedTuple):
    """Entries that share the bytes from *first* to *end*, each with shift and mask."""

    fields: tuple[tuple[Entry, int, int], ...]
    first: int
    end: int
    is_small: bool
    """True if every entry is one byte, as those of digital inputs and outputs are."""


class PdoMapping:
    """Mapping of all outputs, of all inputs, or of one PDO.

    Attributes:
        entries: Mapped entries in order.
        size: Size in bytes.
    """

    def __init__(self, entries: Iterable[MappedEntry] = ()) -> None:
        self.entries = tuple(entries)
        self.size = (sum(mapped.bits for mapped in self.entries) + 7) // 8
        self._runs = tuple(_runs(self.entries))

    def unpack(self, data: bytes) -> None:
        """Set the entries from *data*."""
        for run in self._runs:
            if isinstance(run, _ByteRun):
                run.entry.octets = data[run.first : run.end]
                continue
            word = int.from_bytes(data[run.first : run.end], "little")
            if run.is_small:
                # Digital terminals have hardly anything else: their bytes exist once for all.
                for entry, shift, mask in run.fields:
                    entry.octets = _OCTETS[word >> shift & mask]
                continue
            for entry, shift, mask in run.fields:
                entry.octets = (word >> shift & mask).to_bytes(entry.kind.size, "little")

    def pack(self) -> bytes:
        """Return the process data of all entries."""
        pieces = []
        for run in self._runs:
            size = run.end - run.first
            if isinstance(run, _ByteRun):
                octets = run.entry.octets
                pieces.append(octets if len(octets) == size else octets[:size].ljust(size, b"\0"))
                continue
            word = 0
            if run.is_small:
                for entry, shift, mask in run.fields:
                    word |= (entry.octets[0] & mask) << shift
            else:
                for entry, shift, mask in run.fields:
                    word |= (int.from_bytes(entry.octets, "little") & mask) << shift
            pieces.append(word.to_bytes(size, "little"))
        return b"".join(pieces)


class ProcessChannel:
    """Sync manager of process data.

    Args:
        number: Number of the sync manager.
        assignment: Object that assigns its PDOs.
        is_output: True if the master writes it.
        fixed_size: Size in bytes without PDOs.
        is_single: True for one buffer (mode of a mailbox) instead of three.

    Attributes:
        mapping: Mapping, evaluated by :meth:`ProcessData.configure`.
    """

    def __init__(
        self,
        number: int,
        assignment: int,
        *,
        is_output: bool,
        fixed_size: int = 0,
        is_single: bool = False,
    ) -> None:
        self.number = number
        self.assignment = assignment
        self.is_output = is_output
        self.is_single = is_single
        self.mapping = PdoMapping()
        self._fixed_size = fixed_size

    @property
    def size(self) -> int:
        """Size in bytes."""
        return self.mapping.size or self._fixed_size


class ProcessData:
    """Outputs and inputs of one slave.

    Args:
        dictionary: Objects of the device.
        channels: Its sync managers of process data; by default 2 for outputs and 3 for inputs.

    Attributes:
        channels: All sync managers.
        active_outputs, active_inputs: Those with data.
    """

    def __init__(
        self, dictionary: ObjectDictionary, channels: Iterable[ProcessChannel] | None = None
    ) -> None:
        self._dictionary = dictionary
        if channels is None:
            channels = (
                ProcessChannel(2, OUTPUTS, is_output=True),
                ProcessChannel(3, INPUTS, is_output=False),
            )
        self.channels = tuple(channels)
        self.active_outputs: tuple[ProcessChannel, ...] = ()
        self.active_inputs: tuple[ProcessChannel, ...] = ()

    @property
    def outputs(self) -> PdoMapping:
        """Mapping of the first sync manager of outputs."""
        return self._first(is_output=True)

    @property
    def inputs(self) -> PdoMapping:
        """Mapping of the first sync manager of inputs."""
        return self._first(is_output=False)

    def _first(self, *, is_output: bool) -> PdoMapping:
        found = (each.mapping for each in self.channels if each.is_output is is_output)
        return next(found, PdoMapping())

    def configure(self) -> None:
        """Evaluate assignment and mapping; a mapped entry that does not exist is padding."""
        for channel in self.channels:
            channel.mapping = self._plan(self._numbers(channel.assignment))
        active = [each for each in self.channels if each.size]
        self.active_outputs = tuple(each for each in active if each.is_output)
        self.active_inputs = tuple(each for each in active if not each.is_output)

    def read_pdo(self, index: int) -> bytes | None:
        """Return the data of one PDO, assigned or not; None if it does not exist."""
        return self._plan([index]).pack() if index in self._dictionary else None

    def write_pdo(self, index: int, data: bytes) -> bool:
        """Set the entries of one PDO; return False for another size."""
        plan = self._plan([index])
        if index not in self._dictionary or len(data) != plan.size:
            return False
        plan.unpack(data)
        return True

    def _plan(self, pdos: Iterable[int]) -> PdoMapping:
        entries = []
        end = 0
        for pdo in pdos:
            for mapping in self._numbers(pdo):
                # Index, subindex and bits, from the highest byte on (ETG.1000.6).
                bits = mapping & 0xFF
                entries.append(
                    MappedEntry(self._entry(mapping >> 16, mapping >> 8 & 0xFF), end, bits)
                )
                end += bits
        return PdoMapping(entries)

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


def _runs(entries: Iterable[MappedEntry]) -> Iterator[_ByteRun | _BitRun]:
    """Group entries that share bytes; an entry with bytes of its own is copied as a whole."""
    fields: list[tuple[Entry, int, int]] = []
    first = end = 0
    for mapped in entries:
        aligned = end == 8 * first
        end = mapped.start + mapped.bits
        if aligned and mapped.entry is not None and mapped.bits == 8 * mapped.entry.kind.size:
            yield _ByteRun(mapped.entry, first, end // 8)
            first = end // 8
            continue
        if mapped.entry is not None:
            mask = min((1 << mapped.bits) - 1, (1 << 8 * mapped.entry.kind.size) - 1)
            fields.append((mapped.entry, mapped.start - 8 * first, mask))
        if not end % 8:
            yield _bits(fields, first, end // 8)
            fields, first = [], end // 8
    if end > 8 * first:
        yield _bits(fields, first, (end + 7) // 8)


def _bits(fields: list[tuple[Entry, int, int]], first: int, end: int) -> _BitRun:
    is_small = all(entry.kind.size == 1 and not entry.is_text for entry, _, _ in fields)
    return _BitRun(tuple(fields), first, end, is_small)
