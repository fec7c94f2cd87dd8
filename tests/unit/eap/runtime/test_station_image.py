"""The newest image of a station, for those who keep it for long."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.errors import ImageError, WriterConflictError
from eap.net.image_file import create_image, open_image
from eap.pd.layout import plan_layout
from eap.pd.spec import VariableSpec, Writer
from eap.runtime.station_image import StationImage


@pytest.fixture
def path(files):
    return files["left"].path


@pytest.fixture
def station(path):
    station = StationImage(path)
    yield station
    station.close()


@pytest.fixture
def move(path, stations):
    """Give the station an image with a variable more, or fewer."""
    opened = []

    def move(count: int = 1, *, without: str = ""):
        spec = stations[0]
        kept = tuple(each for each in spec.variables if each.name != without)
        more = tuple(VariableSpec(f"more{n}", "UINT") for n in range(count))
        frames = () if without else spec.frames
        spec = replace(spec, variables=kept + more, frames=frames)
        opened.append(create_image(path, plan_layout(spec)))

    yield move
    for file in opened:
        file.close()


def test_missing_image(tmp_path):
    with pytest.raises(ImageError, match="no process image"):
        StationImage(tmp_path / "none.image")


def test_moves_to_the_newest_image(station, move):
    before = station.image
    assert station.image is before
    move()
    assert "more0" in station.image.slots
    assert station.file.generation == 2
    before.read("setpoint")  # what somebody still holds stays as it was


def test_newest_image_that_cannot_be_opened_is_told(station, move, path):
    move()
    path.unlink()
    with pytest.raises(ImageError, match="no process image"):
        _ = station.image


def test_right_to_write_moves_too(station, move, path):
    station.acquire_writer(Writer.SERVICES)
    move()
    assert "more0" in station.image.slots
    with open_image(path) as other:
        with pytest.raises(WriterConflictError):
            other.acquire_writer(Writer.SERVICES)
        station.release_writer(Writer.SERVICES)
        other.acquire_writer(Writer.SERVICES)
    move(2)
    assert "more1" in station.image.slots


def test_lost_right_to_write_is_told_and_the_old_image_kept(station, move, path):
    station.acquire_writer(Writer.APPLICATION)
    move()
    with open_image(path) as other:
        other.acquire_writer(Writer.APPLICATION)
        with pytest.raises(WriterConflictError):
            _ = station.image
    assert "more0" in station.image.slots


def test_values_are_written_at_once_or_not_at_all(station):
    station.acquire_writer(Writer.APPLICATION)
    station.write(Writer.APPLICATION, {"running": True, "name": "x"})
    assert station.image.read("running") is True
    with pytest.raises(ValueError, match="not a value"):
        station.write(Writer.APPLICATION, {"running": False, "name": 1})
    with pytest.raises(ImageError, match="no variable 'gone'"):
        station.write(Writer.APPLICATION, {"running": False, "gone": 1})
    assert station.image.read("running") is True


def test_values_written_while_the_image_changes_are_in_the_new_one(station, move, monkeypatch):
    station.acquire_writer(Writer.APPLICATION)
    store = station.image.store

    def store_late(name, octets):
        store(name, octets)
        move()  # the engine has copied what there was before

    monkeypatch.setattr(station.image, "store", store_late)
    station.write(Writer.APPLICATION, {"running": True})
    assert "more0" in station.image.slots
    assert station.image.read("running") is True


def test_variable_that_went_meanwhile_is_told(station, move):
    station.acquire_writer(Writer.APPLICATION)
    move(without="running")
    with pytest.raises(ImageError, match="no variable 'running'"):
        station.write(Writer.APPLICATION, {"running": True})


def test_writer_for_one_write_leaves_the_place_to_others(station, path):
    station.write_once(Writer.APPLICATION, {"running": True})
    with open_image(path) as other:
        assert other.image.read("running") is True
        other.acquire_writer(Writer.APPLICATION)
        with pytest.raises(WriterConflictError):
            station.write_once(Writer.APPLICATION, {"running": False})
    with pytest.raises(ValueError, match="BOOL"):
        station.write_once(Writer.APPLICATION, {"running": 2})
    station.acquire_writer(Writer.APPLICATION)
