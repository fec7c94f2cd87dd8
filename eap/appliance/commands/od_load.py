"""Many entries written in the order that a device needs: what refers comes after what is meant.

Rule 1: variables, then PDOs, then PDs, then frames, then all else.
Rule 2: a list of a PDO is emptied before its entries are written, and counted afterwards.
Rule 3: an object that holds all of it already is left alone.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import groupby
from typing import NamedTuple, TypeAlias

from eap.appliance.commands.od_device import OdDevice
from eap.errors import ControlError, EapError

Download: TypeAlias = tuple[int, int, bytes]
"""Index, subindex and octets."""

CONTROL = 0xF200
"""What a device is asked to do is no part of its configuration."""
_MAPPINGS = (
    range(0x1600, 0x1C00),
    range(0x1C10, 0x1C30),
    range(0x2000, 0x2E00),
    range(0x3000, 0x3E00),
)
"""PDOs and their assignment (ETG.1000.6), and the further PDOs of an EAP port."""
_RANKS = (
    (range(0x6000, 0x8000), 0),
    *((each, 1) for each in _MAPPINGS),
    (range(0xD000, 0xF000), 2),
    (range(0x8000, 0x9000), 3),
)
_LAST = 4


class Loaded(NamedTuple):
    """What became of a load."""

    written: int
    """Entries."""
    unchanged: int
    """Entries of objects that held all of it already."""


def load(device: OdDevice, entries: Iterable[Download]) -> Loaded:
    """Write *entries*.

    Raises:
        ControlError: the device refuses one of them; those before it are written.
    """
    present = {(each.object.index, each.entry.subindex): each.octets for each in device.contents()}
    written = unchanged = 0
    for index, group in groupby(sorted(entries, key=_order), key=lambda entry: entry[0]):
        chosen = list(group)
        if index == CONTROL or all(present.get(each[:2]) == each[2] for each in chosen):
            unchanged += len(chosen)
            continue
        for step in _steps(index, chosen):
            try:
                device.write(*step)
            except EapError as exc:
                raise ControlError(f"{exc}; {_words(written)} written before") from None
        written += len(chosen)
    return Loaded(written, unchanged)


def _order(entry: Download) -> tuple[int, int, int]:
    index, subindex, _ = entry
    rank = next((rank for indexes, rank in _RANKS if index in indexes), _LAST)
    return rank, index, subindex or 0x100


def _steps(index: int, entries: list[Download]) -> list[Download]:
    """Return the downloads for one object; *entries* have subindex 0 last."""
    counts = entries[-1][1] == 0 and len(entries) > 1
    if counts and any(index in each for each in _MAPPINGS):
        return [(index, 0, bytes(1)), *entries]
    return entries


def _words(written: int) -> str:
    if written < 2:
        return "1 entry was" if written else "nothing was"
    return f"{written} entries were"
