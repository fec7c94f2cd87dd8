"""Guess of the variables in unknown process data, from the bytes of some arrivals.

A guess helps a person who knows the machine; it is never a type.  What fits in several ways is
named by the type that is most frequent in EAP: whole numbers of 4 and 2 bytes, REAL, LREAL, texts.
PDs have no alignment, so the reader goes on behind each part that it recognises.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from itertools import pairwise
from math import isfinite
from typing import NamedTuple

_LEAST_SAMPLES = 3
_SHORTEST_TEXT = 4
_MOST_STEP = 1000
"""Step of a counter from one arrival to the next."""
_COUNTERS = ((4, "UDINT"), (2, "UINT"), (1, "USINT"))
_SMALLEST, _LARGEST = 1e-6, 1e9
"""Limits of plausible measured values, other than 0."""
MAX_PARTS = 24
"""Parts that are named; the rest is one."""
_EXAMINED = 256
"""Bytes at the begin that are looked at; the rest is one part."""


class LikelyVariable(NamedTuple):
    """Some bytes of a PD that look like one variable."""

    offset: int
    size: int
    type: str
    """Data type that they may be, or BLOCK."""
    text: str
    """Observation that it rests on."""

    def __str__(self) -> str:
        last = self.offset + self.size - 1
        where = f"byte {self.offset}" if self.size == 1 else f"bytes {self.offset} to {last}"
        return f"{where}: {self.type}, {self.text}" if self.text else f"{where}: {self.type}"


def guess(samples: Sequence[bytes]) -> list[LikelyVariable]:
    """Return the parts of a PD whose data was *samples*, oldest first; empty with too few."""
    if len(samples) < _LEAST_SAMPLES or not samples[0]:
        return []
    size = len(samples[0])
    parts: list[LikelyVariable] = []
    offset = anchor = 0
    while offset < size:
        part = None
        # Unknown bytes are passed by twos: few variables have an odd size.
        if len(parts) < MAX_PARTS - 1 and offset < _EXAMINED and (offset - anchor) % 2 == 0:
            part = _part_at(samples, offset)
        found = part or LikelyVariable(offset, 1, "BLOCK", "")
        before = parts[-1] if parts else None
        if part is None and before is not None and before.type == "BLOCK":
            parts[-1] = before._replace(size=before.size + 1)
        else:
            parts.append(found)
        offset += found.size
        if part is not None:
            anchor = offset
    return [_describe(samples, each) for each in parts]


def _part_at(samples: Sequence[bytes], offset: int) -> LikelyVariable | None:
    """Return what begins at *offset*, None if nothing is recognised there."""
    for reader in _READERS:
        part = reader(samples, offset)
        if part is not None:
            return part
    return None


def _text_at(samples: Sequence[bytes], offset: int) -> LikelyVariable | None:
    """Recognise printable ASCII, with the zero bytes behind it."""
    shortest = min(_printable(each, offset) for each in samples)
    if shortest < _SHORTEST_TEXT:
        return None
    end = offset + max(_printable(each, offset) for each in samples)
    while end < len(samples[0]) and not any(each[end] for each in samples):
        end += 1
    text = samples[-1][offset:end].rstrip(b"\0").decode("ascii", "replace")[:24]
    return LikelyVariable(offset, end - offset, f"STRING({end - offset})", f"such as {text!r}")


def _printable(sample: bytes, offset: int) -> int:
    end = offset
    while end < len(sample) and 0x20 <= sample[end] < 0x7F:
        end += 1
    return end - offset


def _counter_at(samples: Sequence[bytes], offset: int) -> LikelyVariable | None:
    """Recognise a whole number that grows by the same small step each time, and wraps."""
    for size, kind in _COUNTERS:
        steps = _steps(samples, offset, size)
        if len(set(steps)) == 1 and 0 < steps[0] <= min(_MOST_STEP, (1 << 8 * size) // 8):
            return LikelyVariable(offset, size, kind, f"a counter, {steps[0]} more each time")
    return None


def _uneven_counter_at(samples: Sequence[bytes], offset: int) -> LikelyVariable | None:
    """Recognise a whole number that grows by small steps; the low bytes of a REAL may do so too."""
    for size, kind in _COUNTERS[:2]:
        steps = _steps(samples, offset, size)
        if steps and min(steps) > 0 and max(steps) <= _MOST_STEP:
            return LikelyVariable(offset, size, kind, "a counter")
    return None


def _steps(samples: Sequence[bytes], offset: int, size: int) -> list[int]:
    """Return the differences of a whole number, none if it reaches past the end."""
    if offset + size > len(samples[0]):
        return []
    # The first samples follow each other; later ones are further apart.
    values = [int.from_bytes(each[offset : offset + size], "little") for each in samples[:8]]
    return [(after - before) % (1 << 8 * size) for before, after in pairwise(values)]


def _real_at(samples: Sequence[bytes], offset: int) -> LikelyVariable | None:
    """Recognise floating-point numbers of plausible size."""
    for size, kind, form in ((4, "REAL", "<f"), (8, "LREAL", "<d")):
        if offset + size > len(samples[0]):
            continue
        values = [float(struct.unpack_from(form, each, offset)[0]) for each in samples]
        if not all(map(_is_plausible, values)):
            continue
        if len(set(values)) > 1:
            return LikelyVariable(offset, size, kind, f"{min(values):.6g} to {max(values):.6g}")
        # A set point may be constant; then it is a number with few digits, which bytes are rarely.
        if values[0] and struct.pack(form, float(f"{values[0]:.4g}")) == samples[0][offset:][:size]:
            return LikelyVariable(offset, size, kind, f"{values[0]:.6g}, constant")
    return None


def _is_plausible(value: float) -> bool:
    return isfinite(value) and (value == 0 or _SMALLEST <= abs(value) <= _LARGEST)


def _flag_at(samples: Sequence[bytes], offset: int) -> LikelyVariable | None:
    """Recognise a byte that is 0 or 1 by turns."""
    if {each[offset] for each in samples} == {0, 1}:
        return LikelyVariable(offset, 1, "BYTE", "0 or 1: a flag")
    return None


def _small_at(samples: Sequence[bytes], offset: int) -> LikelyVariable | None:
    """Recognise a changing whole number of 4 or 2 bytes whose upper half is its sign."""
    for size, kind in ((4, "DINT"), (2, "INT")):
        if offset + size > len(samples[0]):
            continue
        low = offset + size // 2
        uppers = {each[low : offset + size] for each in samples}
        if not uppers <= {bytes(size // 2), b"\xff" * (size // 2)}:
            continue
        values = [
            int.from_bytes(each[offset : offset + size], "little", signed=True) for each in samples
        ]
        if len(set(values)) > 1:
            return LikelyVariable(offset, size, kind, f"{min(values)} to {max(values)}")
    return None


_READERS: tuple[Callable[[Sequence[bytes], int], LikelyVariable | None], ...] = (
    _text_at,
    _counter_at,
    _flag_at,
    _real_at,
    _uneven_counter_at,
    _small_at,
)
"""In the order in which they are tried."""


def _describe(samples: Sequence[bytes], part: LikelyVariable) -> LikelyVariable:
    """Complete a part that nothing recognised: whether its bytes change."""
    if part.type != "BLOCK":
        return part
    seen = {each[part.offset : part.offset + part.size] for each in samples}
    text = "changing"
    if len(seen) == 1:
        text = "constant" if any(seen.pop()) else "all zero"
    return part._replace(type=f"BLOCK({part.size})", text=text)
