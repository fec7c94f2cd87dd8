"""How the variables of a PD lie in its data: the one rule that publisher and subscriber share.

In PDO order, bits (BOOL, BIT1 to BIT8) pack behind each other from bit 0 up, everything else
starts on the next whole octet, and the PD ends on one.  Nothing is aligned to more than an octet
(mappings of ETG.1000.6 know bit lengths only; the skipped bits are padding entries of one).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from eap.codec.datatypes import DataType


class PdoLayout(NamedTuple):
    """Where each variable starts, in bits from the start of the data, and how many octets it is."""

    bit_offsets: tuple[int, ...]
    size: int


def layout(types: Iterable[DataType]) -> PdoLayout:
    """Place one variable of each of *types*, in this order."""
    offsets: list[int] = []
    end = 0
    for kind in types:
        if not kind.is_bits:
            end = _whole_octet(end)
        offsets.append(end)
        end += kind.bit_length
    return PdoLayout(tuple(offsets), _whole_octet(end) // 8)


def _whole_octet(bits: int) -> int:
    return (bits + 7) // 8 * 8
