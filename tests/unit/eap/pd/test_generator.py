from __future__ import annotations

import math
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.pd.generator import Generators
from eap.pd.image import Image
from eap.pd.spec import (
    CounterSource,
    RampSource,
    RandomSource,
    SineSource,
    VariableSpec,
    Writer,
)
from tests.support.cyclic import image_of, station


def make(kind: str) -> Image:
    return image_of(station(cycle_us=10_000, variables=(VariableSpec("v", kind, Writer.ENGINE),)))


def values(kind: str, source: object, *cycles: int) -> list[object]:
    image = make(kind)
    generators = Generators(image, [source])
    seen = []
    for cycle in cycles:
        generators.run(cycle)
        seen.append(image.read("v"))
    return seen


def test_a_counter_goes_up_one_step_a_cycle_and_wraps_with_its_type():
    assert values("USINT", CounterSource("v", 5), 0, 1, 50, 51, 52) == [0, 5, 250, 255, 4]
    assert values("SINT", CounterSource("v"), 127, 128, 255) == [127, -128, -1]
    assert values("LREAL", CounterSource("v", 3), 7) == [21.0]


def test_a_ramp_rises_through_its_period_and_starts_again():
    ramp = RampSource("v", 10, 20, period_ms=100)  # ten cycles
    assert values("REAL", ramp, 0, 1, 9, 10) == [10, 11, 19, 10]
    assert values("INT", RampSource("v", 0, 1, 40), 0, 1, 3) == [0, 0, 1]


def test_a_sine_turns_once_in_its_period():
    sine = SineSource("v", amplitude=2, period_ms=80, offset=5)
    expected = [5 + 2 * math.sin(2 * math.pi * cycle / 8) for cycle in range(9)]
    assert values("LREAL", sine, *range(9)) == pytest.approx(expected)


def test_a_period_shorter_than_a_cycle_stands_still():
    assert values("REAL", RampSource("v", 1, 2, period_ms=1), 0, 1, 2) == [1, 1, 1]


def test_random_block_depends_on_seed_and_time_only():
    first = values("BLOCK(8)", RandomSource("v", seed=1), *range(200))
    assert values("BLOCK(8)", RandomSource("v", seed=1), 3, 150) == [first[3], first[150]]
    assert values("BLOCK(8)", RandomSource("v", seed=2), *range(200)) != first
    assert len(set(first)) == len(first)


@pytest.mark.parametrize("size", [1, 1486])
def test_random_block_at_any_time_has_its_size(size):
    late = 1 << 50
    for value in values(f"BLOCK({size})", RandomSource("v"), *range(late, late + 100)):
        assert len(value) == size


@given(
    st.sampled_from(["SINT", "USINT", "UINT24", "LINT", "ULINT", "REAL"]),
    st.integers(0, 1 << 50),
    st.integers(-(1 << 31), 1 << 31),
)
def test_any_cycle_has_a_value_of_the_type(kind, cycle, step):
    (value,) = values(kind, CounterSource("v", step), cycle)
    limits = datatypes.parse(kind).scalar_range
    assert limits[0] <= value <= limits[1]


def test_random_variables_of_one_seed_and_size_share_their_bytes() -> None:
    image, source = make("BLOCK(8)"), RandomSource("v", seed=77)
    tracemalloc.start()
    try:
        made = [Generators(image, [source]) for _ in range(20)]
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert len(made) == 20
    assert kept < 200_000  # one sequence takes 66 kB
