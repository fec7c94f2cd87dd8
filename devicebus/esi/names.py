"""Process data of a device as flat entries with unique legal names, ``Channel_1.Input``."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Container, Iterable, Iterator
from itertools import count

import msgspec

from devicebus.esi.records import EsiPdo

MAX_BITS = 0xFF
"""Bits of an entry that a mapping can say; longer padding is divided."""
_OTHER = re.compile(r"[^\w-]")


class ProcessEntry(msgspec.Struct, frozen=True):
    """Entry of a PDO; index 0 is padding."""

    pdo: int
    pdo_name: str
    is_output: bool
    index: int
    subindex: int
    bits: int
    name: str = ""
    type: str = ""


def process_entries(pdos: Iterable[EsiPdo], *, is_soe: bool = False) -> Iterator[ProcessEntry]:
    """Yield the entries of *pdos* in order, as a PDO mapping has them.

    With SoE the IDNs of each drive have a subindex of their own, so that drives do not share them.
    """
    for pdo in pdos:
        drive = pdo.drive + 1 if is_soe else 0
        for entry in pdo.entries:
            for bits in _parts(entry.bits):
                place = (entry.index, entry.subindex + drive) if entry.index else (0, 0)
                named = (entry.name, entry.type) if entry.index else ("", "")
                yield ProcessEntry(pdo.index, pdo.name, pdo.is_output, *place, bits, *named)


def _parts(bits: int) -> Iterator[int]:
    while bits:
        part = min(bits, MAX_BITS)
        yield part
        bits -= part


def name_entries(
    entries: Iterable[ProcessEntry], assigned: Container[int]
) -> list[tuple[str, ProcessEntry]]:
    """Return the entries that are no padding with unique names, those of *assigned* PDOs first.

    A name that several entries of the assigned PDOs have gets the object of each.
    """
    named = [(entry_name(each), each) for each in entries if each.index]
    first = [each for each in named if each[1].pdo in assigned]
    others = [each for each in named if each[1].pdo not in assigned]
    # An optional PDO often has entries of the same names: those in use by default stay plain.
    counts = Counter(name for name, _ in first)
    taken = {name for name, times in counts.items() if times == 1}
    result = []
    for name, entry in first:
        result.append((_free(name, entry, taken) if counts[name] > 1 else name, entry))
        taken.add(result[-1][0])
    for name, entry in others:
        result.append((_free(name, entry, taken) if name in taken else name, entry))
        taken.add(result[-1][0])
    return result


def entry_name(entry: ProcessEntry) -> str:
    """Return PDO and name of an entry, without characters that a variable cannot have."""
    own = legal(entry.name) or f"{entry.index:04X}_{entry.subindex:02X}"
    return f"{legal(entry.pdo_name)}.{own}" if entry.pdo_name else own


def legal(text: str) -> str:
    """Return *text* with letters, digits, underscores and hyphens only."""
    return _OTHER.sub("_", text)


def _free(name: str, entry: ProcessEntry, taken: set[str]) -> str:
    longer = f"{name}_{entry.index:04X}_{entry.subindex:02X}"
    if longer not in taken:
        return longer
    return next(each for n in count(2) if (each := f"{longer}_{n}") not in taken)
