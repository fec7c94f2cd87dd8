"""Variables that the engine computes itself, once in each cycle.

All but the random block are functions of the cycle counter alone, so that a restarted engine goes
on where the first one would be.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Iterable
from typing import Any

from eap.codec import datatypes
from eap.pd.image import Image
from eap.pd.spec import CounterSource, EngineSource, RampSource, RandomSource, SineSource


class Generators:
    """Computes all generated variables of one station."""

    def __init__(self, image: Image, sources: Iterable[EngineSource]) -> None:
        self._steps = [_step(image, source) for source in sources]

    def run(self, cycle: int) -> None:
        """Store the values of this cycle; the engine's region is marked as changing."""
        for step in self._steps:
            step(cycle)


def _step(image: Image, source: EngineSource) -> Callable[[int], None]:
    place = image.places[source.variable]
    kind = datatypes.parse(place.type)
    if isinstance(source, RandomSource):
        return _random_step(image, source, place.bit_offset // 8, kind.size)
    limits = kind.scalar_range
    whole = limits is not None and isinstance(limits[0], int)
    value = _function(source, image.layout.cycle_us, finish=round if whole else float)
    store = image.storer(place.name)
    if limits is None or not whole:
        return lambda cycle: store(value(cycle))
    low, span = int(limits[0]), int(limits[1]) - int(limits[0]) + 1
    return lambda cycle: store((value(cycle) - low) % span + low)


def _random_step(
    image: Image, source: RandomSource, offset: int, size: int
) -> Callable[[int], None]:
    generator = random.Random(source.seed)  # noqa: S311  test data, not a secret
    memory = image.memory[offset : offset + size]

    def fill(_: int) -> None:
        memory[:] = generator.randbytes(size)

    return fill


def _function(
    source: CounterSource | RampSource | SineSource,
    cycle_us: int,
    *,
    finish: Callable[[float], Any],
) -> Callable[[int], Any]:
    if isinstance(source, CounterSource):
        return lambda cycle: finish(cycle * source.step)
    period = max(source.period_ms * 1000 / cycle_us, 1.0)
    if isinstance(source, RampSource):
        span = source.high - source.low
        return lambda cycle: finish(source.low + span * (cycle % period) / period)
    turn = 2 * math.pi / period
    return lambda cycle: finish(
        source.offset + source.amplitude * math.sin(turn * (cycle % period))
    )
