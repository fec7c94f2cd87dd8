"""Process data of a slave: the PDOs that its object dictionary assigns, packed and unpacked.

0x1C12 and 0x1C13 name the PDOs, each PDO the entries with their bits (ETG.1000.6).  The plan is
made when the slave leaves PreOp; from then on the dictionary refuses to change it.
"""

from __future__ import annotations

from typing import NamedTuple

from eap.od.dictionary import ObjectDictionary
from eap.od.model import Entry

OUTPUTS = 0x1C12
INPUTS = 0x1C13


class Mapped(NamedTuple):
    """An entry and the bits of the process data that it has; None is padding."""

    entry: Entry | None
    start: int
    bits: int


class Side(NamedTuple):
    """All outputs or all inputs."""

    parts: tuple[Mapped, ...] = ()
    size: int = 0
    """Octets."""


class ProcessData:
    """Outputs and inputs of one slave, as its dictionary maps them now.

    Attributes:
        outputs, inputs: The plans; :meth:`configure` makes them.
    """

    def __init__(self, dictionary: ObjectDictionary) -> None:
        self._dictionary = dictionary
        self.outputs = Side()
        self.inputs = Side()

    def configure(self) -> None:
        """Read assignment and mapping; what maps an entry that does not exist counts as padding."""
        self.outputs = self._plan(OUTPUTS)
        self.inputs = self._plan(INPUTS)

    def write_outputs(self, data: bytes) -> None:
        """Give the octets of a master's outputs to their entries."""
        word = int.from_bytes(data, "little")
        for entry, start, bits in self.outputs.parts:
            if entry is None:
                continue
            if start % 8 or bits % 8:
                value = word >> start & (1 << bits) - 1
                entry.octets = value.to_bytes(entry.kind.size, "little")
            else:
                entry.octets = data[start // 8 : (start + bits) // 8]

    def read_inputs(self) -> bytes:
        """Return the octets of the inputs."""
        data = bytearray(self.inputs.size)
        for entry, start, bits in self.inputs.parts:
            if entry is None:
                continue
            first, shift = divmod(start, 8)
            if not shift and not bits % 8:
                data[first : first + bits // 8] = entry.octets.ljust(bits // 8, b"\0")
                continue
            value = (int.from_bytes(entry.octets, "little") & (1 << bits) - 1) << shift
            end = first + (shift + bits + 7) // 8
            old = int.from_bytes(data[first:end], "little")
            data[first:end] = (old | value).to_bytes(end - first, "little")
        return bytes(data)

    def _plan(self, assignment: int) -> Side:
        parts = []
        end = 0
        for pdo in self._numbers(assignment):
            for mapping in self._numbers(pdo):
                bits = mapping & 0xFF
                parts.append(Mapped(self._entry(mapping >> 16, mapping >> 8 & 0xFF), end, bits))
                end += bits
        return Side(tuple(parts), (end + 7) // 8)

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
