"""Putting a PD's data together from its variables: copies planned once, made in each cycle."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

from eap.codec import datatypes, pdo
from eap.pd.image import Image
from eap.pd.inputs import Inputs
from eap.pd.spec import Writer

Run: TypeAlias = tuple[memoryview, int, int, int]
"""Memory, where from, where to in the PD, how much; all three in octets, or all three in bits."""


class Gather:
    """Copies the variables of one PDO into a buffer.

    Args:
        image: Where the engine's own variables are read.
        inputs: Where all others are read.
        variables: Names, in PDO order.
    """

    def __init__(self, image: Image, inputs: Inputs, variables: Sequence[str]) -> None:
        places = [image.places[name] for name in variables]
        kinds = [datatypes.parse(place.type) for place in places]
        plan = pdo.layout(kinds)
        self.size = plan.size
        runs: list[Run] = []
        self._bits: list[Run] = []
        for place, kind, target in zip(places, kinds, plan.bit_offsets, strict=True):
            memory = image.memory if place.writer is Writer.ENGINE else inputs.memory
            if kind.is_bits:
                self._bits.append((memory, place.bit_offset, target, kind.bit_length))
                continue
            run = (memory, place.bit_offset // 8, target // 8, kind.size)
            if runs and _continues(runs[-1], run):
                _, source, first, size = runs.pop()
                run = (memory, source, first, size + kind.size)
            runs.append(run)
        self._runs = [
            (target, target + size, memory[source : source + size])
            for memory, source, target, size in runs
        ]

    @property
    def has_bits(self) -> bool:
        """Whether :meth:`bits_into` has anything to do."""
        return bool(self._bits)

    def copies(self, offset: int) -> list[tuple[slice, memoryview]]:
        """Return what to copy to where for the whole octets of a PD that starts at *offset*."""
        return [(slice(offset + first, offset + last), data) for first, last, data in self._runs]

    def into(self, buffer: memoryview, offset: int) -> None:
        """Write the PD's data as it is now to *buffer* at *offset*."""
        for where, data in self.copies(offset):
            buffer[where] = data
        self.bits_into(buffer, offset)

    def bits_into(self, buffer: memoryview, offset: int) -> None:
        """Write the bits among the variables, packed."""
        octets: dict[int, int] = {}
        for memory, source, target, length in self._bits:
            start, shift = divmod(source, 8)
            value = int.from_bytes(memory[start : start + 2], "little") >> shift
            first, shift = divmod(target, 8)
            value = (value & (1 << length) - 1) << shift
            octets[first] = octets.get(first, 0) | value & 0xFF
            if shift + length > 8:  # also when its upper bits are zero now
                octets[first + 1] = octets.get(first + 1, 0) | value >> 8
        for octet, value in octets.items():
            buffer[offset + octet] = value


def _continues(run: Run, following: Run) -> bool:
    memory, source, target, size = run
    return (memory is following[0]) and (source + size, target + size) == following[1:3]
