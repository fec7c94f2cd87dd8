from __future__ import annotations

import pytest

from eap.codec.datatypes import parse
from eap.pd.image import take
from eap.pd.layout import MAX_SAMPLES, MIN_SAMPLES, SAMPLES_SIZE, plan_layout
from eap.pd.samples import ImageSamples, Sampler
from eap.pd.spec import CounterSource, VariableSpec, Writer
from eap.pd.words import StationWord
from tests.support.cyclic import image_of, station, written
from tests.support.runstations import assemble

MS = 1_000_000


def counting(**more):
    """A station that counts, and has something of each writer."""
    return station(
        variables=(
            VariableSpec("n", "UDINT", Writer.ENGINE),
            VariableSpec("flag", "BOOL", Writer.SERVICES),
            *written("x:UINT", "y:LREAL"),
        ),
        sources=(CounterSource("n"),),
        **more,
    )


def values(image, data):
    first = image.layout.samples.first
    return {
        name: parse(slot.type).decode(take(slot, data, 8 * first), 0)
        for name, slot in image.slots.items()
    }


@pytest.fixture
def running():
    made, _ = assemble(counting())
    made.start(0)
    return made, ImageSamples(made.image)


def run(made, cycles, *, first_ns=0):
    for number in range(cycles):
        made.cycle(first_ns + number * MS, first_ns + number * MS + 7)


def test_no_samples_are_taken_unless_somebody_wants_them(running):
    made, samples = running
    run(made, 3)
    assert samples.newest == 3
    assert [samples.ran_at_ns(cycle) for cycle in range(1, 4)] == [None] * 3
    assert samples.read(3) is None


def test_wanted_cycles_are_sampled_and_no_more(running):
    made, samples = running
    samples.want(2)
    run(made, 3)
    assert [samples.ran_at_ns(cycle) for cycle in range(1, 4)] == [7, MS + 7, None]


def test_sample_holds_all_variables_as_the_cycle_saw_them(running):
    made, samples = running
    image = made.image
    samples.want(9)
    with image.writing(Writer.APPLICATION):
        image.write("x", 5)
    with image.writing(Writer.SERVICES):
        image.write("flag", value=True)
    run(made, 1)
    image.words[StationWord.APPLICATION_SEQUENCE] += 1  # in the middle of the next write
    image.write("x", 6)
    run(made, 1, first_ns=MS)
    expected = {"flag": True, "x": 5, "y": 0.0}
    assert values(image, samples.read(1)) == {"n": 1, **expected}
    assert values(image, samples.read(2)) == {"n": 2, **expected}


def test_later_samples_take_the_slot_of_the_oldest(running):
    made, samples = running
    count = made.image.layout.samples.count
    samples.want(10 * count)
    run(made, count + 2)
    assert samples.ran_at_ns(2) is None
    assert samples.read(2) is None
    assert values(made.image, samples.read(3))["n"] == 3
    assert values(made.image, samples.read(count + 2))["n"] == count + 2


def test_sample_that_is_being_taken_is_none_yet():
    image = image_of(counting())
    sampler, samples = Sampler(image, memoryview(bytearray(len(image.memory)))), ImageSamples(image)
    samples.want(4)
    sampler.end_cycle(4, 1)
    assert samples.read(4) is not None
    image.memory[image.layout.samples.offset + 4 * image.layout.samples.size] = 0
    assert (samples.read(4), samples.ran_at_ns(4)) == (None, None)


@pytest.mark.parametrize(
    ("cycle_us", "octets", "count"),
    [
        (10_000, 100, 25),
        (1000, 100, 250),
        (100, 100, MAX_SAMPLES),
        (1_000_000, 100, MIN_SAMPLES),
        (10_000, 60_000, SAMPLES_SIZE // 60_016),
        (1000, 0, 250),
    ],
)
def test_samples_reach_back_a_quarter_of_a_second_if_there_is_room(cycle_us, octets, count):
    variables = written(f"x:BLOCK({octets})") if octets else ()
    layout = plan_layout(station(cycle_us=cycle_us, variables=variables))
    slot = layout.samples
    assert abs(slot.count - count) <= 1
    assert slot.size == 16 + slot.last - slot.first
    assert slot.size % 8 == slot.offset % 8 == 0
    assert slot.offset == slot.last
    assert layout.directory_offset == slot.offset + slot.count * slot.size
