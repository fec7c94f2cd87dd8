from __future__ import annotations

import math
import tracemalloc
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec import datatypes
from eap.codec.datatypes import DataType
from eap.pd.image import Image
from eap.pd.links import Generators, Links
from eap.pd.spec import (
    CounterSource,
    LinkSpec,
    RampSource,
    RandomSource,
    SineSource,
    VariableSpec,
    Writer,
)
from eap.pd.words import StationWord
from tests.support.cyclic import bus_port, entries, image_of, received, slave, station, written

TYPES = ("BOOL", "BIT3", "BYTE", "SINT", "UINT", "DINT", "UINT24", "LINT", "ULINT", "REAL", "LREAL")
FLOATS = st.floats(allow_nan=False, allow_infinity=False)


def linked(*links: LinkSpec, variables: tuple[VariableSpec, ...], **values: object) -> Image:
    """The image after one run of *links*, with what it held before."""
    image = image_of(station(variables=variables))
    for name, value in values.items():
        with image.writing(image.slots[name].writer):
            image.write(name, value)
    run(image, links)
    return image


def run(image: Image, links: tuple[LinkSpec, ...] | list[LinkSpec]) -> None:
    others = memoryview(bytes(image.memory))
    Links(image, lambda writer: image.memory if writer is Writer.ENGINE else others, links).run()


def held(image: Image) -> int:
    return int(image.words[StationWord.LINKS_HELD])


def test_values_are_copied_from_every_writer():
    image = linked(
        LinkSpec("e", "f"),
        LinkSpec("x", "y"),
        variables=(*received("e:UINT", "f:UINT", "y:REAL"), *written("x:REAL")),
        e=7,
        x=1.5,
    )
    assert (image.read("f"), image.read("y")) == (7, 1.5)


def test_bits_of_a_word_go_where_they_are_wanted():
    image = linked(
        LinkSpec("status", "fault", source_bit=3, bits=1),
        LinkSpec("status", "mode", source_bit=8, target_bit=4, bits=4),
        variables=received("status:UINT", "fault:BOOL", "mode:BYTE"),
        status=0x0A08,
        mode=0x0F,
    )
    assert (image.read("fault"), image.read("mode")) == (True, 0xAF)


def test_link_reads_results_of_earlier_links_only():
    image = linked(
        LinkSpec("a", "b"),
        LinkSpec("b", "c", scale=2.0),
        LinkSpec("c", "d"),
        LinkSpec("e", "f"),
        LinkSpec("a", "e"),
        variables=received(*(f"{name}:UINT" for name in "abcdef")),
        a=1,
        e=99,
    )
    assert [image.read(name) for name in "abcdef"] == [1, 1, 2, 2, 1, 99]


@pytest.mark.parametrize(
    ("types", "scale", "offset", "source", "target"),
    [
        (("INT", "REAL"), 0.5, 1.0, -3, -0.5),
        (("REAL", "INT"), 10.0, 0.0, 1.26, 13),
        (("INT", "USINT"), 1.0, 5.0, -20, 0),
        (("INT", "USINT"), 1.0, 5.0, 300, 255),
        (("LREAL", "REAL"), 1.0, 0.0, 1e300, datatypes.parse("REAL").scalar_range[1]),
        (("LREAL", "LINT"), 1e10, 0.0, 1e305, 2**63 - 1),
        (("ULINT", "ULINT"), 1.0, -1.0, 2**64 - 1, 2**64 - 2),
        (("ULINT", "LREAL"), 1e300, 0.0, 2**64 - 1, datatypes.parse("LREAL").scalar_range[1]),
        (("UINT", "REAL"), 1.0, 0.0, 12, 12.0),
        (("INT", "DINT"), 1.0, 0.0, -2, -2),
        (("BIT3", "BIT2"), 1.0, 0.0, 5, 3),
        (("BIT3", "UINT24"), 100.0, 0.0, 5, 500),
    ],
)
def test_numbers_are_computed_within_the_limits_of_the_target(types, scale, offset, source, target):
    image = linked(
        LinkSpec("a", "b", scale=scale, offset=offset),
        variables=received(f"a:{types[0]}", f"b:{types[1]}"),
        a=source,
    )
    assert image.read("b") == target
    assert held(image) == 0


@pytest.mark.parametrize("nothing", [math.nan, math.inf, -math.inf])
def test_link_from_nan_keeps_target_and_is_counted(nothing):
    image = linked(
        LinkSpec("a", "b", scale=2.0),
        LinkSpec("a", "c", offset=1.0),
        LinkSpec("a", "d"),
        variables=received("a:REAL", "b:INT", "c:LREAL", "d:REAL"),
        a=nothing,
        b=7,
        c=7.5,
    )
    assert (image.read("b"), image.read("c"), held(image)) == (7, 7.5, 2)
    # Without a computation it is bits like others.
    assert repr(image.read("d")) == repr(nothing)


def test_octets_are_reversed_on_the_way():
    image = linked(
        LinkSpec("a", "b", swap=True),
        LinkSpec("a", "c", swap=True, scale=2.0),
        LinkSpec("f", "g", swap=True),
        LinkSpec("a", "h", swap=True),
        variables=(
            *received("b:UINT", "c:UDINT", "f:UDINT", "g:REAL", "h:UDINT"),
            *written("a:UINT"),
        ),
        a=0x1234,
        f=0x0000_803F,
    )
    assert (image.read("b"), image.read("c"), image.read("g")) == (0x3412, 0x6824, 1.0)
    assert image.read("h") == 0x3412


def test_a_block_is_copied_as_a_whole():
    image = linked(
        LinkSpec("a", "b"), variables=received("a:BLOCK(600)", "b:BLOCK(600)"), a=b"\x5a" * 600
    )
    assert image.read("b") == b"\x5a" * 600


@st.composite
def links_of(draw: st.DrawFn, types: dict[str, str]) -> list[LinkSpec]:
    """Links as a plant file may have them, but for circles and targets that are written twice."""
    links = []
    for _ in range(draw(st.integers(0, 8))):
        source = draw(st.sampled_from(sorted(types)))
        target = draw(st.sampled_from([name for name in sorted(types) if name.startswith("e")]))
        if source == target:
            continue
        kinds = [datatypes.parse(types[name]) for name in (source, target)]
        match draw(st.sampled_from(["bits", "scale", "swap", "plain"])):
            case "bits":
                begins = [draw(st.integers(0, kind.bit_length - 1)) for kind in kinds]
                rooms = [kind.bit_length - at for kind, at in zip(kinds, begins, strict=True)]
                links.append(LinkSpec(source, target, *begins, draw(st.integers(1, min(rooms)))))
            case "scale":
                factor = st.sampled_from([1.0, -1.0, 3.0, 0.1, 1e10, 1e-10]) | FLOATS
                offset = st.sampled_from([0.0, 1.0, -2.5]) | FLOATS
                swap = kinds[0].size > 1 and draw(st.booleans())
                links.append(
                    LinkSpec(source, target, scale=draw(factor), offset=draw(offset), swap=swap)
                )
            case "swap":
                if kinds[0].size == kinds[1].size > 1:
                    links.append(LinkSpec(source, target, swap=True))
            case "plain":
                links.append(LinkSpec(source, target))
    return links


def bits_of(memory: memoryview | bytes, first: int, bits: int) -> int:
    return int.from_bytes(memory, "little") >> first & (1 << bits) - 1


def run_one_by_one(image: Image, links: list[LinkSpec], others: bytes) -> None:
    """The model: each link by itself."""
    for link in links:
        slot, goal = image.slots[link.source], image.slots[link.target]
        kind, target = datatypes.parse(slot.type), datatypes.parse(goal.type)
        memory = bytes(image.memory) if slot.writer is Writer.ENGINE else others
        if link.bits:
            for bit in range(link.bits):
                where = goal.bit_offset + link.target_bit + bit
                what = bits_of(memory, slot.bit_offset + link.source_bit + bit, 1)
                cleared = image.memory[where // 8] & ~(1 << where % 8)
                image.memory[where // 8] = cleared | what << where % 8
            continue
        octets = bits_of(memory, slot.bit_offset, kind.bit_length).to_bytes(kind.size, "little")
        octets = octets[::-1] if link.swap else octets
        is_same = kind == target or (link.swap and kind.size == target.size)
        if is_same and link.scale == 1.0 and link.offset == 0.0:
            image.store(link.target, octets)
        else:
            compute_one(image, link, kind.decode(octets, 0), target)


def compute_one(image: Image, link: LinkSpec, value: float, target: DataType) -> None:
    low, high = target.scalar_range
    if not math.isfinite(value):
        image.words[StationWord.LINKS_HELD] += 1
        return
    factors = [link.scale, link.offset]
    if isinstance(low, int) and isinstance(value, int) and all(f == f // 1 for f in factors):
        factors = [int(f) for f in factors]
    value = max(low, min(high, value * factors[0] + factors[1]))
    image.write(link.target, round(value) if isinstance(low, int) else float(value))


@given(st.lists(st.sampled_from(TYPES), min_size=2, max_size=6), st.data())
def test_links_equal_sequential_execution(kinds, data):
    """Also on a bus, where bits lie packed, and in an image of arbitrary octets."""
    types = {f"e{n}": kind for n, kind in enumerate(kinds)} | {"x0": "REAL", "x1": "UINT"}
    variables = tuple(
        VariableSpec(name, kind, Writer.ENGINE if name.startswith("e") else Writer.APPLICATION)
        for name, kind in types.items()
    )
    on_bus = [f"{name}:{datatypes.parse(types[name]).bit_length}" for name in types if name != "e0"]
    spec = station(ports=(bus_port(slave(entries(*on_bus, ":3"))),), variables=variables)
    links = data.draw(links_of(types))
    image, model = image_of(spec), image_of(spec)
    first = image.layout.regions[Writer.ENGINE].offset
    size = image.layout.samples.last - first
    octets = data.draw(st.binary(min_size=size, max_size=size))
    for each in (image, model):
        each.memory[first : first + size] = octets
    others = bytes(model.memory)
    run(image, links)
    run_one_by_one(model, links, others)
    assert bytes(image.memory) == bytes(model.memory)


def test_links_that_do_not_depend_on_each_other_are_one_step():
    names = [f"v{n}" for n in range(20)]
    variables = received(*(f"{name}:UINT" for name in names))
    links = [LinkSpec(a, b) for a, b in zip(names[:10], names[10:], strict=True)]
    image = image_of(station(variables=variables))
    assert Links(image, lambda _: image.memory, links).steps == 1
    chain = [LinkSpec(a, b) for a, b in pairwise(names)]
    assert Links(image, lambda _: image.memory, chain).steps == len(chain)


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


AXIS = "S<24/8:a@0 INT,f@2.1 BIT3,on@3 BOOL,r@8 LREAL,j@16 T<INT(-5..5)>>"


def test_links_copy_members_and_leave_the_others():
    image = linked(
        LinkSpec("axis.r", "copy.r"),
        LinkSpec("axis.on", "flag"),
        LinkSpec("flag", "copy.on"),
        LinkSpec("axis.f", "copy.f", bits=3),
        LinkSpec("copy.r", "r"),
        LinkSpec("axis.a", "copy.j", scale=1.0, offset=0.0),
        LinkSpec("word", "copy.j"),
        variables=(
            *received(f"copy:{AXIS}", "flag:BOOL", "r:LREAL"),
            *written(f"axis:{AXIS}", "word:INT"),
        ),
        axis={"a": 7, "f": 5, "on": True, "r": 2.5, "j": 0},
        copy={"a": 3, "f": 0, "on": False, "r": 0.0, "j": 1},
        word=-100,
    )
    # The target stays within its subrange.
    assert image.read("copy") == {"a": 3, "f": 5, "on": True, "r": 2.5, "j": -5}
    assert (image.read("flag"), image.read("r")) == (True, 2.5)


def test_generators_fill_members():
    image = image_of(station(variables=received(f"axis:{AXIS}")))
    sources = [CounterSource("axis.a"), CounterSource("axis.j"), CounterSource("axis.f")]
    generators = Generators(image, sources)
    generators.run(7)
    # A counter wraps with its type: from 5 to -5, and from 7 to 0.
    assert image.read("axis") == {"a": 7, "f": 7, "on": False, "r": 0.0, "j": -4}
    generators.run(8)
    assert image.read("axis.f") == 0
