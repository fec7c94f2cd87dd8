from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.codec.datatypes import parse
from eap.errors import ImageError, TornReadError
from eap.pd.image import (
    READ_ATTEMPTS,
    SAMPLING_TERM_US,
    SNAPSHOT_ATTEMPTS,
    Image,
    ImageSamples,
    Inputs,
    Sampler,
    default_value,
    extract_value,
    format_image,
    read_header,
)
from eap.pd.layout import HEADER, MAX_SAMPLES, MIN_SAMPLES, SAMPLES_SIZE, plan_layout
from eap.pd.spec import CounterSource, RxPdSpec, VariableSpec, Writer
from eap.pd.words import StationWord
from tests.support.cyclic import image_of, received, station, written
from tests.support.runstations import assemble

VALUES = {
    "BOOL": st.booleans(),
    "BIT3": st.integers(0, 7),
    "BIT8": st.integers(0, 255),
    "SINT": st.integers(-128, 127),
    "UINT24": st.integers(0, (1 << 24) - 1),
    "REAL": st.floats(width=32, allow_nan=False),
    "INT[3]": st.tuples(*[st.integers(-32768, 32767)] * 3),
    "STRING(7)": st.text("aß", max_size=3),
    "BLOCK(4)": st.binary(min_size=4, max_size=4),
}


def packed() -> Image:
    """A received PD with bits at odd offsets: on 0, mode 1-3, wide 4-11, off 12."""
    names = ("on", "mode", "wide", "off", "speed")
    variables = received("on:BOOL", "mode:BIT3", "wide:BIT8", "off:BOOL", "speed:UINT")
    return image_of(station(variables=variables, subscriptions=(RxPdSpec("r", "eap0", 1, names),)))


@given(st.data())
def test_image_write_changes_one_variable_only(data):
    kinds = data.draw(st.lists(st.sampled_from(sorted(VALUES)), min_size=1, max_size=8))
    names = tuple(f"v{i}" for i in range(len(kinds)))
    variables = received(*(f"v{i}:{kind}" for i, kind in enumerate(kinds)))
    image = image_of(station(variables=variables, subscriptions=(RxPdSpec("r", "eap0", 1, names),)))
    expected = image.read_all()
    for i in data.draw(st.lists(st.integers(0, len(kinds) - 1), max_size=10)):
        value = data.draw(VALUES[kinds[i]])
        with image.writing(Writer.ENGINE):
            image.write(f"v{i}", value)
        expected[f"v{i}"] = value
    assert image.read_all() == expected
    assert {name: image.read(name) for name in names} == expected
    octets = {name: image.encode(name, value) for name, value in expected.items()}
    assert {name: image.load(name) for name in names} == octets


STORED = ("BOOL", "BIT3", "SINT", "USINT", "INT", "UINT24", "UDINT", "LINT", "REAL", "LREAL")
_ranges = [parse(kind).scalar_range for kind in STORED]


@given(
    st.tuples(
        *(
            st.integers(low, high) if isinstance(low, int) else st.floats(low, high)
            for low, high in _ranges
        )
    )
)
def test_image_storer_equals_write(values):
    names = tuple(f"v{i}" for i in range(len(STORED)))
    variables = received(*(f"v{i}:{kind}" for i, kind in enumerate(STORED)))
    spec = station(variables=variables, subscriptions=(RxPdSpec("r", "eap0", 1, names),))
    image, other = image_of(spec), image_of(spec)
    for name, value in zip(names, values, strict=True):
        image.storer(name)(value)
        other.write(name, value)
    assert bytes(image.memory) == bytes(other.memory)


def test_bits_are_read_from_where_they_were_packed():
    image = packed()
    start = image.layout.rx[0].offset + 8
    image.memory[start : start + 4] = bytes([0b0011_1010, 0b1111_0101, 0x34, 0x12])
    assert image.read_all() == {"on": False, "mode": 5, "wide": 0x53, "off": True, "speed": 0x1234}


def test_image_rejects_unfit_value_and_writes_nothing():
    image = packed()
    with pytest.raises(ValueError, match="BIT3"):
        image.write("mode", 8)
    assert image.read("mode") == 0


def test_an_unknown_name_is_refused_by_station_and_name():
    with pytest.raises(ImageError, match="station a has no variable 'sped'"):
        packed().read("sped")


def test_defaults_are_there_from_the_start():
    image = image_of(
        station(
            variables=(
                VariableSpec("s", "STRING(4)", default="abc"),
                VariableSpec("raw", "BLOCK(2)", default="beef"),
                VariableSpec("a", "INT[2]", default=[1, -2]),
                VariableSpec("zero", "REAL"),
            )
        )
    )
    assert image.read_all() == {"s": "abc", "raw": b"\xbe\xef", "a": (1, -2), "zero": 0.0}
    assert default_value(image.slots["zero"]) == 0.0


def test_a_region_is_live():
    image = image_of(station(variables=(VariableSpec("x", "UINT"),)))
    image.region(Writer.APPLICATION)[:2] = b"\x07\0"
    assert image.read("x") == 7


def test_the_sequence_word_is_odd_while_writing_also_when_the_writer_fails():
    image = packed()
    sequence = StationWord.ENGINE_SEQUENCE
    with image.writing(Writer.ENGINE):
        assert image.words[sequence] % 2
    with pytest.raises(ValueError, match="BIT3"), image.writing(Writer.ENGINE):
        image.write("mode", 99)
    assert image.words[sequence] % 2 == 0


def test_an_odd_word_left_by_a_dead_writer_is_repaired_by_the_next():
    image = packed()
    image.words[StationWord.ENGINE_SEQUENCE] = 7
    with pytest.raises(TornReadError):
        image.read("speed")
    with image.writing(Writer.ENGINE):
        assert image.words[StationWord.ENGINE_SEQUENCE] % 2
        image.write("speed", 5)
    assert image.read("speed") == 5


def test_a_writer_that_stopped_in_the_middle_is_named_after_bounded_attempts():
    image = image_of(station(variables=(VariableSpec("x", "UINT", Writer.SERVICES),)))
    pauses = []
    reader = Image(image.memory, image.layout, pause=lambda: pauses.append(1))
    image.words[StationWord.SERVICES_SEQUENCE] = 1
    with pytest.raises(TornReadError, match="station a: the services stopped") as error:
        reader.read_all()
    assert error.value.writer == "services"
    assert len(pauses) == READ_ATTEMPTS


def test_a_reader_waits_for_a_writer_that_goes_on():
    image = image_of(station(variables=(VariableSpec("x", "UINT"),)))
    context = image.writing(Writer.APPLICATION)
    context.__enter__()
    image.write("x", 5)
    reader = Image(image.memory, image.layout, pause=lambda: context.__exit__(None, None, None))
    assert reader.read("x") == 5


def test_a_copy_that_a_writer_changed_meanwhile_is_made_again():
    image = image_of(station(variables=(VariableSpec("x", "UINT"),)))
    looks = []

    class Moving:
        def __getitem__(self, index: int) -> int:
            looks.append(index)
            if len(looks) == 2:
                with image.writing(Writer.APPLICATION):
                    image.write("x", 8)
            return image.words[index]

    reader = Image(image.memory, image.layout)
    reader.words = Moving()
    assert reader.read("x") == 8
    assert len(looks) == 4


def test_snapshot_between_two_cycles_is_a_copy():
    image = image_of(station(variables=(VariableSpec("x", "UINT", Writer.ENGINE),)))
    image.words[StationWord.CYCLE] = image.words[StationWord.FUTEX] = 7
    snapshot = image.snapshot()
    with image.writing(Writer.ENGINE):
        image.write("x", 5)
    image.words[StationWord.CYCLE] = 8
    assert (snapshot.read("x"), snapshot.words[StationWord.CYCLE]) == (0, 7)


@pytest.mark.parametrize("word", [StationWord.CYCLE, StationWord.ENGINE_SEQUENCE])
def test_snapshot_within_a_cycle_waits_for_its_end(word):
    image = image_of(station())
    image.words[word] += 1

    def end_cycle() -> None:
        image.words[StationWord.FUTEX] = image.words[StationWord.CYCLE]
        image.words[StationWord.ENGINE_SEQUENCE] = 2
        image.words[StationWord.OVERRUNS] = 9

    assert image.try_snapshot() is None
    reader = Image(image.memory, image.layout, pause=end_cycle)
    assert reader.snapshot().words[StationWord.OVERRUNS] == 9


@pytest.mark.parametrize("word", [StationWord.CYCLE, StationWord.ENGINE_SEQUENCE])
def test_snapshot_into_which_a_cycle_falls_is_not_taken(word):
    image = image_of(station())
    begun = []

    class Moving:
        """Words that begin to change when the last of them has been looked at."""

        def __getitem__(self, index: int) -> int:
            value = image.words[index]
            if index == StationWord.FUTEX and not begun:
                begun.append(index)
                image.words[word] += 2
            return value

    reader = Image(image.memory, image.layout)
    reader.words = Moving()
    assert reader.try_snapshot() is None


def test_snapshot_after_engine_stopped_within_cycle_is_last_content():
    image = image_of(station())
    image.words[StationWord.CYCLE] = 3
    pauses = []
    reader = Image(image.memory, image.layout, pause=lambda: pauses.append(1))
    assert reader.snapshot().words[StationWord.CYCLE] == 3
    assert len(pauses) == SNAPSHOT_ATTEMPTS


def test_read_header_returns_layout_of_formatted_image():
    layout = plan_layout(station(variables=(VariableSpec("x", "UINT"),)))
    memory = memoryview(bytearray(layout.size))
    format_image(memory, layout, 5)
    assert read_header(memory) == (layout, 5)


def damaged(change: str) -> memoryview:
    layout = plan_layout(station(variables=(VariableSpec("x", "UINT"),)))
    memory = memoryview(bytearray(layout.size))
    format_image(memory, layout, 1)
    fields = list(HEADER.unpack_from(memory))
    if change == "short":
        return memory[:63]
    if change == "cut":
        return memory[:-1]
    if change == "magic":
        fields[0] = bytes(8)
    if change == "version":
        fields[1] += 1
    if change == "length":
        fields[4] += 1
    if change == "directory":
        memory[fields[3]] = 0xFF
    if change == "shifted":
        text = bytes(memory[fields[3] : fields[3] + fields[4]])
        memory[fields[3] : fields[3] + fields[4]] = text.replace(
            f'"directory_offset":{fields[3]}'.encode(),
            f'"directory_offset":{fields[3] + 1}'.encode(),
        )
    if change == "words":
        count = f'"word_count":{layout.word_count}'.encode()
        text = bytes(memory[fields[3] : fields[3] + fields[4]])
        more = text.replace(count, b'"word_count":' + b"9" * (len(count) - 13))
        memory[fields[3] : fields[3] + fields[4]] = more
    if change == "samples":
        count = f'"count":{layout.samples.count}'.encode()
        text = bytes(memory[fields[3] : fields[3] + fields[4]])
        more = text.replace(count, b'"count":' + b"9" * (len(count) - 8))
        memory[fields[3] : fields[3] + fields[4]] = more
    HEADER.pack_into(memory, 0, *fields)
    return memory


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("short", "shorter than the header"),
        ("magic", "magic is missing"),
        ("version", "layout version 8, this program knows 7"),
        ("cut", "cut off"),
        ("length", "cut off"),
        ("directory", "damaged directory"),
        ("shifted", "contradicts the header"),
        ("words", "contradicts the header"),
        ("samples", "contradicts the header"),
    ],
)
def test_read_header_of_damaged_image_names_the_damage(change, message):
    with pytest.raises(ImageError, match=message):
        read_header(damaged(change))


@given(st.binary(max_size=200), st.binary(max_size=60))
def test_any_octets_are_an_image_or_an_image_error(noise, directory):
    head = HEADER.pack(b"EAPIMAGE", 2, 1, 64, len(directory), 64 + len(directory))
    for octets in (noise, head.ljust(64, b"\0") + directory + noise):
        with pytest.raises(ImageError):
            read_header(memoryview(octets))


def test_the_header_is_where_other_languages_expect_it():
    layout = plan_layout(station())
    memory = memoryview(bytearray(layout.size))
    format_image(memory, layout, 3)
    assert bytes(memory[:8]) == b"EAPIMAGE"
    assert struct.unpack_from("<IIQ", memory, 8) == (7, 3, layout.directory_offset)


def make() -> Image:
    variables = (
        VariableSpec("mine", "UINT", default=1),
        VariableSpec("host", "UINT", Writer.SERVICES),
        VariableSpec("own", "UINT", Writer.ENGINE),
    )
    return image_of(station(variables=variables))


def put(image: Image, writer: Writer, name: str, value: int) -> None:
    with image.writing(writer):
        image.write(name, value)


def seen(image: Image, inputs: Inputs, name: str) -> int:
    at = image.slots[name].bit_offset // 8
    return int.from_bytes(inputs.memory[at : at + 2], "little")


def test_inputs_copy_changed_regions_only():
    image = make()
    inputs = Inputs(image)
    assert seen(image, inputs, "mine") == 1
    inputs.refresh()
    assert not inputs.refresh()
    put(image, Writer.SERVICES, "host", 5)
    assert seen(image, inputs, "host") == 0
    assert inputs.refresh()
    assert seen(image, inputs, "host") == 5


def test_inputs_leave_out_engine_region():
    image = make()
    inputs = Inputs(image)
    inputs.refresh()
    put(image, Writer.ENGINE, "own", 5)
    assert not inputs.refresh()


def test_a_writer_in_the_middle_leaves_the_last_whole_values():
    image = make()
    inputs = Inputs(image)
    inputs.refresh()
    with image.writing(Writer.APPLICATION):
        image.write("mine", 99)
        assert not inputs.refresh()
        assert not inputs.refresh()
    assert seen(image, inputs, "mine") == 1
    assert image.words[StationWord.TORN] == 2
    assert inputs.refresh()
    assert seen(image, inputs, "mine") == 99


class Interrupted:
    """The memory of an image whose application writes whenever somebody copies from it."""

    def __init__(self, image: Image) -> None:
        self.image = image
        self.memory = self

    def __getitem__(self, region: slice) -> bytes:
        copy = bytes(self.image.memory[region])
        put(self.image, Writer.APPLICATION, "mine", 3)
        return copy


def test_a_write_that_begins_during_the_copy_waits_for_the_next_cycle():
    image = make()
    inputs = Inputs(image)
    inputs.refresh()
    put(image, Writer.APPLICATION, "mine", 2)
    inputs._image = Interrupted(image)
    assert not inputs.refresh()
    assert seen(image, inputs, "mine") == 1
    inputs._image = image
    assert inputs.refresh()
    assert seen(image, inputs, "mine") == 3
    assert not inputs.refresh()


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
        name: parse(slot.type).decode(extract_value(slot, data, 8 * first), 0)
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


def test_sampler_takes_no_samples_without_request(running):
    made, samples = running
    run(made, 3)
    assert samples.newest == 3
    assert [samples.ran_at_ns(cycle) for cycle in range(1, 4)] == [None] * 3
    assert samples.read(3) is None


def test_samples_are_taken_for_the_term_and_no_longer(running):
    made, samples = running
    term = 2 + SAMPLING_TERM_US // 1000
    samples.extend()
    run(made, 1)
    assert samples.ran_at_ns(1) == 7
    run(made, term, first_ns=MS)
    assert samples.ran_at_ns(term) is not None
    assert samples.ran_at_ns(term + 1) is None


def test_readers_of_samples_take_nothing_from_each_other(running):
    made, first = running
    second = ImageSamples(made.image)
    first.extend()
    run(made, 3)
    second.extend()
    assert list(first.since(0)) == list(second.since(0)) == [1, 2, 3]
    assert first.read(2) == second.read(2) is not None
    until = made.image.words[StationWord.SAMPLED_UNTIL]
    made.image.words[StationWord.CYCLE] = 1  # as a reader saw it that was stopped before it wrote
    first.extend()
    assert made.image.words[StationWord.SAMPLED_UNTIL] == until


def test_sample_holds_all_variables_as_the_cycle_saw_them(running):
    made, samples = running
    image = made.image
    samples.extend()
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
    samples.extend()
    run(made, 2)
    samples.extend()
    run(made, count, first_ns=2 * MS)
    assert samples.ran_at_ns(2) is None
    assert samples.read(2) is None
    assert values(made.image, samples.read(3))["n"] == 3
    assert values(made.image, samples.read(count + 2))["n"] == count + 2


def test_sample_that_is_being_taken_is_none_yet():
    image = image_of(counting())
    sampler, samples = Sampler(image, memoryview(bytearray(len(image.memory)))), ImageSamples(image)
    samples.extend()
    sampler.end_cycle(4, 1)
    assert samples.read(4) is not None
    image.memory[image.layout.samples.offset + 4 * image.layout.samples.size] = 0
    assert (samples.read(4), samples.ran_at_ns(4)) == (None, None)


@pytest.mark.parametrize(
    ("cycle_us", "octets", "count"),
    [
        (10_000, 100, 100),
        (1000, 100, 1000),
        (100, 100, MAX_SAMPLES),
        (1_000_000, 100, MIN_SAMPLES),
        (10_000, 60_000, SAMPLES_SIZE // 60_016),
        (1000, 0, 1000),
    ],
)
def test_samples_reach_back_a_second_if_there_is_room(cycle_us, octets, count):
    variables = written(f"x:BLOCK({octets})") if octets else ()
    layout = plan_layout(station(cycle_us=cycle_us, variables=variables))
    slot = layout.samples
    assert abs(slot.count - count) <= 1
    assert slot.size == 16 + slot.last - slot.first
    assert slot.size % 8 == slot.offset % 8 == 0
    assert slot.offset == slot.last
    assert layout.directory_offset == slot.offset + slot.count * slot.size


AXIS = "S<32/8:a@0 INT,f@2.1 BIT3,on@3 BOOL,r@8 LREAL,p@16 P<3/1:x@0 BYTE,y@1 INT>[1..2]>"


def test_image_reads_and_writes_members_without_touching_others():
    image = image_of(station(variables=written("axis:" + AXIS, "axis.odd:UINT")))
    whole = image.read("axis")
    with image.writing(Writer.APPLICATION):
        image.write("axis.f", 5)
        image.write("axis.on", value=True)
        image.write("axis.p[2].y", -2)
        image.write("axis.odd", 7)
    whole.update(f=5, on=True, p=({"x": 0, "y": 0}, {"x": 0, "y": -2}))
    assert image.read("axis") == whole
    assert image.read("axis.f") == 5
    assert image.read("axis.p[2]") == {"x": 0, "y": -2}
    assert image.read("axis.odd") == 7  # a variable goes before a member
    assert image.slot("axis.r").bit_offset == image.slots["axis"].bit_offset + 64
    slots = [image.slot("axis.f"), image.slot("axis.p[2].y")]
    assert image.read_slots(slots, tuple(Writer)) == {"axis.f": 5, "axis.p[2].y": -2}


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("axis.b", "station a has no 'axis.b': S has no member 'b'"),
        ("axis.p[3]", "has no element 3: 1 to 2"),
        ("axes.a", "station a has no variable 'axes.a', did you mean axis.$"),
        ("AXIS.f", "has no variable 'AXIS.f', did you mean axis.f?"),
        ("zzz.f", "has no variable 'zzz.f'$"),
        ("axis.p.x", r"\.p is P\[1\.\.2\] and has no members: expected .* such as \[1\]"),
        ("axis.p[" + "1" * 5000 + "]", "is no path"),
    ],
)
def test_image_names_a_part_that_is_not_there(name, reason):
    image = image_of(station(variables=written("axis:" + AXIS)))
    with pytest.raises(ImageError, match=reason):
        image.read(name)


def test_image_remembers_a_bounded_number_of_parts(monkeypatch):
    image = image_of(station(variables=written("v:BYTE[60]")))
    monkeypatch.setattr("eap.pd.image.MAX_PARTS", 10)
    for index in range(60):
        image.read(f"v[{index}]")
    assert len(image._parts) <= 10


def test_region_is_updated_by_its_own_writer_only():
    image = image_of(station(variables=written("on:BOOL", "bit:BIT2", "speed:REAL")))
    before = bytes(image.region(Writer.APPLICATION))
    fresh = image.updated_region(Writer.APPLICATION, {"bit": 2, "speed": 1.5})
    assert bytes(image.region(Writer.APPLICATION)) == before
    image.region(Writer.APPLICATION)[:] = fresh
    assert image.read_all() == {"on": False, "bit": 2, "speed": 1.5}
    with pytest.raises(ImageError, match="is written by the application, not by the services"):
        image.updated_region(Writer.SERVICES, {"on": True})
