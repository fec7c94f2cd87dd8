"""A station's successor without a thread: what it takes over, and what is left if it does not."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.engine.successor import EngineStation, Successor
from eap.errors import EngineRefusedError
from eap.net.image_file import create_image, open_image
from eap.pd.engine import Engine
from eap.pd.layout import plan_layout
from eap.pd.spec import Writer
from eap.pd.station import Station
from tests.support.cyclic import MS
from tests.unit.eap.conftest import eap_port, left

pytestmark = pytest.mark.net


@pytest.fixture
def place(tmp_path):
    spec = left(eap_port(1, "loop://x"))
    file = create_image(tmp_path / "left.image", plan_layout(spec))
    made = EngineStation(Station(spec, file.image, file.wake_waiters), file)
    yield made
    made.file.close()


def test_nothing_that_is_written_at_the_moment_is_lost(place, tmp_path):
    """Who writes while the image is replaced finds it retired, or is carried over."""
    engine = Engine([place.station])
    engine.start(0)
    engine.handle_timeout(10 * MS)
    program = open_image(tmp_path / "left.image")
    successor = Successor(place, replace(place.station.spec, frames=()))
    with program.image.writing(Writer.APPLICATION):
        program.image.write("running", True)
    assert not program.retired
    successor.take_over(engine, 20 * MS)
    assert program.retired
    assert place.file.image.read("running") is True
    assert place.file.image.words[0] == 1
    program.close()


def test_a_program_that_stopped_in_the_middle_of_writing_leaves_what_it_had_written(
    place, tmp_path
):
    engine = Engine([place.station])
    engine.start(0)
    engine.handle_timeout(10 * MS)
    with open_image(tmp_path / "left.image") as program:
        with program.image.writing(Writer.APPLICATION):
            program.image.write("running", True)
        engine.handle_timeout(20 * MS)
        with program.image.writing(Writer.APPLICATION):
            program.image.write("running", False)
            before = Successor(place, replace(place.station.spec, frames=())).take_over(
                engine, 20 * MS
            )
        assert before.inputs is not place.station.inputs
    assert (
        place.file.image.read("running") is True
    )  # its program writes again: the image is retired


def test_an_image_that_is_not_used_is_removed(place, tmp_path):
    Successor(place, replace(place.station.spec, frames=())).discard()
    with pytest.raises(EngineRefusedError):
        Successor(place, replace(place.station.spec, ports=()))
    with pytest.raises(KeyError):
        Successor(place, replace(place.station.spec, variables=()))
    assert [path.name for path in tmp_path.iterdir()] == ["left.image"]
