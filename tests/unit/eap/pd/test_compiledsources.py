"""Generated variables by the compiled part, beside Python."""

from __future__ import annotations

import struct
from unittest import mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.pd import compiledsources
from eap.pd.compiledsources import compile_steps, number_step
from eap.pd.links import Generators
from eap.pd.spec import CounterSource, RampSource, RandomSource, SineSource, VariableSpec, Writer
from tests.support.cyclic import image_of, station

pytestmark = pytest.mark.skipif(compiledsources._cyclic is None, reason="without compiled part")

NUMBERS = ["SINT", "USINT", "INT", "UINT", "DINT", "UDINT", "LINT", "ULINT", "REAL", "LREAL"]
VALUES = st.floats(-1e12, 1e12, allow_nan=False) | st.sampled_from([0.0, 0.5, 1e37, -1e20, 2.0**60])
PERIODS = st.floats(0.01, 1e7)
STEPS = st.integers(-(2**31), 2**31) | st.sampled_from([2**62, -(2**63), 2**64])


@st.composite
def variables(draw):
    """Draw types with their sources."""
    found = []
    for number in range(draw(st.integers(1, 8))):
        name, what = f"v{number}", draw(st.sampled_from(["counter", "ramp", "sine", "random"]))
        kind = draw(st.sampled_from([*NUMBERS, "BOOL", "BYTE", "WORD"]))
        if what == "counter":
            source = CounterSource(name, draw(STEPS))
        elif what == "ramp":
            source = RampSource(name, draw(VALUES), draw(VALUES), draw(PERIODS))
        elif what == "sine":
            source = SineSource(name, draw(VALUES), draw(PERIODS), draw(VALUES))
        else:
            kind = f"BLOCK({draw(st.integers(1, 700))})"
            source = RandomSource(name, draw(st.integers(0, 3)))
        found.append((VariableSpec(name, kind, Writer.ENGINE), source))
    return found


def image_after(spec, ticks):
    """Return the variables after each tick, or the error of one."""
    image, seen = image_of(spec), []
    run = Generators(image, spec.sources).run
    for tick in ticks:
        try:
            run(tick)
        except (OverflowError, struct.error, ValueError) as exc:
            seen.append(type(exc))
        else:
            seen.append(bytes(image.region(Writer.ENGINE)))
    return seen


@given(
    variables(),
    st.lists(
        st.integers(0, 2**40) | st.integers(-5, 70_000) | st.integers(2**53 - 2, 2**62),
        min_size=1,
        max_size=6,
    ),
)
def test_compiled_values_are_those_of_python(found, ticks):
    assert_as_python(found, ticks)


@pytest.mark.parametrize("kind", NUMBERS)
def test_compiled_numbers_of_each_type_are_those_of_python(kind):
    sources = (
        CounterSource("a", 3), CounterSource("b", -(2**60)), RampSource("c", -7.5, 90.25, 70.3),
        SineSource("d", 83.7, 31.7, 0.3), SineSource("e", 1e15, 17.1, 1e14),
    )  # fmt: skip
    found = [(VariableSpec(each.variable, kind, Writer.ENGINE), each) for each in sources]
    found.append((VariableSpec("r", "BLOCK(5)", Writer.ENGINE), RandomSource("r")))
    ticks = [*range(40), 65_536, 65_537, 2**40 + 1, 2**53 - 1, 2**53 + 1, 2**62, -1, -3, 5]
    assert_as_python(found, ticks)


def assert_as_python(found, ticks):
    own, sources = zip(*found, strict=True)
    spec = station(variables=own, sources=sources)
    values = image_after(spec, ticks)
    with mock.patch.object(compiledsources, "_cyclic", None):
        assert image_after(spec, ticks) == values


def test_compiled_steps_do_what_is_usual():
    sources = (
        CounterSource("a"), RampSource("b", 0, 1, 5), SineSource("c", 2, 5), RandomSource("d"),
    )  # fmt: skip
    kinds = {"a": "UDINT", "b": "REAL", "c": "INT", "d": "BLOCK(9)"}
    own = tuple(VariableSpec(name, kind, Writer.ENGINE) for name, kind in kinds.items())
    with mock.patch("eap.pd.links._run", side_effect=AssertionError):
        made = Generators(image_of(station(variables=own, sources=sources)), sources)
        made.run(3)
    assert len(made._steps) == 1


@pytest.mark.parametrize(
    "change",
    [
        {0: 4}, {0: -1}, {1: -1}, {1: 1 << 40}, {2: 3}, {2: -8}, {2: 2, 3: 1}, {6: float("nan")},
        {6: 2.0**62, 3: 0}, {8: 0.5}, {8: float("nan")}, {0: 3, 4: 1, 5: 0}, {0: 3, 4: -1, 5: 9},
        {0: 3, 4: 1, 5: 9},
    ],
)  # fmt: skip
def test_steps_that_reach_too_far_are_refused(change):
    numbers = [1, 0, 8, 1, 0, 0, 0.0, 1.0, 5.0]
    for index, value in change.items():
        numbers[index] = value
    step = compiledsources.SourceStep(struct.pack("=6q3d", *numbers), b"12345678")
    with pytest.raises(ValueError, match=r"out of range|reaches outside"):
        compile_steps([step], memoryview(bytearray(8)), lambda tick: None)


def test_memory_that_is_too_small_is_left_to_python():
    step = number_step(CounterSource("x"), datatypes.parse("UDINT"), 4, 1.0)
    seen = []
    run = compile_steps([step], memoryview(bytearray(7)), seen.append)
    run(3)
    assert seen == [3]
