"""Generated variables for the compiled part, ``eap/cyclic/generate.c``.

It computes numbers of 1 to 8 bytes, with the limits of their size, and random bytes, to the same
bits as ``eap/pd/links.py``, which is the reference and does all others.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable
from typing import NamedTuple

from eap.codec.datatypes import DataType
from eap.compiled import cyclic
from eap.pd.spec import CounterSource, EngineSource, RampSource, RandomSource, SineSource

_pack = struct.Struct("=6q3d").pack
_COUNTER, _RAMP, _SINE, _RANDOM = range(4)
_MAX_FLOAT = 1e38
_MAX_INTEGER = 2.0**61
# Its numbers are stored as they are in memory.
_cyclic = cyclic if sys.byteorder == "little" else None


class SourceStep(NamedTuple):
    """Step of the compiled part for one variable, and the random bytes that it copies from."""

    octets: bytes
    sequence: bytes | None = None


def random_step(offset: int, size: int, stride: int, positions: int, sequence: bytes) -> SourceStep:
    """Return the step that stores *size* bytes of *sequence*, a *stride* further each cycle."""
    return SourceStep(_pack(_RANDOM, offset, size, 0, stride, positions, 0, 0, 0), sequence)


def number_step(
    source: EngineSource, kind: DataType, offset: int, period: float
) -> SourceStep | None:
    """Return the step of a number at *offset*; None if Python has to compute it.

    Args:
        source: Its source, other than a random one.
        kind: Its type.
        offset: Where it is, in bytes.
        period: Period of the source in cycles.
    """
    limits, size = kind.scalar_range, kind.size
    if limits is None or kind.is_bits or isinstance(source, RandomSource):
        return None
    is_float = not isinstance(limits[0], int)
    span = 1 << 8 * size
    if (
        size not in {4, 8}
        if is_float
        else (
            size not in {1, 2, 4, 8} or limits not in {(0, span - 1), (-span // 2, span // 2 - 1)}
        )
    ):
        return None
    head = offset, size, is_float
    if isinstance(source, CounterSource):
        return _packed(_COUNTER, *head, source.step, 0, 0, 0, 1)
    assert isinstance(source, (RampSource, SineSource))  # noqa: S101  no other source
    if isinstance(source, RampSource):
        parts = _RAMP, float(source.low), float(source.high - source.low)
    else:
        parts = _SINE, float(source.offset), float(source.amplitude)
    which, base, factor = parts
    if not abs(base) + abs(factor) < (_MAX_FLOAT if is_float else _MAX_INTEGER):
        return None
    return _packed(which, *head, 0, 0, base, factor, period)


def _packed(*numbers: float) -> SourceStep | None:
    try:
        return SourceStep(_pack(*numbers))
    except struct.error:  # a step that no counter of 64 bits holds
        return None


def compile_steps(
    steps: list[SourceStep], memory: memoryview, fallback: Callable[[int], None]
) -> Callable[[int], None] | None:
    """Return a function that does *steps*, as *fallback* does; None without compiled part."""
    if _cyclic is None or not steps:
        return None
    octets = b"".join(step.octets for step in steps)
    sequences = tuple(step.sequence for step in steps)
    run: Callable[[int], None] = _cyclic.SourceSteps(octets, sequences, memory, fallback).run
    return run
