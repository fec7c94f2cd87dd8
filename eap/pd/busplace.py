"""Where a slave's process data lies in a station's image: bit for bit as in its PDOs.

Padding keeps its place, so that a bus and an image of the same order are one copy.  The outputs of
one slave may have several writers; each writer's region then mirrors all of them, and holds those
that are its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from eap.codec.datatypes import DataType
from eap.pd.spec import BusEntrySpec


class Mirror(NamedTuple):
    """One direction of a slave's process data."""

    bit_offsets: dict[str, int]
    """Of each variable, from where the slave's part begins."""
    size: int
    """In octets."""


def mirror(entries: Iterable[BusEntrySpec], types: Mapping[str, DataType]) -> Mirror:
    """Place the variables of *entries*.

    What is no bit field starts on a whole octet, as everywhere in an image: behind an entry that a
    slave has elsewhere all others are shifted.
    """
    offsets: dict[str, int] = {}
    end = 0
    for entry in entries:
        if entry.variable:
            if not types[entry.variable].is_bits:
                end = -(-end // 8) * 8
            offsets[entry.variable] = end
        end += entry.bit_length
    return Mirror(offsets, -(-end // 8))
