from __future__ import annotations

from eap.pd.image import Image, Inputs
from eap.pd.spec import VariableSpec, Writer
from eap.pd.words import StationWord
from tests.support.cyclic import image_of, station


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
    at = image.places[name].bit_offset // 8
    return int.from_bytes(inputs.memory[at : at + 2], "little")


def test_only_what_moved_is_copied():
    image = make()
    inputs = Inputs(image)
    assert seen(image, inputs, "mine") == 1
    inputs.refresh()
    assert not inputs.refresh()
    put(image, Writer.SERVICES, "host", 5)
    assert seen(image, inputs, "host") == 0
    assert inputs.refresh()
    assert seen(image, inputs, "host") == 5


def test_what_the_engine_writes_is_not_an_input():
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
