"""Copies of bits between two memories, planned once and made in each cycle.

Moves that are adjacent on both sides become one slice.  The bits left at their ends, and moves with
another bit alignment in source and target, are copied without touching adjacent bits.
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from functools import lru_cache
from typing import Any, NamedTuple, TypeAlias

from eap.codec.wire import Buffer
from eap.compiled import cyclic


class Move(NamedTuple):
    """*bits* bits, from bit *source_bit* of one memory to bit *target_bit* of another.

    Bit 0 is the lowest of the first byte.
    """

    source_bit: int
    target_bit: int
    bits: int


Piece: TypeAlias = tuple[int, int, int]
"""From which bit of an byte to which bit of another one, and how many."""


class CopyPlan:
    """Makes *moves*, in no particular order: none may write what another one reads or writes.

    Args:
        moves: The copies to make.
        used: If given, what else of the target means anything, as (first bit, bits).  Other bits
            between two moves of one run, and beside one in its byte, are then copied along.

    Raises:
        ValueError: two moves write the same bit, or one is empty or begins before the memory.
    """

    __slots__ = ("_bits", "_compiled", "_shifts", "_slices")

    def __init__(
        self,
        moves: Iterable[Move | tuple[int, int, int]],
        *,
        used: Iterable[tuple[int, int]] | None = None,
    ) -> None:
        runs = _merge(sorted((Move(*move) for move in moves), key=lambda move: move.target_bit))
        if used is not None:
            own = ((run.target_bit, run.bits) for run in runs)
            runs = _bridge(runs, _Used([*used, *own]))
        self._slices: list[tuple[slice, slice]] = []
        self._shifts: list[tuple[slice, slice, int, int, int]] = []
        pieces: dict[tuple[int, int], list[Piece]] = {}
        for run in runs:
            for part in _split(run):
                # Bits go through tables of 256 entries: one lookup shifts and masks a byte, and
                # several pieces of one pair of bytes share it.
                if part.target_bit % 8 or part.bits < 8:
                    for octets, piece in _pieces(part):
                        pieces.setdefault(octets, []).append(piece)
                else:
                    self._add_octets(part)
        self._bits = [
            (source, target, *_table(tuple(parts))) for (source, target), parts in pieces.items()
        ]
        self._compiled = self._compile() if cyclic is not None and self.operations else None

    @property
    def operations(self) -> int:
        """Number of copies of a run."""
        return len(self._slices) + len(self._bits) + len(self._shifts)

    def run(self, source: Buffer, target: memoryview) -> None:
        """Copy everything; both may be the same memory."""
        if self._compiled is not None:
            self._compiled.run(source, target)
            return
        for where, what in self._slices:
            target[where] = source[what]
        for octet, where_octet, keep, table in self._bits:
            target[where_octet] = target[where_octet] & keep | table[source[octet]]
        for where, what, shift, mask, size in self._shifts:
            value = int.from_bytes(source[what], "little") >> shift & mask
            target[where] = value.to_bytes(size, "little")

    def _compile(self) -> Any:
        """Return the same copies for the compiled part."""
        assert cyclic is not None  # noqa: S101  by the caller
        pack = struct.pack
        slices = [
            pack("=3q", what.start, to.start, to.stop - to.start) for to, what in self._slices
        ]
        bits = [pack("=3q256s", *each) for each in self._bits]
        shifted = [
            pack("=4q", what.start, to.start, size, shift)
            for to, what, shift, _, size in self._shifts
        ]
        return cyclic.Copies(b"".join(slices), b"".join(bits), b"".join(shifted))

    def _add_octets(self, part: Move) -> None:
        """Plan whole bytes of the target."""
        size = part.bits // 8
        first, shift = divmod(part.source_bit, 8)
        where = slice(part.target_bit // 8, part.target_bit // 8 + size)
        if shift:
            # A shifted run of whole bytes covers one byte more in its source.
            what = slice(first, first + size + 1)
            self._shifts.append((where, what, shift, (1 << part.bits) - 1, size))
        else:
            self._slices.append((where, slice(first, first + size)))


class _Used:
    """Bits of a memory that mean something."""

    def __init__(self, ranges: Iterable[tuple[int, int]]) -> None:
        self._ranges = sorted((first, first + bits) for first, bits in ranges)
        self._starts = [first for first, _ in self._ranges]
        # Ranges may overlap, so the one that reaches furthest is not always the last.
        self._ends: list[int] = []
        for _, end in self._ranges:
            self._ends.append(max(end, self._ends[-1]) if self._ends else end)

    def is_free(self, first: int, end: int) -> bool:
        """Return whether none of the bits from *first* up to *end* is in use."""
        before = bisect_right(self._starts, end - 1) if end > first else 0
        return not before or self._ends[before - 1] <= first


def _merge(moves: Iterable[Move]) -> list[Move]:
    runs: list[Move] = []
    for move in moves:
        if move.bits < 1 or move.source_bit < 0 or move.target_bit < 0:
            raise ValueError(f"{move} is no copy: expected at least 1 bit, from bit 0 on")
        if not runs:
            runs.append(move)
            continue
        last = runs[-1]
        gap = move.target_bit - last.target_bit - last.bits
        if gap < 0:
            raise ValueError(
                f"{last} and {move} write the same bit: expected each to be written once"
            )
        if gap == 0 and _delta(last) == _delta(move):
            runs[-1] = last._replace(bits=last.bits + move.bits)
        else:
            runs.append(move)
    return runs


def _bridge(runs: Iterable[Move], used: _Used) -> list[Move]:
    """Widen runs to whole bytes, and join them, over unused bits."""
    wide: list[Move] = []
    for run in runs:
        begin, end = run.target_bit, run.target_bit + run.bits
        delta = _delta(run)
        if not delta % 8:  # what lies otherwise in its octets would become more steps, not fewer
            floor, ceiling = begin // 8 * 8, -(-end // 8) * 8
            begin = floor if used.is_free(floor, begin) else begin
            end = ceiling if used.is_free(end, ceiling) else end
            if wide and _delta(wide[-1]) == delta:
                last = wide[-1]
                if used.is_free(last.target_bit + last.bits, begin):
                    begin = last.target_bit
                    wide.pop()
        wide.append(Move(begin - delta, begin, end - begin))
    return wide


def _delta(move: Move) -> int:
    return move.target_bit - move.source_bit


def _split(run: Move) -> Iterator[Move]:
    """Split a run into its whole bytes of the target, and the bits before and behind them."""
    source, target, bits = run
    head = min(-target % 8, bits)
    body = (bits - head) // 8 * 8
    for size in (head, body, bits - head - body):
        if size:
            yield Move(source, target, size)
        source += size
        target += size


def _pieces(part: Move) -> Iterator[tuple[tuple[int, int], Piece]]:
    """Split the bits of one target byte by source byte."""
    source, target, bits = part
    while bits:
        size = min(8 - source % 8, bits)
        yield (source // 8, target // 8), (source % 8, target % 8, size)
        source, target, bits = source + size, target + size, bits - size


@lru_cache(maxsize=1024)
def _table(pieces: tuple[Piece, ...]) -> tuple[int, bytes]:
    """Return the mask of target bits to keep, and the bits to set for each source byte."""
    keep = 0xFF
    table = [0] * 256
    for source_bit, target_bit, bits in pieces:
        mask = (1 << bits) - 1
        keep &= ~(mask << target_bit)
        for octet in range(256):
            table[octet] |= (octet >> source_bit & mask) << target_bit
    return keep, bytes(table)
