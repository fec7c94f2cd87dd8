"""Variables that the engine computes itself, once in each cycle.

Every value is a function of the station's time alone: of the number of cycle times since the first
cycle, whether or not a cycle ran in each of them.  So a late or skipped cycle slows nothing down,
and a restarted engine goes on where the one before it would be.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any

from eap.codec import datatypes
from eap.pd.image import Image
from eap.pd.spec import CounterSource, EngineSource, RampSource, RandomSource, SineSource

_POSITIONS = 65_537
"""Values of a random variable before they repeat: a prime, so that every stride visits all."""
_STRIDE = 40_503
"""Between the positions of one cycle and the next: far enough that their bytes do not overlap."""


class Generators:
    """Computes all generated variables of one station."""

    def __init__(self, image: Image, sources: Iterable[EngineSource]) -> None:
        self._steps = [_step(image, source) for source in sources]

    def run(self, tick: int) -> None:
        """Store the values of the time *tick*, in cycle times since the first cycle.

        The engine's region is marked as changing.
        """
        for step in self._steps:
            step(tick)


def _step(image: Image, source: EngineSource) -> Callable[[int], None]:
    slot = image.slots[source.variable]
    kind = datatypes.parse(slot.type)
    if isinstance(source, RandomSource):
        return _random_step(image, source, slot.bit_offset // 8, kind.size)
    limits = kind.scalar_range
    whole = limits is not None and isinstance(limits[0], int)
    value = _function(source, image.layout.cycle_us, finish=round if whole else float)
    store = image.storer(slot.name)
    if limits is None or not whole:
        return lambda tick: store(value(tick))
    low, span = int(limits[0]), int(limits[1]) - int(limits[0]) + 1
    return lambda tick: store((value(tick) - low) % span + low)


@lru_cache(maxsize=32)
def _random_sequence(seed: int, size: int) -> bytes:
    """Return the bytes of all variables with this seed and size: one copy, since it is large."""
    return random.Random(seed).randbytes(_POSITIONS + size)  # noqa: S311  test data, not a secret


def _random_step(
    image: Image, source: RandomSource, offset: int, size: int
) -> Callable[[int], None]:
    """Store a piece of a fixed random sequence, at a position that follows from the time.

    Drawing new bytes in each cycle would tie the values to the number of cycles that ran, and
    takes longer for all but the smallest variables.
    """
    sequence = _random_sequence(source.seed, size)
    memory = image.memory[offset : offset + size]

    def fill(tick: int) -> None:
        position = tick * _STRIDE % _POSITIONS
        memory[:] = sequence[position : position + size]

    return fill


def _function(
    source: CounterSource | RampSource | SineSource,
    cycle_us: int,
    *,
    finish: Callable[[float], Any],
) -> Callable[[int], Any]:
    if isinstance(source, CounterSource):
        return lambda tick: finish(tick * source.step)
    period = max(source.period_ms * 1000 / cycle_us, 1.0)
    if isinstance(source, RampSource):
        span = source.high - source.low
        return lambda tick: finish(source.low + span * (tick % period) / period)
    turn = 2 * math.pi / period
    return lambda tick: finish(source.offset + source.amplitude * math.sin(turn * (tick % period)))
